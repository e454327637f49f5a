"""Statistics of success: rates and their paired comparison.

A confidence sequence is valid at all numbers of episodes simultaneously: the probability that it
ever misses the true rate is at most the error rate, so the evaluation may stop after any episode.
An interval for a fixed number of episodes, such as Wilson's, is not valid if the number depends on
the outcomes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput

Z_95 = 1.959963984540054  # two-sided 95 % quantile of the standard normal distribution
ERROR_RATE = 0.05  # probability that an interval misses the true value
_PSEUDO_EPISODES = 2.0


def wilson(successes: int, trials: int, z: float = Z_95) -> tuple[float, float]:
    """Compute the Wilson score interval of a success probability.

    E. B. Wilson, "Probable Inference, the Law of Succession, and Statistical Inference", JASA 22
    (1927). Unlike the textbook interval it stays inside [0, 1] and is accurate for few episodes and
    for rates of 0 % and 100 %.

    Args:
        successes: The number of successful trials.
        trials: The number of trials.
        z: The quantile of the standard normal distribution; the default gives 95 %.

    Returns:
        (low, high), each in [0, 1]; (0, 1) when there are no trials.

    Raises:
        InvalidInput: `successes` is not in 0 … `trials`.
    """
    if not 0 <= successes <= trials:
        raise InvalidInput(
            f"wilson: expected 0 <= successes <= trials, got {successes} successes in {trials} "
            "trials"
        )
    if trials == 0:
        return 0.0, 1.0

    rate = successes / trials
    scale = 1 + z * z / trials
    centre = (rate + z * z / (2 * trials)) / scale
    half_width = z / scale * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))

    # Without successes the lower bound is exactly 0, and without failures the upper bound is
    # exactly 1. Floating point would give 1e-17 and 1 - 1e-16.
    low = 0.0 if successes == 0 else centre - half_width
    high = 1.0 if successes == trials else centre + half_width
    return low, high


@dataclass(frozen=True, slots=True)
class Rate:
    """The number of successes among episodes, with an interval of the true success rate."""

    successes: int
    episodes: int
    # The confidence sequence and its error rate (`confidence_sequence`), if the evaluation could
    # stop early.
    bounds: tuple[float, float] | None = None
    error_rate: float | None = None
    # Whether the cases of these episodes have a common rate; otherwise `rate` is None.
    pooled: bool = True

    @property
    def rate(self) -> float | None:
        """The success rate, in [0, 1]; None without episodes, or if they have no common rate."""
        return self.successes / self.episodes if self.episodes and self.pooled else None

    @property
    def interval(self) -> tuple[float, float]:
        """(low, high): `bounds` if there are any, otherwise the Wilson 95 % interval; (0, 1) if
        there is no common rate.
        """
        if not self.pooled:
            return 0.0, 1.0
        return wilson(self.successes, self.episodes) if self.bounds is None else self.bounds

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON: `successes`, `episodes`, `rate`, and the interval.

        The interval is `wilson_95` or, if the evaluation could stop early, `confidence_sequence`
        with its `error_rate`.
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
class Pairs:
    """Counts of the episodes that both A and B ran, by the outcomes of A and B. Two objects can be
    added.

    Raises:
        InvalidInput: A number is negative.
    """

    both: int = 0
    only_a: int = 0
    only_b: int = 0
    neither: int = 0

    def __post_init__(self) -> None:
        if min(self.both, self.only_a, self.only_b, self.neither) < 0:
            raise InvalidInput(f"pairs: expected counts of 0 or more, got {self}")

    def __add__(self, other: Pairs) -> Pairs:
        return Pairs(
            self.both + other.both,
            self.only_a + other.only_a,
            self.only_b + other.only_b,
            self.neither + other.neither,
        )

    @property
    def total(self) -> int:
        """The number of all these episodes."""
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def difference(self) -> float | None:
        """The success rate of A minus the success rate of B, in [-1, 1]; None without episodes."""
        return (self.only_a - self.only_b) / self.total if self.total else None

    @property
    def p_value(self) -> float:
        """The p-value of McNemar's exact test (`mcnemar`); 1 without episodes."""
        return mcnemar(self.only_a, self.only_b)

    def to_json(self) -> dict[str, Any]:
        """Return the four counts for JSON, with `pairs` (their sum), `difference` and `p_value`."""
        counts = {
            "both": self.both,
            "only_a": self.only_a,
            "only_b": self.only_b,
            "neither": self.neither,
        }
        return counts | {
            "pairs": self.total,
            "difference": self.difference,
            "p_value": self.p_value,
        }


