"""Statistics of success: rates and their paired comparison.

Episodes that begin in the same initial state, a **start**, are not independent: two deterministic
policies repeat the same episodes. Intervals and tests are therefore over starts, as if all episodes
of a start had the same outcome. A. Donner, N. Klar, "Design and Analysis of Cluster Randomization
Trials in Health Research" (2000).

A confidence sequence is valid at all numbers of episodes simultaneously: the probability that it
ever misses the true rate is at most the error rate, so the evaluation may stop after any episode.
An interval for a fixed number of episodes, such as Wilson's, is not valid if the number depends on
the outcomes.
"""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput
from vlagents_ray.success import wilson

ERROR_RATE = 0.05  # probability that an interval misses the true value
_PSEUDO_STARTS = 2.0


def independent_episodes(repeats: Iterable[int]) -> float:
    """Return the number of independent episodes that give the same precision as episodes of
    repeated starts, if all episodes of a start have the same outcome.

    It is n² / Σ m² for n episodes: L. Kish, "Survey Sampling" (1965), for an intraclass correlation
    of 1. It is the number of starts if each start has equally many episodes.

    Args:
        repeats: The number m of episodes of each start.
    """
    numbers = list(repeats)
    squares = sum(number * number for number in numbers)
    return sum(numbers) ** 2 / squares if squares else 0.0


@dataclass(frozen=True, slots=True)
class Rate:
    """The number of successes among episodes, with an interval of the true success rate."""

    successes: int
    episodes: int
    # The confidence sequence and its error rate (`confidence_sequence`), if the number of episodes
    # may depend on their outcomes.
    bounds: tuple[float, float] | None = None
    error_rate: float | None = None
    # Whether the cases of these episodes have a common rate; otherwise `rate` is None.
    pooled: bool = True
    # The number of further episodes that infrastructure lost; the interval contains the rates for
    # all of their possible outcomes.
    lost: int = 0
    # Independent episodes, with the lost ones (`independent_episodes`); None: all are independent.
    independent: float | None = None

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
        if self.bounds is not None:
            return self.bounds
        return with_any_outcome(wilson, self.successes, self.episodes, self.lost, self.independent)

    def to_json(self) -> dict[str, Any]:
        """Return the fields for JSON: `successes`, `episodes`, `rate`, and the interval.

        The interval is `wilson_95` or, if the number of episodes may depend on their outcomes,
        `confidence_sequence` with its `error_rate`.
        """
        independent = self.episodes + self.lost if self.independent is None else self.independent
        counts = {
            "successes": self.successes,
            "episodes": self.episodes,
            "independent": independent,
            "rate": self.rate,
        }
        if self.bounds is None:
            return counts | {"wilson_95": list(self.interval)}
        return counts | {"confidence_sequence": list(self.interval), "error_rate": self.error_rate}

    def __str__(self) -> str:
        if self.rate is None:
            return "-"
        low, high = self.interval
        return f"{self.rate:.0%} [{100 * low:.0f}, {100 * high:.0f}]"


