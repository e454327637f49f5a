"""The pictures of the measurements, drawn from stored results.

`python -m benchmarks.picture` draws all of them again: the round trips and the throughput of all
systems, the robots that each system serves in time, the success of learners, and autoscaling.

The colours of an SVG follow the reader's light or dark scheme, background included.
"""

from __future__ import annotations

import io
import itertools
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vlagents_ray.cli.console import errors, out
from vlagents_ray.registry import require

ROOT = Path(__file__).parents[1]
# Name, colour on a light background, and colour on a dark background; the colours are those of the
# report.
_COLOURS = {
    "paper": ("#ffffff", "#12161b"),
    "ink": ("#1b1f24", "#e8ebef"),
    "soft": ("#59636e", "#9aa5b1"),
    "rule": ("#d5dae0", "#343c46"),
    "c0": ("#0072b2", "#56b4e9"),
    "c1": ("#d55e00", "#ff9d5c"),
    "c2": ("#00855f", "#3ecfa3"),
    "c3": ("#b0508f", "#e79bc9"),
    "c4": ("#8a6d00", "#e3c34a"),
}
PAPER, INK, SOFT, RULE, *SERIES = (light for light, _ in _COLOURS.values())
OURS = SERIES[0]
_FONTS = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif"
_MATPLOTLIB_FONTS = re.compile(r"'DejaVu Sans', 'Bitstream[^;\"]*sans-serif")
# Width in inches: 653 px, about the width of a page's text, so that text keeps its size.
WIDTH = 6.8
_SETTINGS = {
    "svg.fonttype": "none",
    "svg.hashsalt": "vlagents_ray",
    "font.size": 9.5,  # size of text in points, 12.7 px
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "text.color": INK,
    "axes.edgecolor": SOFT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.facecolor": PAPER,
    "figure.facecolor": PAPER,
    "grid.color": RULE,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
}
_ROUND_TRIPS_MS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20)  # ticks of the axis
_NAMES = {
    "shm": "shared memory",
    "websocket": "WebSocket",
    "http": "HTTP",
    "handle": "Serve handle",
    "raw": "raw pixels",
    "jpeg": "JPEG",
    "Ray actor": "from a Ray actor",
    "vlagents shm": "vlagents, shared memory",
    "vlagents JPEG": "vlagents, JPEG",
    "ray serve": "plain Ray Serve",
}


@contextmanager
def new_figure(height: float) -> Iterator[Any]:
    """Yield a figure of the common width and style.

    Args:
        height: Its height in inches.
    """
    matplotlib = require("matplotlib")
    with matplotlib.rc_context(_SETTINGS):
        yield require("matplotlib.figure").Figure(figsize=(WIDTH, height), layout="constrained")


def save_figure(figure: Any, file: Path) -> None:
    """Write a figure; the colours of an SVG follow the reader's scheme."""
    if file.suffix != ".svg":
        figure.savefig(file, dpi=150)
        return
    drawn = io.StringIO()
    figure.savefig(drawn, format="svg", metadata={"Date": None})
    text = drawn.getvalue()
    schemes = ["", ""]
    for name, colours in _COLOURS.items():
        text = text.replace(colours[0], f"var(--{name})")
        for index, colour in enumerate(colours):
            schemes[index] += f"--{name}:{colour};"
    style = f":root{{{schemes[0]}}}@media(prefers-color-scheme:dark){{:root{{{schemes[1]}}}}}"
    text = text.replace('<style type="text/css">', f'<style type="text/css">{style}', 1)
    text = _MATPLOTLIB_FONTS.sub(_FONTS, text)
    lines = [line.rstrip() for line in text.splitlines()]
    file.write_text("\n".join(lines) + "\n")


def name_of(way: str) -> str:
    """Return the reader's name for a transport or another system."""
    return ", ".join(_NAMES.get(part, part) for part in way.split(", "))


def plot_league(results: Mapping[str, Any], file: Path) -> None:
    """Draw a dot for the median round trip of each transport and of each other system."""
    rtt = results["rtt"]
    ways = [*rtt["ways"], *rtt["peers"]]
    ways.sort(key=lambda way: float(way["median_ms"]), reverse=True)
    peers = {peer["way"] for peer in rtt["peers"]}
    with new_figure(0.24 * len(ways) + 0.9) as figure:
        axes = figure.subplots()
        for row, way in enumerate(ways):
            median_ms = way["median_ms"]
            colour = SOFT if way["way"] in peers else OURS
            axes.plot(median_ms, row, "o", ms=6, color=colour)
            _label(axes, f"{median_ms:.3g}", (median_ms, row), (8, 0), colour)
        _name_rows(axes, [way["way"] for way in ways], peers)
        axes.set_xscale("log")
        axes.set_xticks(_ROUND_TRIPS_MS, [f"{ms:g}" for ms in _ROUND_TRIPS_MS])
        axes.minorticks_off()
        axes.set_xlim(0.1, 45)
        axes.set_xlabel("median round trip of one call on one machine, ms (log scale)")
        _explain_colours(axes)
        save_figure(figure, file)