def mcnemar(only_a: int, only_b: int, *, mid: bool = False) -> float:
    """Test the hypothesis that A and B solve equally many episodes, using the episodes that only
    one of them solved.

    The test is exact: under the hypothesis, each of these episodes is solved by A or by B with
    probability 1/2, whatever the task, so tasks of different difficulty may be pooled. Q. McNemar,
    "Note on the sampling error of the difference between correlated proportions or percentages",
    Psychometrika 12 (1947).

    Args:
        only_a: The number of episodes that A solved and B did not.
        only_b: The number of episodes that B solved and A did not.
        mid: Count only half of the probability of the observed table. This mid-p test is less
            conservative, but no longer exact. M. W.
            Fagerland, S. Lydersen, P. Laake, "The McNemar test for binary matched-pairs data", BMC
            Medical Research Methodology 13:91 (2013).

    Returns:
        The two-sided p-value, in (0, 1].

    Raises:
        InvalidInput: A number is negative.
    """
    if min(only_a, only_b) < 0:
        raise InvalidInput(
            f"mcnemar: expected counts of 0 or more, got {only_a} and {only_b} episodes"
        )

    n = only_a + only_b
    # The numbers of ways to choose k of n items, and at most k of n items. They are integers, and
    # thus exact for any number of episodes.
    ways = tail = 1
    for k in range(min(only_a, only_b)):
        ways = ways * (n - k) // (k + 1)
        tail += ways

    # Both tails contain the observed table, and each tail counts half of it.
    if mid and n and only_a == only_b:
        return 1.0 - ways / (2 << n)
    return min(1.0, (2 * tail - ways * mid) / (1 << n))


