"""The time by which an evaluation has to end: no episode begins that would not end by then."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job

MARGIN = 1.25  # by which the next episode may be longer than the longest so far
CLOSING_S = 10.0  # for workers to close their simulators, and for the report to be written


class Deadline:
    """Measures the duration of episodes in the driver: the start of a simulator and waiting for a policy included."""

    def __init__(
        self, end_at: float | None, known_s: Iterable[float] = (), now: Callable[[], float] = time.time
    ) -> None:
        """`end_at` is in seconds since 1970, None for no deadline; `known_s` are durations of earlier episodes, s."""
        self._end_at = end_at
        self._longest_s = max(known_s, default=0.0)
        self._now = now
        self._begun: dict[EpisodeKey, float] = {}

    def begin(self, jobs: Iterable[Job]) -> None:
        """Note that a worker begins these episodes."""
        self._begun |= dict.fromkeys((job.key for job in jobs), self._now())

    def end(self, job: Job) -> None:
        """Note that an attempt at this episode has ended, successful or not."""
        begun = self._begun.pop(job.key, None)
        if begun is not None:
            self._longest_s = max(self._longest_s, self._now() - begun)

    @property
    def leaves_room(self) -> bool:
        """Whether one more episode would end in time."""
        return self._left_s() > self._longest_s * MARGIN

    @property
    def is_over(self) -> bool:
        """Whether the episodes that are being played have to be abandoned."""
        return self._left_s() <= 0

    def _left_s(self) -> float:
        return float("inf") if self._end_at is None else self._end_at - CLOSING_S - self._now()