def plot_throughput(results: Mapping[str, Any], file: Path) -> None:
    """Draw a dot for the actions per second of each system with the largest number of clients, and
    its 95 % interval; a panel for each of `throughput` and `without_gain` that was measured.
    """
    parts = [results[name] for name in ("throughput", "without_gain") if results.get(name)]
    rows = [{**part["transports"], **part.get("peers", {})} for part in parts]
    systems = sorted(rows[0], key=lambda name: float(_last(rows[0][name])["actions_per_s"]))
    peers = set(rows[0]) - set(parts[0]["transports"])
    with new_figure(0.26 * len(systems) + 1.3) as figure:
        panels = figure.subplots(1, len(parts), sharey=True, squeeze=False)[0]
        for axes, part, of_system in zip(panels, parts, rows, strict=True):
            for row, name in enumerate(systems):
                if name in of_system:
                    colour = SOFT if name in peers else OURS
                    _plot_rate(axes, _last(of_system[name]), row, colour)
            ideal = part["ideal_actions_per_s"]
            axes.axvline(ideal, color=SOFT, lw=1, ls=":")
            axes.annotate(
                f"{ideal:.0f} possible ",
                (ideal, -0.6),
                ha="right",
                va="center",
                color=SOFT,
            )
            axes.set_xlim(0, 1.22 * ideal)
            axes.set_title(_workload(part))
            axes.set_xlabel(f"actions/s, {part['clients']} clients")
        _name_rows(panels[0], systems, peers)
        panels[0].set_ylim(-1.1, len(systems) - 0.4)
        save_figure(figure, file)


