"""How many requests were charged to a key, by buckets whose clocks stand still."""

from __future__ import annotations

import pytest

from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.token_bucket import TokenBucket


class FrozenBucket(TokenBucket):
    """A bucket that is never refilled."""

    def take(self, now: float, number: int = 1) -> float:
        """Take tokens at the time at which the bucket was created."""
        return super().take(self._refilled, number)

    @property
    def taken(self) -> float:
        """The tokens that were taken so far."""
        return self._capacity - self._tokens


def freeze(patch: pytest.MonkeyPatch) -> None:
    """Give keys that are read from now on such buckets."""
    patch.setattr(api_keys, "TokenBucket", FrozenBucket)


def requests_charged(keys: Keys, name: str) -> float:
    """The requests that were charged to the key of that name since `freeze`."""
    bucket = keys._buckets.get(name)
    return bucket.taken if isinstance(bucket, FrozenBucket) else 0.0
