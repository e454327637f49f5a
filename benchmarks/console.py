"""Options that several measurements share, the table of round trips, and the file of figures."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from vlagents_ray.cli.console import out, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError

Calls = Annotated[int, typer.Option(min=1, help="Number of round trips for each client.")]
Seconds = Annotated[float, typer.Option(min=0.1, help="Duration of each measurement, in seconds.")]
Rounds = Annotated[int, typer.Option(min=1)]
Out = Annotated[Path | None, typer.Option("--out", help="File for the figures, as JSON.")]
Transports = Annotated[str, typer.Option(help="shm,websocket,http,handle,plasma; default: all.")]
# Maximum number of ratios in a row that fit on a screen with their intervals; the file of figures
# has all ratios.
_WITH_INTERVALS = 5


def show_round_trips(found: Mapping[str, Any], title: str) -> None:
    """Print a row for each client, the fastest first; rows of our clients also have the ratios to
    other servers.
    """
    theirs = [peer["way"] for peer in found["peers"]]
    rows = table("way", "median ms", "95 % interval", "p99 ms", *(f"/ {name}" for name in theirs))
    rows.title = f"{title}: two 224x224 RGB cameras, no-op policy"
    for row in sorted([*found["ways"], *found["peers"]], key=lambda one: float(one["median_ms"])):
        low, high = row["ci95_ms"]
        ratios = found["ratios"].get(row["way"], {})
        cells = []
        for name in theirs:
            one = ratios.get(name)
            interval = (
                f" ({one['ci95'][0]:.2f}-{one['ci95'][1]:.2f})"
                if one and len(theirs) <= _WITH_INTERVALS
                else ""
            )
            cells.append(f"{one['ratio']:.2f}{interval}" if one else "")
        rows.add_row(
            row["way"],
            f"{row['median_ms']:.3f}",
            f"{low:.3f} to {high:.3f}",
            f"{row['p99_ms']:.3f}",
            *cells,
            style="dim" if row["way"] in theirs else None,
        )
    out.print(rows)
    show_skipped(found)


USE_COLUMNS = (
    "client CPU ms",
    "server CPU ms",
    "calls per second of a server's core",
    "server's programs, CPU ms",
    "client waits",
    "server waits",
    "preempted",
)


def use_cells(use: Mapping[str, Any]) -> list[str]:
    """Return the cells of `USE_COLUMNS` for the resources that a call uses in client and server."""
    client, server = use["client"], use["server"]
    programs = sorted(server["programs"].items(), key=lambda one: -one[1])
    return [
        f"{client['cpu_ms']:.3f}",
        f"{server['cpu_ms']:.3f}",
        f"{1e3 / server['cpu_ms']:.0f}" if server["cpu_ms"] > 0 else "",
        ", ".join(
            f"{name} {cpu_ms:.3f}" for name, cpu_ms in programs if cpu_ms >= 0.01 * server["cpu_ms"]
        ),
        f"{client['voluntary_switches']:.1f}",
        f"{server['voluntary_switches']:.1f}",
        f"{client['involuntary_switches'] + server['involuntary_switches']:.1f}",
    ]


def show_use(found: Mapping[str, Any]) -> None:
    """Print a row for each client: the CPU time of one call in its process and in its server's
    processes.
    """
    rows = table("way", *USE_COLUMNS)
    rows.title = "CPU time and context switches of one act, beyond those of idle processes"
    for name, use in sorted(
        found["use"].items(), key=lambda one: float(one[1]["server"]["cpu_ms"])
    ):
        rows.add_row(name, *use_cells(use))
    out.print(rows)


def show_skipped(found: Mapping[str, Any]) -> None:
    """Print the skipped clients with the reasons."""
    for name, reason in found["skipped"].items():
        out.print(Text.assemble((f"skipped {name}", "yellow"), f": {reason}"))


def parse_counts(text: str, option: str) -> list[int]:
    """Parse a comma-separated list of numbers of at least 1, and return them in ascending order."""
    try:
        counts = sorted({int(one) for one in parse_list(text)})
    except ValueError as error:
        raise ConfigError(
            f"{option}: expected numbers that are separated by commas, got {text!r}"
        ) from error
    if not counts or counts[0] < 1:
        raise ConfigError(f"{option}: expected numbers from 1 on, got {text!r}")
    return counts


def save(found: Any, file: Path | None) -> None:
    """Write figures as JSON, if `file` is set."""
    if file is not None:
        file.write_text(json.dumps(found, indent=1) + "\n")
