"""Success rates with their uncertainty, and how they grow with the steps of an episode."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import InvalidInput

Z_95 = 1.959963984540054  # two-sided 95 % quantile of the standard normal distribution


def wilson(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Compute the Wilson score interval of a success probability.

    E. B. Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", JASA 22
    (1927). Unlike the textbook interval it stays inside [0, 1] and is honest for few episodes and
    for rates of 0 % and 100 %.

    Args:
        successes: The number of trials that succeeded.
        trials: The number of trials.
        z: The quantile of the standard normal distribution; the default gives 95 %.

    Returns:
        (low, high), each in [0, 1]; (0, 1) when there are no trials.

    Raises:
        InvalidInput: `successes` is not in 0 … `trials`.
    """
    if not 0 <= successes <= trials:
        raise InvalidInput(f"wilson: got {successes} successes in {trials} trials, want 0 <= successes <= trials")
    if trials == 0:
        return 0.0, 1.0
    rate = successes / trials
    scale = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / scale
    half = z / scale * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    # The bounds are exactly 0 and 1 there; floating point would leave 1e-17.
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == trials else centre + half
    return low, high


@dataclass(frozen=True, slots=True)
class Rate:
    """The number of successes among episodes, with an interval of the true success rate."""

    successes: int
    episodes: int
    # Where an evaluation could stop early: the confidence sequence (`confidence_sequence`), and its error rate.
    bounds: tuple[float, float] | None = None
    error_rate: float | None = None
    pooled: bool = True  # False: the cells of these episodes have no common rate, so that `rate` is None

    @property
    def rate(self) -> float | None:
        """The success rate, in [0, 1]; None without episodes, or if they have no common rate."""
        return self.successes / self.episodes if self.episodes and self.pooled else None

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high): the Wilson 95 % interval, unless there are other `bounds`; (0, 1) if there is no common rate."""
        if not self.pooled:
            return 0.0, 1.0
        return wilson(self.successes, self.episodes) if self.bounds is None else self.bounds

    def to_json(self) -> dict[str, Any]:
        """The fields for JSON: `successes`, `episodes`, `rate`, and the interval.

        That is `wilson_95` or, where an evaluation could stop early, `confidence_sequence` with its `error_rate`.
        """
        counts = {"successes": self.successes, "episodes": self.episodes, "rate": self.rate}
        if self.bounds is None:
            return counts | {"wilson_95": list(self.interval)}
        return counts | {"confidence_sequence": list(self.interval), "error_rate": self.error_rate}

    def __str__(self) -> str:
        if self.rate is None:
            return "-"
        low, high = self.interval
        return f"{self.rate:.0%} [{100 * low:.0f}, {100 * high:.0f}]"


@dataclass(frozen=True, slots=True)
class SuccessCurve:
    """The share of episodes solved by each env step: constant between `steps`, a jump at each."""

    steps: tuple[int, ...]  # 0, each step after which an episode was first solved, and the horizon
    solved: tuple[Rate, ...]  # by each of `steps`


def success_curve(first_successes: Sequence[int | None], horizon: int) -> SuccessCurve:
    """Compute the share of episodes that are solved by each step.

    E. L. Kaplan, P. Meier, "Nonparametric Estimation from Incomplete Observations", JASA 53 (1958): their estimate
    where nothing is censored. An episode that ended unsolved, at the step limit, by an error or by the policy's own
    word, will not be solved any more, so it stays in the denominator; leaving it out as censored would claim that it
    might have been. The band is Wilson's interval at each step by itself, and so at the end the interval of the rate.

    Args:
        first_successes: For each episode the number of steps after which it was first solved; None: it never was.
        horizon: The number of steps at which the curve ends.

    Returns:
        The curve.

    Raises:
        InvalidInput: A number of steps is not in 1 … `horizon`.
    """
    known = [step for step in first_successes if step is not None]
    if any(not 0 < step <= horizon for step in known):
        raise InvalidInput(f"success_curve: got steps from {min(known)} to {max(known)}, want them in 1 … {horizon}")
    steps = sorted({0, *known, horizon})
    n = len(first_successes)
    return SuccessCurve(tuple(steps), tuple(Rate(sum(one <= step for one in known), n) for step in steps))
