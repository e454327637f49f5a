"""The share of a robot's ticks that had an action in time, and the ages of those actions.

A tick counts if the policy was to act at it: not while the robot is paused, stopped or moved by an
operator, nor while it waits for the first answer after one of these. It is *starved* if no answer
had a row for it. What becomes of the row, such as a refusal by the guard, does not matter here.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.interface import AGE_MS, IN_TIME

KEPT_AGES = 10_000  # the number of ages that are kept: 1,000 s at 10 Hz


class Timeliness:
    """Counts ticks by `Act.info` of a chunk player; see the module for what is counted."""

    def __init__(self) -> None:
        self.ticks = 0  # at which the policy was to act
        self.starved = 0  # those of them without a row
        self._ages_ms: deque[float] = deque(maxlen=KEPT_AGES)

    def count(self, info: Mapping[str, Any]) -> None:
        """Count a tick.

        Args:
            info: The info of its action.
        """
        in_time = info.get(IN_TIME)
        if in_time is None:
            return
        self.ticks += 1
        if not in_time:
            self.starved += 1
        elif AGE_MS in info:
            self._ages_ms.append(info[AGE_MS])

    def count_missed(self, ticks: int) -> None:
        """Count ticks that passed while the loop was busy, such as with waiting for an answer."""
        self.ticks += ticks
        self.starved += ticks

    @property
    def share(self) -> float:
        """The share of ticks in time, in [0, 1]; 1 before the first tick."""
        return 1.0 if not self.ticks else 1.0 - self.starved / self.ticks

    def to_json(self) -> dict[str, Any]:
        """Return the figures: `ticks`, `starved`, `share`, and the ages of executed actions
        `age_p50_ms`, `age_p95_ms` and `age_p99_ms`, which are absent without one.
        """
        figures: dict[str, Any] = {
            "ticks": self.ticks,
            "starved": self.starved,
            "share": self.share,
        }
        if self._ages_ms:
            for percent in (50, 95, 99):
                figures[f"age_p{percent}_ms"] = float(np.percentile(self._ages_ms, percent))
        return figures
