"""The picture of `tune`: latency against throughput."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from vlagents_ray.bench.figures import check_plot_file
from vlagents_ray.bench.tuning.choice import MeasuredPoint, TuningGoal
from vlagents_ray.registry import require


def plot_latency(
    points: Sequence[MeasuredPoint],
    chosen: MeasuredPoint | None,
    default: MeasuredPoint | None,
    goal: TuningGoal,
    file: Path,
    title: str,
) -> None:
    """Draw a line for each variant through its numbers of sessions, p99 of the round trip over actions a second.

    Raises:
        MissingDependency: Matplotlib is not installed.
    """
    check_plot_file(file)
    figure = require("matplotlib.figure").Figure(figsize=(8, 5), layout="constrained")
    axes = figure.subplots()
    for variant in {one.variant.name: one.variant for one in points}.values():
        own = sorted((one for one in points if one.variant is variant), key=lambda one: one.sessions)
        axes.plot([one.actions_per_s for one in own], [one.p99_ms for one in own], marker="o", label=variant.name)
        for one in own:
            axes.annotate(
                str(one.sessions), (one.actions_per_s, one.p99_ms), (5, -11), textcoords="offset points", fontsize=8
            )
    for point, label, size in ((default, "the file as it was", 12), (chosen, "chosen", 16)):
        if point is not None:
            x, y = point.actions_per_s, point.p99_ms
            axes.plot([x], [y], linestyle="", marker="o", markersize=size, fillstyle="none", color="#303030")
            axes.annotate(label, (x, y), (10, 8), textcoords="offset points", fontsize=9)
    if goal.p99_ms is not None:
        axes.axhline(goal.p99_ms, color="#b0b0b0", linestyle="--", label=f"{goal.p99_ms:g} ms")
    axes.set_xlabel("actions a second")
    axes.set_ylabel("p99 of the round trip, ms")
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    axes.margins(x=0.1, y=0.1)
    axes.set_title(title, loc="left", fontsize=10)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8, title="numbers at points: sessions", title_fontsize=8)
    figure.savefig(file, dpi=150)
