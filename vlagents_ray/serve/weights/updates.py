"""New weights for the deployment's own model in one replica, in two phases, and what a reset says about them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, get_args

import numpy as np

from vlagents_ray.errors import InvalidInput, PolicyUnavailable
from vlagents_ray.serve.weights.versions import FollowingSession, ModelWeights, PushMode
from vlagents_ray.weights.safetensors import ValueSpec

OPTION = "weights"  # of a reset
_COLLECTED = 1000  # most durations of pushes that wait to be collected
_LARGEST = 2**53 - 1  # number of a version, which JSON carries exactly
_FOLLOW, _PINNED = "follow", "pinned"


@dataclass(frozen=True, slots=True)
class PushOptions:
    """The options of a push."""

    mode: PushMode = "next_episode"  # when sessions change
    partial: bool = False  # whether names may be missing, whose values stay
    allow_same: bool = False  # whether all values may equal those of the newest version
    pin: bool = False  # whether sessions that do not follow also get it, at their next reset
    version: int | None = None  # its number, such as the step of training; None: the newest one's + 1

    def __post_init__(self) -> None:
        if self.version is not None and not 1 <= self.version <= _LARGEST:
            raise InvalidInput(f"version: got {self.version}, want a number in [1, {_LARGEST}]")
        if self.mode not in get_args(PushMode):
            raise InvalidInput(f"mode: got {self.mode!r}, want one of {list(get_args(PushMode))}")


@dataclass(frozen=True, slots=True)
class PushResult:
    """A push that succeeded."""

    version: int
    fingerprint: str  # the same at all replicas
    replicas: tuple[str, ...]  # names of those that act with it


@dataclass(frozen=True, slots=True)
class NewestVersion:
    """The newest version of a replica."""

    number: int
    model: tuple[str, str]  # equal in replicas that loaded the same checkpoint with the same settings
    gpu: str = ""  # UUID of the GPU on which its weights are; empty if it is none, or more than one


@dataclass(frozen=True, slots=True)
class HeldVersion:
    """A pushed version, for a replica that lacks it."""

    number: int
    pinned: bool
    values: dict[str, np.ndarray]  # by name, as `portable` returns them


class WeightUpdates:
    """Stages and commits new weights in one replica. Thread-safe."""

    def __init__(self, own: Callable[[], ModelWeights], sessions: Callable[[], Sequence[FollowingSession]]) -> None:
        """Update the weights that `own` returns, with which these `sessions` of the replica act."""
        self._own = own
        self._sessions = sessions
        self._pushes_ms: deque[float] = deque(maxlen=_COLLECTED)

    def pushed(self, took_ms: float) -> None:
        """Note the duration of a push that this replica coordinated, for the metrics."""
        self._pushes_ms.append(took_ms)

    def collect_pushes_ms(self) -> list[float]:
        """Return the durations of the pushes since the last call."""
        return [self._pushes_ms.popleft() for _ in range(len(self._pushes_ms))]

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Check values before they arrive; see `ModelWeights.read_header`."""
        return self._own().read_header(header, partial=options.partial)

    def stage(self, number: int, pushed: Mapping[str, Any], options: PushOptions) -> str:
        """Check and hold a new version, and return its fingerprint; see `ModelWeights.stage`."""
        return self._own().stage(number, pushed, partial=options.partial, allow_same=options.allow_same)

    def commit(self, number: int, options: PushOptions) -> None:
        """Act with the staged version; see `ModelWeights.commit`."""
        self._own().commit(number, options.mode, self._sessions, pin=options.pin)

    def held(self) -> list[HeldVersion]:
        """Return the pinned and the newest version, the older one first, unless that is the checkpoint itself."""
        own = self._own()
        pinned, newest = own.pinned, own.newest
        pushed = dict.fromkeys(version for version in (pinned, newest) if version.number)
        return [HeldVersion(one.number, one is pinned, own.portable_values(one)) for one in pushed]

    def drop(self, number: int) -> None:
        """Drop the staged version."""
        self._own().drop(number)

    def describe(self) -> dict[str, dict[str, Any]] | None:
        """Return number and fingerprint of the newest and the pinned version, for the metadata; None while it loads."""
        try:
            own = self._own()
        except PolicyUnavailable:
            return None
        return {"newest": own.newest.describe(), "pinned": own.pinned.describe()}

    @property
    def newest(self) -> NewestVersion:
        """The newest version; raises `PolicyUnavailable` while the policy loads."""
        own = self._own()
        own.settle()
        return NewestVersion(own.newest.number, own.model, own.gpu)

    @property
    def number(self) -> int:
        """Number of the newest version; 0 while the policy loads."""
        try:
            return self.newest.number
        except PolicyUnavailable:
            return 0


def follows(options: dict[str, Any], *, by_default: bool) -> bool:
    """Remove the option "weights" from those of a reset, and return whether the episode takes the newest version.

    Raises:
        InvalidInput: The option has another value than "follow" or "pinned".
    """
    wanted = options.pop(OPTION, _FOLLOW if by_default else _PINNED)
    if wanted not in (_FOLLOW, _PINNED):
        raise InvalidInput(f"{OPTION}: got {wanted!r}, want {_FOLLOW!r} (the newest version) or {_PINNED!r}")
    return bool(wanted == _FOLLOW)