def _last(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the point with the most clients."""
    point: Mapping[str, Any] = row["curve"][-1]
    return point


def _plot_rate(axes: Any, point: Mapping[str, Any], row: int, colour: str) -> None:
    rate = point["actions_per_s"]
    interval = point.get("ci95")
    if interval is not None:
        axes.plot(interval, [row, row], color=colour, lw=1.2, alpha=0.6)
    axes.plot(rate, row, "o", ms=6, color=colour)
    right = rate if interval is None else max(interval)
    _label(axes, f"{rate:.0f}", (right, row), (8, 0), colour)


def _workload(part: Mapping[str, Any]) -> str:
    """Return the title of a panel of throughput, which contains the duration of a batch."""
    base_ms, row_ms = part["config"].get("base_ms", 0), part["config"].get("per_item_ms", 0)
    base = f"{base_ms:g} ms + " if base_ms else ""
    largest = f"batches of {part['batch']}" if part["batch"] > 1 else "no batching"
    return f"{base}{row_ms:g} ms per row,\n{largest}"


def _name_rows(axes: Any, ways: Sequence[str], peers: set[str]) -> None:
    """Label the rows of a dot plot; the rows of this project have its colour."""
    axes.set_yticks(range(len(ways)), [name_of(way) for way in ways])
    for way, label in zip(ways, axes.get_yticklabels(), strict=True):
        label.set_color(INK if way in peers else OURS)
    axes.tick_params(axis="y", length=0)
    axes.set_ylim(-0.6, len(ways) - 0.4)
    axes.grid(axis="y", lw=0.6)
    axes.set_axisbelow(True)


def _explain_colours(axes: Any) -> None:
    """Explain the colours of the dots in the empty corner of a dot plot."""
    for height, (text, colour) in enumerate((("other systems", SOFT), ("vlagents_ray", OURS))):
        axes.annotate(
            f"● {text}",
            (0.02, 0.05 + 0.06 * height),
            xycoords="axes fraction",
            color=colour,
            backgroundcolor=PAPER,
        )


def _label(
    axes: Any,
    text: str,
    point: tuple[float, float],
    offset: tuple[float, float],
    colour: str,
    **options: Any,
) -> None:
    axes.annotate(
        text,
        point,
        bbox={"facecolor": PAPER, "edgecolor": "none", "pad": 0.5},
        xytext=offset,
        textcoords="offset points",
        color=colour,
        annotation_clip=False,
        **{"va": "center", **options},
    )


def plot_fleets(fleets: Sequence[Mapping[str, Any]], file: Path) -> None:
    """Draw the share of the ticks in time by number of robots, a panel for each fleet.

    Args:
        fleets: For each fleet its "title", the "points" of `benchmarks.fleet.measure_fleet`, and
            "most", the largest number of robots that is possible by arithmetic, or None.
        file: The picture.
    """
    points = itertools.chain.from_iterable(fleet["points"] for fleet in fleets)
    systems = list(dict.fromkeys(point["system"] for point in points))
    colours = dict(zip(systems, itertools.cycle(SERIES), strict=False))
    servers = {fleet["title"].partition("\n")[2] for fleet in fleets}
    with new_figure(2.6 * len(fleets)) as figure:
        panels = figure.subplots(len(fleets), 1, squeeze=False)[:, 0]
        for axes, fleet in zip(panels, fleets, strict=True):
            _plot_shares(axes, fleet, colours)
            robots, _, server = fleet["title"].partition("\n")
            # Labels that all panels share are below the panels.
            axes.set_title(robots if len(servers) == 1 else f"{robots}\n{server}")
            axes.set_ylabel("ticks in time, %")
        common = f" ({servers.pop()})" if len(servers) == 1 else ""
        panels[-1].set_xlabel(f"robots on one accelerator{common}")
        save_figure(figure, file)


def _plot_shares(axes: Any, fleet: Mapping[str, Any], colours: Mapping[str, str]) -> None:
    ends = []
    for system, colour in colours.items():
        points = sorted(
            (point for point in fleet["points"] if point["system"] == system),
            key=lambda point: int(point["robots"]),
        )
        if not points:
            continue
        robots = [point["robots"] for point in points]
        shares = [100 * point["share"] for point in points]
        axes.plot(robots, shares, "o-", ms=4.5, lw=1.2, color=colour)
        ends.append((robots[-1], shares[-1], system, colour))
    axes.set_ylim(0, 108)
    axes.set_xlim(0, 1.42 * max(end[0] for end in ends))
    axes.grid(axis="y", lw=0.6)
    most = fleet["most"]
    if most is not None:
        axes.axvline(most, color=SOFT, lw=1, ls=":")
        text = f"possible by arithmetic: {most}"
        axes.annotate(text, (0.03, 0.08), xycoords="axes fraction", color=SOFT)
    heights = _spread([share for _, share, _, _ in ends], least=13)
    for (robots, share, system, colour), height in zip(ends, heights, strict=True):
        # One percent of this axis is about 1.2 points of text high.
        _label(axes, name_of(system), (robots, share), (8, 1.2 * (height - share)), colour)


def _spread(values: Sequence[float], least: float) -> list[float]:
    """Return heights for the labels of values that are at least `least` apart; the highest label
    stays at its value.
    """
    heights = list(values)
    order = sorted(range(len(values)), key=lambda index: -values[index])
    for above, below in itertools.pairwise(order):
        heights[below] = min(heights[below], heights[above] - least)
    return heights


def plot_learners(points: Sequence[Mapping[str, Any]], before: float, file: Path) -> None:
    """Draw a dot for the success of each run, a row for each learner.

    Args:
        points: For each run: "learner", "success" in [0, 1], "episodes", and "cpu_s" or None.
        before: The success of the policy that all learners begin with.
        file: The picture.
    """
    worst_first = sorted(points, key=lambda point: float(point["success"]))
    learners = list(dict.fromkeys(point["learner"] for point in worst_first))
    with new_figure(0.5 * len(learners) + 1.1) as figure:
        axes = figure.subplots()
        for row, learner in enumerate(learners):
            runs = [point for point in points if point["learner"] == learner]
            rates = [100 * point["success"] for point in runs]
            axes.plot(rates, [row] * len(rates), "o", ms=7, alpha=0.75, color=OURS, mec=PAPER)
        names = []
        for learner in learners:
            names.append(_with_costs(learner, [p for p in points if p["learner"] == learner]))
        axes.set_yticks(range(len(learners)), names)
        axes.tick_params(axis="y", length=0)
        axes.set_ylim(-0.6, len(learners) - 0.3)
        axes.grid(axis="y", lw=0.6)
        axes.axvline(100 * before, color=SOFT, lw=1, ls=":")
        text = f"before: {100 * before:.1f} %"
        _label(axes, text, (100 * before, len(learners) - 0.5), (6, 0), SOFT)
        axes.margins(x=0.06)
        axes.set_xlabel("success of a run (dot) on held-out episodes, %")
        save_figure(figure, file)


def _with_costs(learner: str, runs: Sequence[Mapping[str, Any]]) -> str:
    """Return a label with the name of a learner, followed by the mean costs of its runs."""
    episodes = sum(run["episodes"] for run in runs) / len(runs)
    costs = f"{episodes:,.0f} episodes"
    measured = [run["cpu_s"] for run in runs if run["cpu_s"] is not None]
    if measured:
        costs += f", {sum(measured) / len(measured) / 60:.0f} min CPU time"
    return f"{learner}\n{costs}"


def main() -> None:
    """Draw all pictures of the docs from the results in the repository."""
    # These modules use this module to draw their results.
    from benchmarks.autoscaling import plot_autoscaling
    from benchmarks.learners_page import points_of, rate_of

    def read(path: str) -> Any:
        return json.loads((ROOT / path).read_text())

    folder = ROOT / "docs/pictures"
    with errors():
        league = read("benchmarks/latest.json")
        plot_league(league, folder / "league.svg")
        plot_throughput(league, folder / "throughput.svg")
        plot_fleets(read("docs/pictures/fleet.json"), folder / "fleet.svg")
        learners = read("examples/reference/learners.json")
        solved, episodes = rate_of(learners["before"]["tabletop"])
        plot_learners(points_of(learners), solved / episodes, folder / "learners.svg")
        timeline = read("docs/cluster/autoscaling.json")
        plot_autoscaling(timeline, ROOT / "docs/cluster/autoscaling.svg")
        out.print("wrote docs/pictures and docs/cluster/autoscaling.svg")


if __name__ == "__main__":
    main()
