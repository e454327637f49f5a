"""Medians with their intervals, as a picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

SUFFIXES = (".png", ".svg", ".pdf")
_OURS, _THEIRS = "#1f6f8b", "#b0b0b0"


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
