"""The figures of measurements: medians, intervals and ratios without assuming a distribution; a picture; two runs."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import os
import platform
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

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
        return float(np.median(self.ms))

    def to_json(self) -> dict[str, Any]:
        return {
            "way": self.name,
            "calls": len(self.ms),
            "median_ms": self.median,
            "ci95_ms": list(median_interval(self.ms)),
            "p99_ms": float(np.quantile(self.ms, 0.99)),
        }


class Ratio(NamedTuple):
    """A median over another, with its 95 % bootstrap interval."""

    ratio: float
    low: float
    high: float


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
    found = {a.name: {b.name: median_ratio(a, b) for b in theirs} for a in ours}
    return {
        a: {b: {"ratio": one.ratio, "ci95": [one.low, one.high]} for b, one in row.items()} for a, row in found.items()
    }


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


PACKAGES = ("vlagents-ray", "ray", "numpy", "torch", "jax", "transformers", "lerobot")


def measured_on(program: str = "vlagents-ray") -> dict[str, Any]:
    """Return date, command, machine and versions as JSON values; call it before measuring, as it states the load."""
    return {
        "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
        "command": " ".join([program, shlex.join(sys.argv[1:])]).rstrip(),
        "machine": _machine(),
        "versions": _versions() | {"Python": platform.python_version()},
    }


def _versions() -> dict[str, str]:
    installed = {one.metadata["Name"]: one.version for one in importlib.metadata.distributions()}
    return {name: installed[name] for name in PACKAGES if name in installed}


def _machine() -> dict[str, Any]:
    """Return the machine's description, without host or user names."""
    cpu = platform.processor() or platform.machine()
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        if line.startswith("model name"):
            cpu = line.partition(":")[2].strip()
            break
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "memory_gb": round(memory / 2**30),
        "kernel": platform.release().partition("-")[0],
        "load": os.getloadavg()[0],
    }


_NAMES = ("way", "clients", "batch")  # keys of which one names a row of a list
_COMPARED = ("_ms", "_per_s", "_mib", "of_ideal", "mean_batch", "_bytes", "wall_s", "per_minute")  # ends of their names
_SAME = ("cpu", "cores", "memory_gb", "kernel")  # of the machine


@dataclass(frozen=True, slots=True)
class ComparedFigure:
    """One figure of both files."""

    name: str  # its place in the files, with spaced slashes
    old: float
    new: float
    overlap: bool | None = None  # whether the 95 % intervals of both overlap; None: they have none

    @property
    def ratio(self) -> float:
        """The new figure over the old one; 1 if both are the same, also if both are 0."""
        if self.new == self.old:
            return 1.0
        return self.new / self.old if self.old else float("inf")


@dataclass(frozen=True, slots=True)
class FigureComparison:
    """The common figures of two files, and their other differences."""

    figures: tuple[ComparedFigure, ...]
    only_old: tuple[str, ...]  # figures that one file alone has
    only_new: tuple[str, ...]
    circumstances: tuple[str, ...]  # differences of machines and versions, a sentence each


def compare_figures(old: Mapping[str, Any], new: Mapping[str, Any]) -> FigureComparison:
    """Compare the figures of two measurements, in the order of the new one."""
    before, after = dict(_figures(old)), dict(_figures(new))
    figures = [
        ComparedFigure(name, before[name][0], value, _overlap(before[name][1], interval))
        for name, (value, interval) in after.items()
        if name in before
    ]
    return FigureComparison(
        tuple(figures),
        tuple(name for name in before if name not in after),
        tuple(name for name in after if name not in before),
        tuple(_circumstances(old, new)),
    )


def read_figures(file: Path) -> dict[str, Any]:
    """Read a file of figures; raises `ConfigError` for any other file."""
    try:
        found = json.loads(file.read_text())
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read ({error}); want what `bench … --json FILE` wrote") from error
    if not isinstance(found, dict) or not any(True for _ in _figures(found)):
        raise ConfigError(f"{file}: holds no figures; want what `bench … --json FILE` wrote")
    return found


def _figures(node: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, tuple[float, Any]]]:
    """Yield name, value and 95 % interval of each figure below a node of JSON."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            if isinstance(value, int | float) and not isinstance(value, bool) and key.endswith(_COMPARED):
                interval = node.get(f"ci95{key.removeprefix('median')}") if key.startswith("median") else None
                yield " / ".join((*path, key)), (float(value), interval)
            elif isinstance(value, Mapping | list):
                yield from _figures(value, (*path, key))
    elif isinstance(node, list):
        for one in node:
            if isinstance(one, Mapping) and (name := next((key for key in _NAMES if key in one), None)) is not None:
                label = str(one[name]) if name == "way" else f"{name} {one[name]}"
                yield from _figures(one, (*path, label))


def _overlap(old: Any, new: Any) -> bool | None:
    if old is None or new is None:
        return None
    return bool(old[0] <= new[1] and new[0] <= old[1])


def _circumstances(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    for part, names in (("machine", _SAME), ("versions", None)):
        before, after = old.get(part) or {}, new.get(part) or {}
        if not before or not after:
            continue
        for name in names or sorted({*before, *after}):
            if before.get(name) != after.get(name):
                yield f"{name}: {before.get(name, 'none')} before, {after.get(name, 'none')} now"