def with_any_outcome(
    interval: Callable[[float, float], tuple[float, float]],
    successes: int,
    episodes: int,
    lost: int,
    independent: float | None = None,
) -> tuple[float, float]:
    """Return the interval of a rate that contains the intervals for all outcomes of lost episodes.

    What breaks a simulator may depend on the policy, so nothing is assumed about these outcomes.
    J. L. Horowitz, C. F. Manski, "Nonparametric Analysis of Randomized Experiments with Missing
    Covariate and Outcome Data", JASA 95 (2000).

    Args:
        interval: `wilson` or `confidence_sequence`, of (successes, trials).
        successes: The number of successes among the finished episodes.
        episodes: The number of finished episodes.
        lost: The number of lost episodes.
        independent: The number of independent episodes, with the lost ones; None: all of them.
    """
    planned = episodes + lost
    trials = planned if independent is None else independent
    if not planned or trials == planned:
        return interval(successes, planned)[0], interval(successes + lost, planned)[1]
    low, _ = interval(successes / planned * trials, trials)
    _, high = interval((successes + lost) / planned * trials, trials)
    return low, high


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
    def failures_of_a(self) -> int:
        """The number of episodes that A did not solve; B solved `only_b` of them."""
        return self.only_b + self.neither

    @property
    def net(self) -> int:
        """The number of episodes that only A solved, minus those that only B solved."""
        return self.only_a - self.only_b

    @property
    def difference(self) -> float | None:
        """The success rate of A minus the success rate of B, in [-1, 1]; None without episodes."""
        return self.net / self.total if self.total else None

    @property
    def starts(self) -> Starts:
        """The starts of these pairs, if no start is repeated."""
        return Counter(
            {
                Pairs(both=1): self.both,
                Pairs(only_a=1): self.only_a,
                Pairs(only_b=1): self.only_b,
                Pairs(neither=1): self.neither,
            }
        )

    def to_json(self) -> dict[str, Any]:
        """Return the four counts for JSON, with `pairs` (their sum) and `difference`."""
        counts = {
            "both": self.both,
            "only_a": self.only_a,
            "only_b": self.only_b,
            "neither": self.neither,
        }
        return counts | {"pairs": self.total, "difference": self.difference}


# The number of starts for each possible result of a start, which is the pairs of its episodes.
Starts = Mapping[Pairs, int]


def sum_of(strata: Iterable[Starts]) -> Pairs:
    """Return the counts over all starts."""
    both = only_a = only_b = neither = 0
    for starts in strata:
        for pairs, number in starts.items():
            both += number * pairs.both
            only_a += number * pairs.only_a
            only_b += number * pairs.only_b
            neither += number * pairs.neither
    return Pairs(both, only_a, only_b, neither)


def paired_test(strata: Iterable[Starts]) -> float:
    """Test the hypothesis that A and B solve equally many episodes.

    The test is exact: under the hypothesis, A and B could be exchanged in each start, so its
    difference of solved episodes has either sign with probability 1/2, whatever the task. R. A.
    Fisher, "The Design of Experiments" (1935), section 21; M. H. Gail et al., "On design
    considerations and randomization-based inference for community intervention trials", Statistics
    in Medicine 15 (1996). It is McNemar's exact test (`mcnemar`) if no start is repeated.

    Args:
        strata: The starts of each env.

    Returns:
        The two-sided p-value, in [0, 1]; 1 without episodes.
    """
    for_a: Counter[int] = Counter()  # number of starts by the size of their difference
    for_b: Counter[int] = Counter()
    for starts in strata:
        for pairs, number in starts.items():
            if pairs.net:
                (for_a if pairs.net > 0 else for_b)[abs(pairs.net)] += number
    sizes = sorted(for_a.keys() | for_b.keys())
    if len(sizes) <= 1:
        return mcnemar(for_a.total(), for_b.total())

    # The distribution of the sum of all differences with random signs, at -total, …, total.
    distribution = np.ones(1)
    for size in sizes:
        number = for_a[size] + for_b[size]
        of_size = np.zeros(2 * size * number + 1)
        of_size[:: 2 * size] = _fair_binomial(number)
        distribution = np.convolve(distribution, of_size)
    total = len(distribution) // 2
    net = abs(sum(size * (for_a[size] - for_b[size]) for size in sizes))
    return min(1.0, float(2 * distribution[total + net :].sum()) if net else 1.0)


def _fair_binomial(n: int) -> np.ndarray:
    """Return the probabilities of 0, …, n heads of n fair coins, (n + 1,)."""
    logs = np.array(
        [math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1) for k in range(n + 1)]
    )
    weights: np.ndarray = np.exp(logs - n * math.log(2))
    weights /= weights.sum()
    return weights


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


