"""The number of requests charged to a key, counted with buckets whose clocks stand still."""

from __future__ import annotations

import pytest

from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.token_bucket import TokenBucket


class FrozenBucket(TokenBucket):
    """A bucket that is never refilled."""

    def take(self, now: float, number: int = 1) -> float:
        """Take tokens without a refill, at the time at which the bucket was created."""
        return super().take(self._refilled, number)

    def owe(self, now: float, number: float) -> None:
        """Take tokens without a refill, even if there are fewer."""
        super().owe(self._refilled, number)

    @property
    def taken(self) -> float:
        """Return the number of tokens taken so far."""
        return self._capacity - self._tokens


def freeze(patch: pytest.MonkeyPatch) -> None:
    """Let all keys that are read from now on use buckets that are never refilled."""
    patch.setattr(api_keys, "TokenBucket", FrozenBucket)


def requests_charged(keys: Keys, name: str) -> float:
    """Return the number of requests charged to the key of that name since `freeze`."""
    bucket = keys._buckets.get(name)
    return bucket.taken if isinstance(bucket, FrozenBucket) else 0.0
