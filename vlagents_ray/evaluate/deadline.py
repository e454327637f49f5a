"""When an evaluation has to be over: no episode is begun that would not end in time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

from vlagents_ray.evaluate.jobs import EpisodeKey, Job

MARGIN = 1.25  # the next episode may take so much longer than the longest seen
CLOSING_S = 10.0  # for workers to close their simulators, and for the report


class Deadline:
    """Knows how long episodes take, as the driver sees them: a simulator's start and waiting for a policy included."""

    def __init__(
        self, end_at: float | None, known_s: Iterable[float] = (), now: Callable[[], float] = time.time
    ) -> None:
        """`end_at` in seconds since 1970, None for never; `known_s` are those of episodes that were played before."""
        self._end_at = end_at
        self._longest_s = max(known_s, default=0.0)
        self._now = now
        self._begun: dict[EpisodeKey, float] = {}

    def begin(self, jobs: Iterable[Job]) -> None:
        """These have been given to a worker."""
        self._begun |= dict.fromkeys((job.key for job in jobs), self._now())

    def end(self, job: Job) -> None:
        """An attempt at this one is over, well or not."""
        begun = self._begun.pop(job.key, None)
        if begun is not None:
            self._longest_s = max(self._longest_s, self._now() - begun)

    @property
    def leaves_room(self) -> bool:
        """Would one more episode end in time?"""
        return self._left_s() > self._longest_s * MARGIN

    @property
    def is_over(self) -> bool:
        """Must what is still being played be given up?"""
        return self._left_s() <= 0

    def _left_s(self) -> float:
        return float("inf") if self._end_at is None else self._end_at - CLOSING_S - self._now()
