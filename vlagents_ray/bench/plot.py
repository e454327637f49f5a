"""Figures as pictures: medians with their intervals, and replicas that follow their load."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

SUFFIXES = (".png", ".svg", ".pdf")
_OURS, _THEIRS, _SESSIONS = "#1f6f8b", "#b0b0b0", "#e0a030"


def check(file: Path | None) -> None:
    """Raises `ConfigError` for a suffix that is not .png, .svg or .pdf, `MissingDependency` without matplotlib."""
    if file is None:
        return
    if file.suffix not in SUFFIXES:
        raise ConfigError(f"--plot: got {file.name!r}, want a name that ends in one of {list(SUFFIXES)}")
    require("matplotlib")


def plot_round_trips(found: Mapping[str, Any], file: Path, title: str = "round trip of one act") -> None:
    """Horizontal bars, the fastest on top, on a logarithmic axis; ours in colour. Raises as `check` does."""
    check(file)
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
        color=[_OURS if way["way"] in ours else _THEIRS for way in rows],
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


def plot_autoscaling(found: Mapping[str, Any], file: Path) -> None:
    """Over time: replicas and sessions above, how long acts took below. Raises as `check` does."""
    check(file)
    figure = require("matplotlib.figure").Figure(figsize=(9, 5), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    times = [one["at"] for one in found["samples"]]
    for name, colour, style in (("wanted", _THEIRS, "--"), ("running", _OURS, "-")):
        numbers = [one[name] for one in found["samples"]]
        above.step(times, numbers, style, where="post", color=colour, label=f"replicas {name}")
    above.set_ylabel("replicas")
    sessions = above.twinx()
    sessions.fill_between(
        times, [one["sessions"] for one in found["samples"]], step="post", color=_SESSIONS, alpha=0.25, lw=0
    )
    sessions.set_ylabel("sessions (shaded)")
    above.legend(loc="upper left", fontsize=8, frameon=False)
    for phase in found["phases"]:
        at = [one["at"] for one in phase["seconds"]]
        below.plot(at, [one["median_ms"] for one in phase["seconds"]], ".-", color=_OURS, markersize=3)
        below.plot(at, [one["p95_ms"] for one in phase["seconds"]], ".", color=_THEIRS, markersize=3)
        waited = "" if phase["first_reset_s"] is None else f"\nfirst reset {phase['first_reset_s']:.1f} s"
        text = f"{phase['name']}\n{len(phase['failed'])} failed{waited}"
        below.annotate(text, (phase["begun"], 1.0), xycoords=("data", "axes fraction"), va="top", fontsize=7)
        for axes in (above, below):
            axes.axvspan(phase["begun"], phase["ended"], color="#000000", alpha=0.04, lw=0)
    below.set_ylim(0, 1.6 * max(one["p95_ms"] for phase in found["phases"] for one in phase["seconds"]))
    below.set_ylabel("an act, ms (grey: 95 %)")
    below.set_xlabel("s since the first robot came")
    for axes in (above, below, sessions):
        axes.spines[["top"]].set_visible(False)
    figure.savefig(file, dpi=100)
