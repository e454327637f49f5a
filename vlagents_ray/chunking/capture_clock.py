"""The capture times of observations, on a clock that does not jump."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import CAPTURED, Obs

SKEW_S = 0.1
"""How far ahead of this machine's clock the clock of a sensor's computer may be."""


class CaptureClock:
    """Computes when an observation was captured, in s of `time.monotonic`.

    `captured_at` is `time.time`, since it travels to other machines, and that clock may be set at any moment. So it is
    read once, when a new `captured_at` is first seen; from then on, `time.monotonic` measures the age. If the same
    observation is passed again, for instance because a camera hangs, it ages whatever happens to the clock. A jump of
    the clock affects only the observation during which it happens: after a jump forward the observation is too old;
    after one backward it lies in the future (by more than `SKEW_S`), and counts as too old as well, since its age is
    unknown.
    """

    def __init__(self) -> None:
        self._stamp: float | None = None
        self._at = 0.0

    def __call__(self, obs: Obs) -> float:
        """Return the capture time; now, if the observation has none; `-math.inf` for an impossible one."""
        now, stamp = time.monotonic(), obs.info.get(CAPTURED)
        if stamp is None:
            return now
        if not isinstance(stamp, (int, float)) or not math.isfinite(stamp):
            raise InvalidObservation(f"info[{CAPTURED!r}]: got {stamp!r}, want seconds since 1970, as of time.time()")
        if stamp != self._stamp:
            age_s = time.time() - stamp
            self._stamp, self._at = stamp, now - max(age_s, 0.0) if age_s >= -SKEW_S else -math.inf
        return self._at


def stamped(obs: Obs, extras: Mapping[str, Any]) -> Obs:
    """Return a copy of the observation with its capture time and the `extras` of the request."""
    return replace(obs, info={CAPTURED: time.time(), **obs.info, **extras})
