"""Makes the picture and the table of several measurements of `benchmarks.fleet`.

`python -m benchmarks.fleet_page FILE... --picture docs/pictures/fleet.svg` prints the table as
Markdown. Files with measurements of the same robots, such as those of other systems, share a panel.
The points of the picture are stored next to it, in a .json file.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.fleet import most_served
from benchmarks.picture import plot_fleets
from vlagents_ray.cli.console import errors, out
from vlagents_ray.serve.fleet import CostCurve, RobotNeed, most_robots

_SAME = (
    "kinds",
    "chunk",
    "base_ms",
    "row_ms",
    "batch",
    "transport",
    "real_time_chunking",
    "link",
    "delay",
)


def merge_fleets(files: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return a fleet for each kind of robots, with the points of all files that measured it."""
    fleets: dict[str, dict[str, Any]] = {}
    for measured in files:
        plan = measured["plan"]
        key = json.dumps({name: plan[name] for name in _SAME}, sort_keys=True)
        fleet = fleets.setdefault(key, {"title": title(plan), "most": most(plan), "points": []})
        fleet["points"] += measured["points"]
    return list(fleets.values())


def title(plan: Mapping[str, Any]) -> str:
    """Return the heading of a panel."""
    kinds = [f"{kind['rows']} actions at {kind['hz']:g} Hz" for kind in plan["kinds"]]
    robots = f"chunks of {' and of '.join(kinds)}"
    way = plan["transport"]
    if plan["real_time_chunking"]:
        way += ", RTC"
    if plan["link"] is not None:
        way += f", link of {plan['link']}"
    if plan["delay"] is not None:
        way += f" and {plan['delay']}"
    curve = f"{plan['base_ms']:g} ms + {plan['row_ms']:g} ms per row"
    return f"{robots}\n{way}, {curve}"


def most(plan: Mapping[str, Any]) -> int | None:
    """Return the largest number of robots that is possible by arithmetic; None for robots of
    several kinds.
    """
    if len(plan["kinds"]) > 1:
        return None
    kind = plan["kinds"][0]
    costs = CostCurve(plan["base_ms"] / 1e3, plan["row_ms"] / 1e3)
    return most_robots(costs, RobotNeed(kind["hz"], kind["rows"]), plan["batch"])


def markdown(fleets: Sequence[Mapping[str, Any]]) -> str:
    """Return a row for each fleet and system."""
    columns = (
        "robots",
        "system",
        "most in time",
        "at N robots: in time, served, age p95 s",
        "CPU s a robot-hour: server, client",
    )
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    for fleet in fleets:
        systems = dict.fromkeys(point["system"] for point in fleet["points"])
        for system in systems:
            points = sorted(
                (point for point in fleet["points"] if point["system"] == system),
                key=lambda point: int(point["robots"]),
            )
            figures = "; ".join(
                f"{point['robots']}: {point['share']:.1%}, {point['served']}, "
                f"{point['age_p95_ms'] / 1e3:.2f}"
                for point in points
            )
            last = points[-1]
            robots = fleet["title"].replace("\n", ", ")
            lines.append(
                f"| {robots} | {system} | {most_served(points, system)} | {figures} | "
                f"{last['server_cpu_s']:.0f}, {last['client_cpu_s']:.0f} |"
            )
    return "\n".join(lines)


def main(
    files: Annotated[list[Path], typer.Argument(help="Files of `benchmarks.fleet --out`.")],
    picture: Annotated[Path | None, typer.Option(help="File of the picture.")] = None,
) -> None:
    """Print the table of several measurements, and draw them."""
    with errors():
        fleets = merge_fleets([json.loads(file.read_text()) for file in files])
        out.print(markdown(fleets), soft_wrap=True, markup=False)
        if picture is not None:
            # `python -m benchmarks.picture` draws the stored points again.
            picture.with_suffix(".json").write_text(json.dumps(fleets, indent=1) + "\n")
            plot_fleets(fleets, picture)


if __name__ == "__main__":
    typer.run(main)
