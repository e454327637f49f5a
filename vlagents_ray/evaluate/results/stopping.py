"""Valid early stopping: confidence sequences, and an order of episodes that is independent of workers.

A confidence sequence holds at all numbers of episodes together: the chance that it ever misses the true rate is at most
the error rate, so the evaluation may stop after any episode. An interval for a fixed number of episodes, such as
Wilson's, is not valid then.

Quick episodes end first, and failures take longest, so the finished episodes are a biased sample. Therefore only an
unbroken prefix of the planned order counts, and the end of a cell depends on its outcomes alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from vlagents_ray.errors import InvalidInput
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import StopConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey

_HALVINGS = 60  # of an interval of length 1: below the resolution of a float


def confidence_sequence(successes: int, trials: int, error_rate: float = 0.05) -> tuple[float, float]:
    """Compute an interval of a success probability that is valid after every trial together.

    It is {p : (n + 1) C(n, s) p^s (1 - p)^(n - s) > error_rate}: H. Robbins, "Statistical Methods Related to the Law of
    the Iterated Logarithm", Ann. Math. Statist. 41 (1970). It is the beta-binomial mixture martingale with a
    uniform prior, of which J. Ville's inequality (1939) bounds the chance to ever reach 1 / error_rate.

    Args:
        successes: The number of trials that succeeded so far.
        trials: The number of trials so far.
        error_rate: The largest chance, in (0, 1), that the interval misses the probability at any number of trials.

    Returns:
        (low, high), each in [0, 1]; (0, 1) when there are no trials.

    Raises:
        InvalidInput: `successes` is not in 0 … `trials`.
    """
    if not 0 <= successes <= trials:
        raise InvalidInput(
            f"confidence_sequence: got {successes} successes in {trials} trials, want 0 <= successes <= trials"
        )
    failures = trials - successes
    # log of (n + 1) C(n, s) / error_rate; s log p + (n - s) log(1 - p) must be at least its negative
    room = math.lgamma(trials + 2) - math.lgamma(successes + 1) - math.lgamma(failures + 1) - math.log(error_rate)

    def possible(p: float) -> bool:
        log_p = successes * math.log(p) if successes else 0.0
        log_q = failures * math.log1p(-p) if failures else 0.0
        return log_p + log_q > -room

    rate = successes / trials if trials else 0.5
    low = 0.0 if not successes else _boundary(possible, inside=rate, outside=0.0)
    high = 1.0 if not failures else _boundary(possible, inside=rate, outside=1.0)
    return low, high


def pooled(counts: Sequence[tuple[int, int]], error_rate: float) -> tuple[float, float]:
    """Return bounds (low, high) of the success rate of several cells, each weighted by its episodes.

    `counts` are the (successes, trials) of each cell. Stopping determines the weights, so each cell gets an equal share
    of the error rate: then all their bounds hold at once, and so does any weighted mean.
    """
    counts = [one for one in counts if one[1]]
    total = sum(trials for _, trials in counts)
    if not total:
        return 0.0, 1.0
    bounds = [(*confidence_sequence(s, n, error_rate / len(counts)), n / total) for s, n in counts]
    return sum(low * share for low, _, share in bounds), sum(high * share for _, high, share in bounds)


class Stopping:
    """Decides when one cell stops, from its episodes in any order."""

    def __init__(self, stop: StopConfig, seeds: Sequence[int], planned: int) -> None:
        """Start without an outcome; `seeds` and `planned` episodes (of all seeds together) are those of the cell."""
        self._stop = stop
        self._seeds = list(seeds)
        self._each = planned // len(seeds)
        self._outcomes: dict[int, bool] = {}  # by place in the plan
        self._begun = 0  # length of the unbroken prefix
        self._successes = 0  # in it
        self.at: int | None = None  # after so many episodes the cell stops; None: not yet

    def add_all(self, results: Iterable[EpisodeResult]) -> None:
        for result in results:
            self.add(result)

    def add(self, result: EpisodeResult) -> None:
        """Add the outcome of an episode. One that failed by infrastructure has none yet, and is awaited."""
        place = self._place(result.key)
        if place is not None and result.success_once is not None:
            self._outcomes[place] = result.success_once
        while self.at is None and self._begun in self._outcomes:
            self._successes += self._outcomes[self._begun]
            self._begun += 1
            if self._begun >= self._stop.at_least and self._certain():
                self.at = self._begun

    def counts(self, key: EpisodeKey) -> bool:
        """Return whether the episode counts, as it comes before the end of the cell."""
        place = self._place(key)
        return self.at is None or (place is not None and place < self.at)

    def _place(self, key: EpisodeKey) -> int | None:
        """Return the index of an episode in the cell's part of `jobs.plan`; None if it is no longer planned."""
        first = key.seed - key.episode
        if first not in self._seeds or key.episode >= self._each:
            return None
        return self._seeds.index(first) * self._each + key.episode

    def _certain(self) -> bool:
        low, high = confidence_sequence(self._successes, self._begun, self._stop.error_rate)
        target, width = self._stop.target, self._stop.width
        return (target is not None and not low <= target <= high) or (width is not None and high - low < width)


def _boundary(possible: Callable[[float], bool], inside: float, outside: float) -> float:
    """Return the first point from `inside` to `outside` that is not `possible`."""
    for _ in range(_HALVINGS):
        middle = (inside + outside) / 2
        if middle in (inside, outside):
            break
        if possible(middle):
            inside = middle
        else:
            outside = middle
    return outside
