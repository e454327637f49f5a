"""Medians, their intervals, and ratios of medians, without assuming a distribution."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

RESAMPLES = 2000


@dataclass(frozen=True, slots=True)
class RoundTrips:
    """Milliseconds of each call by one way, by round: what one way did while it was its turn."""

    name: str
    rounds: np.ndarray  # (rounds, calls of each) float64, ms

    @property
    def ms(self) -> np.ndarray:
        """All calls, (N,) float64, ms."""
        return self.rounds.reshape(-1)

    @property
    def median(self) -> float:
        """Half of the calls took less, ms."""
        return float(np.median(self.ms))

    @property
    def p99(self) -> float:
        """One call in a hundred took longer, ms."""
        return float(np.quantile(self.ms, 0.99))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the median, ms."""
        return median_interval(self.ms)

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {
            "way": self.name,
            "calls": len(self.ms),
            "median_ms": self.median,
            "ci95_ms": list(self.interval),
            "p99_ms": self.p99,
        }


@dataclass(frozen=True, slots=True)
class Ratio:
    """A median over another, with its 95 % bootstrap interval."""

    ratio: float
    low: float
    high: float

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {"ratio": self.ratio, "ci95": [self.low, self.high]}


def median_interval(values: np.ndarray) -> tuple[float, float]:
    """95 % confidence interval of the median, from order statistics: nothing but independence is assumed."""
    ordered = np.sort(values)
    n = len(ordered)
    half = 0.98 * np.sqrt(n)  # 1.96 standard deviations of a binomial with p = 1/2
    low, high = int(max(0, np.floor(n / 2 - half))), int(min(n - 1, np.ceil(n / 2 + half)))
    return float(ordered[low]), float(ordered[high])


def median_ratio(ours: RoundTrips, theirs: RoundTrips, *, seed: int = 0) -> Ratio:
    """The ratio of the two medians.

    Whole rounds are drawn again, the same of both, because calls of one round, and the rounds that
    follow one another, have in common what else the machine does. Raises `ValueError` unless both
    have the same number of rounds.
    """
    if len(ours.rounds) != len(theirs.rounds):
        raise ValueError(f"rounds: got {len(ours.rounds)} and {len(theirs.rounds)}; measure both in one run")
    n = len(ours.rounds)
    drawn = np.random.default_rng(seed).integers(0, n, (RESAMPLES, n))
    medians = [np.median(trips.rounds[drawn].reshape(RESAMPLES, -1), axis=1) for trips in (ours, theirs)]
    low, high = np.quantile(medians[0] / medians[1], [0.025, 0.975])
    return Ratio(ours.median / theirs.median, float(low), float(high))


def ratios(ours: Sequence[RoundTrips], theirs: Sequence[RoundTrips]) -> dict[str, dict[str, Any]]:
    """Every one of ours over every one of theirs, as JSON: {ours: {theirs: ratio}}."""
    return {a.name: {b.name: median_ratio(a, b).to_json() for b in theirs} for a in ours}


def lost_db(images: Mapping[str, np.ndarray], sent: Mapping[str, np.ndarray]) -> float | None:
    """Peak signal-to-noise ratio of all images together, dB: how near to what was `sent` they are; None if equal."""
    squares = [(images[name].astype(np.float64) - sent[name]) ** 2 for name in sent]
    error = float(np.mean([np.mean(one) for one in squares]))
    return None if error == 0 else float(10 * np.log10(255**2 / error))
