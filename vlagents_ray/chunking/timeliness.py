"""The share of a robot's ticks that had an action in time, and the ages of those actions.

A tick counts if an action of the policy is due at it. Ticks do not count while the robot is paused,
stopped or moved by an operator, and while it waits for the first answer after that. A tick is
*starved* if no answer had a row for it. Later events, such as a rejection of the row by the guard,
do not matter here. A tick at which the robot waits by choice, before it moves a gripper
(`vlagents_ray.chunking.careful`), had a row, and is also counted as *careful*.

Chunk players, the control loop of a robot, evaluations in real time and replicas all count with
`Timeliness`, or report a `TimeShare`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from vlagents_ray.errors import Overloaded, PolicyUnavailable, TooManyRequests, UnknownSession
from vlagents_ray.interface import AGE_MS, CAUSE, IN_TIME

KEPT_AGES = 10_000  # number of stored ages: 1,000 s at 10 Hz
# After these errors no replica has executed the request, which may be sent again.
_NOT_EXECUTED = (TooManyRequests, Overloaded, PolicyUnavailable, UnknownSession)


def counts_ticks(error: Exception | None) -> bool:
    """Return whether a replica counts the ticks that a request reports.

    A replica counts them when it answers the request. Otherwise, clients report them again.

    Args:
        error: The error with which the replica answers; None if it answers with an action.
    """
    return not isinstance(error, _NOT_EXECUTED)


class TimeShare(NamedTuple):
    """The share of ticks in time, and the ages of actions, of one or several robots over a
    period.
    """

    ticks: int  # ticks at which an action of the policy was due
    starved: int  # ticks without a row of an answer
    age_p50_ms: float | None = None  # age of executed actions; None if no age is known
    age_p95_ms: float | None = None
    age_p99_ms: float | None = None

    @classmethod
    def from_ages(cls, ticks: int, starved: int, ages_ms: Iterable[float]) -> TimeShare:
        """Return the figures for a number of ticks and the ages of their executed actions, ms."""
        ordered = sorted(ages_ms)
        p50, p95, p99 = (_quantile(ordered, share) for share in (0.5, 0.95, 0.99))
        return cls(ticks, starved, p50, p95, p99)

    @property
    def share(self) -> float | None:
        """The share of the ticks in time, in [0, 1]; None without ticks."""
        return None if self.ticks == 0 else 1 - self.starved / self.ticks

    def to_json(self) -> dict[str, Any]:
        """Return the fields and the `share`."""
        return {**self._asdict(), "share": self.share}


class Timeliness:
    """Counts ticks, as the docstring of the module defines them."""

    def __init__(self) -> None:
        self.ticks = 0  # ticks at which an action of the policy was due
        self.starved = 0  # ticks without a row of an answer
        self.careful = 0  # ticks at which the robot waited by choice before it moves a gripper
        self._ages_ms: deque[float] = deque(maxlen=KEPT_AGES)
        # Ticks and starved ticks that requests have reported, with and without the last request.
        self._reported = self._reported_before = (0, 0)

    def add(self, *, in_time: bool, age_ms: float | None = None, is_careful: bool = False) -> None:
        """Count a tick at which an action of the policy was due.

        Args:
            in_time: Whether an answer had a row for it.
            age_ms: The age of the tick's executed action, ms; None if no action was executed.
            is_careful: Whether the robot waited by choice before it moves a gripper.
        """
        self.ticks += 1
        self.careful += is_careful
        if not in_time:
            self.starved += 1
        elif age_ms is not None:
            self._ages_ms.append(age_ms)

    def count(self, info: Mapping[str, Any]) -> None:
        """Count a tick of a chunk player, if an action of the policy was due at it.

        Args:
            info: The info of the tick's action.
        """
        in_time = info.get(IN_TIME)
        if in_time is not None:
            is_careful = info.get(CAUSE) == "careful"
            self.add(in_time=in_time, age_ms=info.get(AGE_MS), is_careful=is_careful)

    def count_missed(self, ticks: int) -> None:
        """Count ticks that passed while the loop was busy, for example while it waited for an
        answer.
        """
        self.ticks += ticks
        self.starved += ticks

    def report(self) -> list[int]:
        """Return the number of ticks and of starved ticks since the last report, for the next
        request.
        """
        self._reported_before = self._reported
        self._reported = self.ticks, self.starved
        ticks, starved = self._reported_before
        return [self.ticks - ticks, self.starved - starved]

    def failed(self, error: Exception) -> None:
        """Report the ticks of a failed request again with the next request, if the error shows that
        no replica has counted them.
        """
        if not counts_ticks(error):
            self._reported = self._reported_before

    @property
    def time_share(self) -> TimeShare:
        """The figures so far, with the ages of the last `KEPT_AGES` actions."""
        return TimeShare.from_ages(self.ticks, self.starved, self._ages_ms)


def in_words(time_share: TimeShare) -> str:
    """Return the figures as text. At least one tick must have been counted."""
    text = f"in time: {time_share.share:.2%} of {time_share.ticks} ticks of the policy"
    if time_share.age_p50_ms is not None:
        text += (
            f"; age of its actions p50 {time_share.age_p50_ms:.0f} ms, p95 "
            f"{time_share.age_p95_ms:.0f} ms, p99 {time_share.age_p99_ms:.0f} ms"
        )
    return text


def _quantile(ordered: Sequence[float], share: float) -> float | None:
    """Return the nearest-rank quantile of sorted values; None without values."""
    if not ordered:
        return None
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)]