def difference_interval(strata: Sequence[Starts]) -> tuple[float, float]:
    """Compute the 95 % interval of a difference of success rates on the same episodes.

    The bounds are percentiles of a paired bootstrap: starts are resampled together with the
    outcomes of both policies, separately for each env (a stratum), since each repetition of an
    evaluation has the same number of starts in an env. B. Efron, R. J. Tibshirani, "An Introduction
    to the Bootstrap" (1993), chapters 8 and 13; for starts with several episodes: A. C. Davison,
    D. V. Hinkley, "Bootstrap Methods and their Application" (1997), section 3.8.

    Two starts are added, half a start for each of the four outcomes. Without them, the interval
    would have zero width, which claims certainty, e.g. for 20 of 20 successes against none, or if A
    and B agree in every episode. A. Agresti, Y. Min, "Simple improved confidence intervals for
    comparing matched proportions", Statistics in Medicine 24 (2005).

    No random generator is used. In the limit of infinitely many draws, the difference is a sum of
    independent steps, the difference of each start, whose characteristic function is a product.

    Args:
        strata: The starts of each env.

    Returns:
        (low, high) of the success rate of A minus the success rate of B, each in [-1, 1]; (-1, 1)
        without episodes.
    """
    strata = [{pairs: number for pairs, number in starts.items() if number} for starts in strata]
    starts_in_all = sum(sum(starts.values()) for starts in strata)
    if not starts_in_all:
        return -1.0, 1.0

    # The sum of the differences is between -most and most, so 2 most + 1 points of the
    # characteristic function determine its distribution. An added start has as many episodes as
    # the largest one of its env.
    sizes = [max((pairs.total for pairs in starts), default=0) for starts in strata]
    most = sum(size * sum(starts.values()) for size, starts in zip(sizes, strata, strict=True))
    angles = np.arange(2 * most + 1) / (2 * most + 1)
    characteristic = np.ones_like(angles, dtype=complex)
    for size, starts in zip(sizes, strata, strict=True):
        number_of_starts = sum(starts.values())
        if not number_of_starts:
            continue
        # The count to add to each of the four outcomes, proportional to the env's number of starts.
        added = _PSEUDO_STARTS / 4 * number_of_starts / starts_in_all
        steps: Counter[int] = Counter()
        for pairs, number in starts.items():
            steps[pairs.net] += number
        weights: dict[int, float] = dict(steps)
        for step, times in ((size, 1), (-size, 1), (0, 2)):
            weights[step] = weights.get(step, 0.0) + times * added

        total = number_of_starts + 4 * added
        of_start = np.zeros_like(characteristic)
        for step, weight in weights.items():
            of_start += weight / total * np.exp(2j * np.pi * step * angles)
        characteristic *= of_start**number_of_starts

    # Values proportional to the probabilities of the sums -most, …, most.
    probabilities = np.fft.fftshift(np.fft.fft(characteristic).real).clip(min=0.0)
    cumulative = np.cumsum(probabilities) / probabilities.sum()
    low, high = np.searchsorted(cumulative, [ERROR_RATE / 2, 1 - ERROR_RATE / 2]) - most
    episodes = sum_of(strata).total
    return max(-1.0, float(low / episodes)), min(1.0, float(high / episodes))


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
    successes: float, trials: float, error_rate: float = ERROR_RATE
) -> tuple[float, float]:
    """Compute an interval of a success probability that is valid after all trials simultaneously.

    It is {p : (n + 1) C(n, s) p^s (1 - p)^(n - s) > error_rate}: H. Robbins, "Statistical Methods
    Related to the Law of the Iterated Logarithm", Ann. Math. Statist. 41 (1970). The method is the
    beta-binomial mixture martingale with a uniform prior. J. Ville's inequality (1939) bounds the
    probability that the martingale ever reaches 1 / error_rate.

    Args:
        successes: The number of successful trials so far; a fraction if starts are repeated.
        trials: The number of trials so far, or of independent trials (`independent_episodes`).
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


def pooled(rates: Sequence[Rate], error_rate: float) -> tuple[float, float]:
    """Return bounds (low, high) of the success rate of several cases, weighted by their numbers of
    episodes.

    The weights depend on the times at which the cases stop. Therefore each case gets an equal share
    of the error rate: all bounds are then valid simultaneously, and any weighted mean of them is
    valid, too.

    Args:
        rates: The rate of each case.
        error_rate: The largest probability, in (0, 1), that the bounds miss the true rate.
    """
    rates = [rate for rate in rates if rate.episodes + rate.lost]
    total = sum(rate.episodes + rate.lost for rate in rates)
    if not total:
        return 0.0, 1.0

    def sequence(successes: float, trials: float) -> tuple[float, float]:
        return confidence_sequence(successes, trials, error_rate / len(rates))

    pooled_low = pooled_high = 0.0
    for rate in rates:
        low, high = with_any_outcome(
            sequence, rate.successes, rate.episodes, rate.lost, rate.independent
        )
        share = (rate.episodes + rate.lost) / total
        pooled_low += low * share
        pooled_high += high * share
    return pooled_low, pooled_high


# Number of points of the Gauss-Legendre quadrature in `_log_capital`. It is exact for fewer starts
# than twice this number.
_POINTS = 512


@functools.cache
def _quadrature() -> tuple[np.ndarray, np.ndarray]:
    """Return the points in (0, 1) and the logarithms of their weights."""
    points, weights = np.polynomial.legendre.leggauss(_POINTS)
    return (points + 1) / 2, np.log(weights / 2)


def _log_capital(values: Mapping[float, int], mean: float) -> float:
    """Return the logarithm of a bettor's capital against the hypothesis that numbers in [0, 1] have
    the mean `mean`.

    The capital begins with 1, and is a martingale under the hypothesis: I. Waudby-Smith, A. Ramdas,
    "Estimating Means of Bounded Random Variables by Betting", JRSS B 86 (2024). Bets are averaged
    uniformly; for numbers that are 0 or 1 this is the martingale of `confidence_sequence`.

    Args:
        values: How often each number occurred.
        mean: The mean, in (0, 1).
    """
    points, logs = _quadrature()
    bets = (points - mean) / (mean * (1 - mean))
    logs = logs.copy()
    for value, number in values.items():
        logs += number * np.log1p(bets * (value - mean))
    return float(np.logaddexp.reduce(logs))


def _shares(strata: Iterable[Starts]) -> Counter[float]:
    """Return the difference of each start, from 0 (only B solved its episodes) to 1 (only A did),
    and how often it occurred.
    """
    shares: Counter[float] = Counter()
    for starts in strata:
        for pairs, number in starts.items():
            if number:
                shares[(1 + pairs.net / pairs.total) / 2] += number
    return shares


def sequential_test(strata: Iterable[Starts]) -> float:
    """Test the hypothesis of `paired_test` if the number of episodes may depend on the outcomes.

    The probability that the p-value is ever 5 % or less, at any number of episodes, is at most 5 %
    (Ville's inequality).

    Args:
        strata: The starts of each env.

    Returns:
        The p-value, in [0, 1]; 1 without episodes.
    """
    return math.exp(min(0.0, -_log_capital(_shares(strata), 0.5)))


def sequential_difference_interval(strata: Sequence[Starts]) -> tuple[float, float]:
    """Compute the interval of `difference_interval` as a confidence sequence, which is valid if the
    number of episodes depends on the outcomes.

    Envs are weighted by their numbers of starts, so these must grow in the same proportion.

    Args:
        strata: The starts of each env.

    Returns:
        (low, high) of the success rate of A minus the success rate of B, each in [-1, 1]; (-1, 1)
        without episodes.
    """
    shares = _shares(strata)
    number = shares.total()
    if not number:
        return -1.0, 1.0
    mean = sum(share * times for share, times in shares.items()) / number
    room = -math.log(ERROR_RATE)

    def is_inside(candidate: float) -> bool:
        return 0.0 < candidate < 1.0 and _log_capital(shares, candidate) < room

    low = 0.0 if mean == 0.0 else _boundary(is_inside, inside=mean, outside=0.0)
    high = 1.0 if mean == 1.0 else _boundary(is_inside, inside=mean, outside=1.0)
    return 2 * low - 1, 2 * high - 1


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
