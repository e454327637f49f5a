"""Two success rates on the same episodes: their difference, its interval, and whether chance explains it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput

ERROR_RATE = 0.05  # of the intervals
_PSEUDO_EPISODES = 2.0


@dataclass(frozen=True, slots=True)
class Pairs:
    """Episodes that both A and B played, by who solved them."""

    both: int = 0
    only_a: int = 0
    only_b: int = 0
    neither: int = 0

    def __post_init__(self) -> None:
        if min(self.both, self.only_a, self.only_b, self.neither) < 0:
            raise InvalidInput(f"pairs: got {self}, want no count below 0")

    def __add__(self, other: Pairs) -> Pairs:
        return Pairs(
            self.both + other.both,
            self.only_a + other.only_a,
            self.only_b + other.only_b,
            self.neither + other.neither,
        )

    @property
    def total(self) -> int:
        """Episodes in all."""
        return self.both + self.only_a + self.only_b + self.neither

    @property
    def difference(self) -> float | None:
        """Success rate of A less that of B, in [-1, 1]; None without episodes."""
        return (self.only_a - self.only_b) / self.total if self.total else None

    @property
    def p_value(self) -> float:
        """Of McNemar's exact test; 1 without episodes."""
        return mcnemar(self.only_a, self.only_b)

    def to_json(self) -> dict[str, Any]:
        """The counts, `pairs`, `difference` and `p_value`."""
        counts = {"both": self.both, "only_a": self.only_a, "only_b": self.only_b, "neither": self.neither}
        return counts | {"pairs": self.total, "difference": self.difference, "p_value": self.p_value}


def mcnemar(only_a: int, only_b: int, *, mid: bool = False) -> float:
    """Two-sided p-value of "A and B solve equally many" from the episodes that only one of them solved.

    Exact: under the hypothesis each such episode is A's or B's with probability 1/2, whatever the tasks are, so that
    tasks of different difficulty may be pooled. Q. McNemar, "Note on the sampling error of the difference between
    correlated proportions or percentages", Psychometrika 12 (1947).

    `mid` counts the observed table half: less conservative, and no longer exact. M. W. Fagerland, S. Lydersen,
    P. Laake, "The McNemar test for binary matched-pairs data", BMC Medical Research Methodology 13:91 (2013).
    """
    if min(only_a, only_b) < 0:
        raise InvalidInput(f"mcnemar: got {only_a} and {only_b} episodes, want no count below 0")
    n = only_a + only_b
    ways = tail = 1  # to choose k of n, and up to k of n: integers, so that nothing is lost however many episodes
    for k in range(min(only_a, only_b)):
        ways = ways * (n - k) // (k + 1)
        tail += ways
    return min(1.0, (2 * tail - ways * mid) / (1 << n))


def difference_interval(strata: Sequence[Pairs]) -> tuple[float, float]:
    """95 % interval of the difference of success rates, A less B; (-1, 1) without episodes.

    Percentiles of a paired bootstrap: episodes are drawn again with what both made of them, env by env (a stratum
    each), as an evaluation has the same number of episodes of an env however often it is repeated. B. Efron,
    R. J. Tibshirani, "An Introduction to the Bootstrap" (1993), chapters 8 and 13.

    It draws as if two more episodes had been seen, half a one of each outcome: else 20 of 20 against none, or no
    episode that tells A from B, would give an interval of no width, which claims certainty. A. Agresti, Y. Min, "Simple
    improved confidence intervals for comparing matched proportions", Statistics in Medicine 24 (2005).

    Nothing is left to a random generator: what infinitely many draws come to is the distribution of a sum of
    independent steps of +1, -1 and 0, whose characteristic function is a product.
    """
    n = sum(one.total for one in strata)
    if n == 0:
        return -1.0, 1.0
    turns = np.exp(2j * np.pi * np.arange(2 * n + 1) / (2 * n + 1))  # (2n + 1,), one for each sum from -n to n
    transformed = np.ones_like(turns)
    for one in strata:
        more = _PSEUDO_EPISODES / 4 * one.total / n  # of each outcome: as many of an env as it has of all episodes
        a, b = ((only + more) / (one.total + 4 * more) if one.total else 0.0 for only in (one.only_a, one.only_b))
        transformed *= (a * turns + b / turns + (1 - a - b)) ** one.total
    chances = np.fft.fftshift(np.fft.fft(transformed).real).clip(min=0.0)  # in proportion, of -n, …, n
    low, high = np.searchsorted(np.cumsum(chances) / chances.sum(), [ERROR_RATE / 2, 1 - ERROR_RATE / 2]) - n
    return float(low / n), float(high / n)


def holm(p_values: Sequence[float]) -> list[float]:
    """P-values adjusted for their number: whoever rejects those below 5 % errs in any at all with 5 % at most.

    S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of Statistics 6 (1979).
    It assumes nothing of how the tests depend on one another.
    """
    adjusted = [0.0] * len(p_values)
    highest = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = highest
    return adjusted