def difference_interval(strata: Sequence[Pairs]) -> tuple[float, float]:
    """Compute the 95 % interval of a difference of success rates on the same episodes.

    The bounds are percentiles of a paired bootstrap: episodes are resampled together with both
    outcomes, separately for each env (a stratum), since each repetition of an evaluation has the
    same number of episodes in an env. B. Efron, R. J. Tibshirani, "An Introduction to the
    Bootstrap" (1993), chapters 8 and 13.

    Two episodes are added, half an episode for each of the four outcomes. Without them, the
    interval would have zero width, which claims certainty, e.g. for 20 of 20 successes against
    none, or if A and B agree in every episode. A. Agresti, Y. Min, "Simple improved confidence
    intervals for comparing matched proportions", Statistics in Medicine 24 (2005).

    No random generator is used. In the limit of infinitely many draws, the difference is a sum of
    independent steps of +1, -1 and 0, whose characteristic function is a product.

    Args:
        strata: The episodes of each env.

    Returns:
        (low, high) of the success rate of A minus the success rate of B, each in [-1, 1]; (-1, 1)
        without episodes.
    """
    n = sum(pairs.total for pairs in strata)
    if n == 0:
        return -1.0, 1.0

    # The sum of n steps is one of 2n + 1 values, from -n to n, so 2n + 1 points of the
    # characteristic function determine its distribution.
    turns = np.exp(2j * np.pi * np.arange(2 * n + 1) / (2 * n + 1))
    characteristic = np.ones_like(turns)
    for pairs in strata:
        if not pairs.total:
            continue
        # The count to add to each of the four outcomes, proportional to the env's number of
        # episodes.
        added = _PSEUDO_EPISODES / 4 * pairs.total / n
        total = pairs.total + 4 * added
        up = (pairs.only_a + added) / total
        down = (pairs.only_b + added) / total
        characteristic *= (up * turns + down / turns + (1 - up - down)) ** pairs.total

    # Values proportional to the probabilities of the sums -n, …, n.
    weights = np.fft.fftshift(np.fft.fft(characteristic).real).clip(min=0.0)
    cumulative = np.cumsum(weights) / weights.sum()
    low, high = np.searchsorted(cumulative, [ERROR_RATE / 2, 1 - ERROR_RATE / 2]) - n
    return float(low / n), float(high / n)


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p-values for their number with Holm's method.

    If every hypothesis with an adjusted p-value below 5 % is rejected, the probability that any of
    these rejections is wrong is at most 5 %, even if the tests depend on one another. S. Holm, "A
    simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6
    (1979).

    Args:
        p_values: The p-value of each test, in [0, 1].

    Returns:
        The adjusted p-values, in the same order.
    """
    adjusted = [0.0] * len(p_values)
    highest = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = highest
    return adjusted


# Number of halvings that make an interval of length 1 shorter than the resolution of a float.
_HALVINGS = 60


def confidence_sequence(
    successes: int, trials: int, error_rate: float = 0.05
) -> tuple[float, float]:
    """Compute an interval of a success probability that is valid after all trials simultaneously.

    It is {p : (n + 1) C(n, s) p^s (1 - p)^(n - s) > error_rate}: H. Robbins, "Statistical Methods
    Related to the Law of the Iterated Logarithm", Ann. Math. Statist. 41 (1970). The method is the
    beta-binomial mixture martingale with a uniform prior. J. Ville's inequality (1939) bounds the
    probability that the martingale ever reaches 1 / error_rate.

    Args:
        successes: The number of successful trials so far.
        trials: The number of trials so far.
        error_rate: The largest probability, in (0, 1), that the interval misses the true value at
            any number of trials.

    Returns:
        (low, high), each in [0, 1]; (0, 1) when there are no trials.

    Raises:
        InvalidInput: `successes` is not in 0 … `trials`.
    """
    if not 0 <= successes <= trials:
        raise InvalidInput(
            f"confidence_sequence: expected 0 <= successes <= trials, got {successes} successes "
            f"in {trials} trials"
        )

    failures = trials - successes
    # The logarithm of (n + 1) C(n, s) / error_rate. The interval contains all p for which s log p +
    # (n - s) log(1 - p) is larger than the negative of this value.
    room = (
        math.lgamma(trials + 2)
        - math.lgamma(successes + 1)
        - math.lgamma(failures + 1)
        - math.log(error_rate)
    )

    def is_inside(p: float) -> bool:
        log_of_successes = successes * math.log(p) if successes else 0.0
        log_of_failures = failures * math.log1p(-p) if failures else 0.0
        return log_of_successes + log_of_failures > -room

    rate = successes / trials if trials else 0.5
    low = 0.0 if not successes else _boundary(is_inside, inside=rate, outside=0.0)
    high = 1.0 if not failures else _boundary(is_inside, inside=rate, outside=1.0)
    return low, high


def pooled(counts: Sequence[tuple[int, int]], error_rate: float) -> tuple[float, float]:
    """Return bounds (low, high) of the success rate of several cases, weighted by their numbers of
    episodes.

    The weights depend on the times at which the cases stop. Therefore each case gets an equal share
    of the error rate: all bounds are then valid simultaneously, and any weighted mean of them is
    valid, too.

    Args:
        counts: The (successes, trials) of each case.
        error_rate: The largest probability, in (0, 1), that the bounds miss the true rate.
    """
    counts = [(successes, trials) for successes, trials in counts if trials]
    total = sum(trials for _, trials in counts)
    if not total:
        return 0.0, 1.0

    pooled_low = pooled_high = 0.0
    for successes, trials in counts:
        low, high = confidence_sequence(successes, trials, error_rate / len(counts))
        share = trials / total
        pooled_low += low * share
        pooled_high += high * share
    return pooled_low, pooled_high


def _boundary(is_inside: Callable[[float], bool], inside: float, outside: float) -> float:
    """Return the first point between `inside` and `outside`, coming from `inside`, that is not
    inside.
    """
    for _ in range(_HALVINGS):
        middle = (inside + outside) / 2
        if middle in (inside, outside):
            break
        if is_inside(middle):
            inside = middle
        else:
            outside = middle
    return outside


def median(values: Iterable[float | None]) -> float | None:
    """Return the median of the values that are not None; None if all values are None."""
    known_values = [value for value in values if value is not None]
    return float(np.median(known_values)) if known_values else None
