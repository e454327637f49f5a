"""Round trips as figures: medians, their intervals and ratios, without assuming a distribution; and as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

RESAMPLES = 2000
SUFFIXES = (".png", ".svg", ".pdf")
OURS, THEIRS = "#1f6f8b", "#b0b0b0"  # colours


@dataclass(frozen=True, slots=True)
class RoundTrips:
    """Milliseconds of each call of one client, by the rounds in which it was its turn."""

    name: str
    rounds: np.ndarray  # (rounds, calls of each) float64, ms

    @property
    def ms(self) -> np.ndarray:
        """The times of all calls, (N,) float64, ms."""
        return self.rounds.reshape(-1)

    @property
    def median(self) -> float:
        """Return the median, ms."""
        return float(np.median(self.ms))

    @property
    def p99(self) -> float:
        """The 99th percentile, ms."""
        return float(np.quantile(self.ms, 0.99))

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % confidence interval of the median, ms."""
        return median_interval(self.ms)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
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
        """Return plain JSON values."""
        return {"ratio": self.ratio, "ci95": [self.low, self.high]}


def median_interval(values: np.ndarray) -> tuple[float, float]:
    """Return the 95 % confidence interval of the median, from order statistics: only independence is assumed."""
    ordered = np.sort(values)
    n = len(ordered)
    half = 0.98 * np.sqrt(n)  # 1.96 standard deviations of a binomial with p = 1/2
    low, high = int(max(0, np.floor(n / 2 - half))), int(min(n - 1, np.ceil(n / 2 + half)))
    return float(ordered[low]), float(ordered[high])


def median_ratio(ours: RoundTrips, theirs: RoundTrips, *, seed: int = 0) -> Ratio:
    """Return the ratio of the two medians.

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
    """Return the ratios of all of ours to all of theirs, as JSON: {ours: {theirs: ratio}}."""
    return {a.name: {b.name: median_ratio(a, b).to_json() for b in theirs} for a in ours}


def rate_of(calls: Sequence[Sequence[tuple[float, ...]]]) -> float:
    """Return actions a second: the slope of the line through all ends of calls.

    They come in batches, so that counting them in a time would be wrong by up to a batch. 0 for fewer than two calls.

    Args:
        calls: The calls of each client; the first number of a call is its end, s.
    """
    ends = np.sort([call[0] for one in calls for call in one])
    if len(ends) < 2 or ends[0] == ends[-1]:
        return 0.0
    return float(np.polyfit(ends - ends[0], np.arange(len(ends)), 1)[0])


def lost_db(images: Mapping[str, np.ndarray], sent: Mapping[str, np.ndarray]) -> float | None:
    """Return the peak signal-to-noise ratio of all images against what was `sent`, dB; None if they are equal."""
    squares = [(images[name].astype(np.float64) - sent[name]) ** 2 for name in sent]
    error = float(np.mean([np.mean(one) for one in squares]))
    return None if error == 0 else float(10 * np.log10(255**2 / error))


def check_plot_file(file: Path | None) -> None:
    """Raise `ConfigError` for a suffix that is not .png, .svg or .pdf, `MissingDependency` without matplotlib."""
    if file is None:
        return
    if file.suffix not in SUFFIXES:
        raise ConfigError(f"--plot: got {file.name!r}, want a name that ends in one of {list(SUFFIXES)}")
    require("matplotlib")


def plot_round_trips(found: Mapping[str, Any], file: Path, title: str = "round trip of one act") -> None:
    """Draw bars, the fastest on top, on a logarithmic axis; ours in colour. Raises as `check_plot_file` does."""
    check_plot_file(file)
    figure_of = require("matplotlib.figure").Figure
    ours = {way["way"] for way in found["ways"]}
    rows = sorted([*found["ways"], *found["peers"]], key=lambda way: float(way["median_ms"]), reverse=True)
    medians = [way["median_ms"] for way in rows]
    below = [way["median_ms"] - way["ci95_ms"][0] for way in rows]
    above = [way["ci95_ms"][1] - way["median_ms"] for way in rows]
    figure = figure_of(figsize=(8, 0.4 * len(rows) + 1.2), layout="constrained")
    axes = figure.subplots()
    axes.barh(
        [way["way"] for way in rows],
        medians,
        color=[OURS if way["way"] in ours else THEIRS for way in rows],
        xerr=[below, above],
        error_kw={"elinewidth": 1, "capsize": 3, "ecolor": "#303030"},
    )
    for number, way in enumerate(rows):
        axes.annotate(
            f"{way['median_ms']:.2f}",
            (way["ci95_ms"][1], number),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    axes.set_xscale("log")
    axes.margins(x=0.15)
    axes.set_xlabel("median, ms (bars: 95 % interval)")
    axes.set_title(f"{title}, two 224x224 RGB cameras", loc="left", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(file, dpi=150)
