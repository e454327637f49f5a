"""Early stopping: decides which cases of a plan need no further episodes.

Successful episodes are short and end first, and failures take longest, so the finished episodes are
a biased sample. Therefore only an unbroken prefix of the planned order counts. The end of a case
then depends only on the outcomes, not on durations. The decision counts only the first episode of
each start, as further ones are not independent.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import StopConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan
from vlagents_ray.evaluate.results.statistics import confidence_sequence


class EarlyStopping:
    """The state of early stopping for each case of a plan; without a rule, no case stops early."""

    def __init__(self, plan: ResolvedPlan) -> None:
        """Create the state without results."""
        self._by_case: dict[str, CaseStopping] = {}
        if plan.stop is not None:
            for case in plan.cases:
                self._by_case[case.fingerprint] = CaseStopping(
                    plan.stop, case.suite.seeds, case.planned
                )

    def add(self, result: EpisodeResult) -> int | None:
        """Add the result of an episode.

        Returns:
            The number of episodes after which the case stops, if this result ends the case;
            otherwise None.
        """
        case_id = result.key.settings
        if case_id not in self._by_case or self.has_stopped(case_id):
            return None
        self._by_case[case_id].add(result)
        return self._by_case[case_id].at

    def has_stopped(self, case_id: str) -> bool:
        """Return whether the case with this fingerprint has stopped."""
        stopping = self._by_case.get(case_id)
        return stopping is not None and stopping.at is not None


class CaseStopping:
    """Decides when a case stops. Its episodes may be added in any order."""

    def __init__(self, stop: StopConfig, seeds: Sequence[int], planned: int) -> None:
        """Create the state without outcomes.

        Args:
            stop: The settings of early stopping.
            seeds: The seeds of the case.
            planned: The number of planned episodes of the case, over all seeds.
        """
        self._stop = stop
        self._seeds = list(seeds)
        self._episodes_per_seed = planned // len(seeds)
        self._outcomes: dict[int, tuple[bool, str | None]] = {}  # outcome and start, by index
        self._starts: set[str] = set()  # the starts in the unbroken prefix of the plan
        self._in_order = 0  # the number of episodes in the unbroken prefix of the plan
        # The number of episodes, and of successes, in the prefix with different starts.
        self._independent = self._successes = 0
        # The number of episodes after which the case stops; None: not decided yet.
        self.at: int | None = None

    def add_all(self, results: Iterable[EpisodeResult]) -> None:
        """Add the outcomes of several episodes."""
        for result in results:
            self.add(result)

    def add(self, result: EpisodeResult) -> None:
        """Add the outcome of an episode. An episode that failed because of infrastructure has no
        outcome yet, so later episodes do not count until this episode is repeated.
        """
        index = place_in_plan(result.key, self._seeds, self._episodes_per_seed)
        if index is not None and result.success_once is not None:
            self._outcomes[index] = result.success_once, result.start
        while self.at is None and self._in_order in self._outcomes:
            solved, start = self._outcomes[self._in_order]
            self._in_order += 1
            if start is None or start not in self._starts:
                self._independent += 1
                self._successes += solved
            if start is not None:
                self._starts.add(start)
            if self._in_order >= self._stop.at_least and self._is_certain():
                self.at = self._in_order

    def counts(self, key: EpisodeKey) -> bool:
        """Return whether an episode counts, i.e. whether it precedes the end of the case."""
        index = place_in_plan(key, self._seeds, self._episodes_per_seed)
        return self.at is None or (index is not None and index < self.at)

    def _is_certain(self) -> bool:
        """Return whether the interval excludes the target rate, or is narrow enough."""
        low, high = confidence_sequence(self._successes, self._independent, self._stop.error_rate)
        target, width = self._stop.target, self._stop.width
        excludes_target = target is not None and not low <= target <= high
        is_narrow = width is not None and high - low < width
        return excludes_target or is_narrow


def place_in_plan(key: EpisodeKey, seeds: Sequence[int], episodes_per_seed: int) -> int | None:
    """Return the index of an episode among the planned episodes of its case; None if it is no
    longer planned.
    """
    first_seed = key.seed - key.episode
    if first_seed not in seeds or key.episode >= episodes_per_seed:
        return None
    return seeds.index(first_seed) * episodes_per_seed + key.episode
