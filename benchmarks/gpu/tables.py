"""The tables of docs/measured_gpu.md: `python -m benchmarks.gpu.tables build/gpu/gpu.json`.

The steps of new reports replace those of the same names in `latest.json`, from which the tables are
made. Each table names the card, the date and the commit of its step, and whether another step was
measured later at another commit.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks.gpu.samples import NO_GPU
from vlagents_ray.errors import ConfigError

LATEST = Path(__file__).with_name("latest.json")
PAGE = Path(__file__).resolve().parents[2] / "docs" / "measured_gpu.md"
BEGIN, END = "<!-- gpu -->", "<!-- /gpu -->"
_ORIGIN = ("date", "commit", "command", "gpu", "versions")
_SHOWN_VERSIONS = ("torch", "transformers", "torchao")
_LEAST_DATE = "0000-00-00"
_KERNELS = 10  # maximum number of kernels of each core that the page shows; `latest.json` has 25

_CURVE = {
    "rows": "rows",
    "network_ms": "network ms",
    "bare_ms": "call ms",
    "queued_ms": "queued ms",
    "actions_per_s": "actions per second",
    "peak_mib": "MiB",
    "watts": "W",
    "joules_an_act": "J per call",
    "clock_mhz": "MHz",
}
_ACTS = {
    "acts_per_s": "calls per second",
    "median_ms": "median ms",
    "worst_ms": "longest ms",
}


@dataclass(frozen=True, slots=True)
class TableOf:
    """A table of the page, which shows a figure of a step."""

    step: str
    figure: str  # name of a figure that is a list of rows
    title: str
    columns: Mapping[str, str]  # headings by the keys of the rows


TABLES = (
    TableOf("eager", "curve", "π0 without compilation, by the rows of a batch", _CURVE),
    TableOf("graphs", "curve", "π0 in CUDA graphs", _CURVE),
    TableOf("compiled", "curve", "π0 with `compile: true`", _CURVE),
    TableOf("words", "curve", "π0 with 200 words, as many as π0.5 has, in CUDA graphs", _CURVE),
    TableOf(
        "served",
        "robots",
        "Robots that send three images as JPEG over a WebSocket, each as soon as it has an answer",
        {
            "robots": "robots",
            "network_ms": "network ms",
            "median_ms": "call ms",
            "acts_per_s": "calls per second",
            "of_network": "of the network",
        },
    ),
    TableOf(
        "fleet",
        "fleet",
        "Robots with a fixed rate",
        {
            "hz": "Hz",
            "rows": "rows of a chunk",
            "robots": "robots",
            "share": "ticks in time",
            "least_share": "of the worst robot",
            "age_p99_ms": "99 % of ages, ms",
        },
    ),
    TableOf(
        "child",
        "processes",
        "The policy in a child process",
        {
            "policy in": "policy in",
            "sessions": "sessions",
            "queued_ms": "queued ms",
            "actions_per_s": "actions per second",
            "reserved_mib": "MiB",
        },
    ),
    TableOf(
        "sharing",
        "shared",
        "Replicas that share the GPU, each with half of its memory",
        {"replicas": "replicas", "actions_per_s": "actions per second", "batch_ms": "batch ms"},
    ),
    TableOf(
        "cold starts",
        "starts",
        "From the start of a process to its first action",
        {"mode": "mode", "seconds": "s", "load_s": "of that, loading, s"},
    ),
    TableOf(
        "compiled",
        "starts",
        "The same with `compile: true`, from the end of the imports",
        {"mode": "mode", "seconds": "s", "load_s": "of that, loading, s"},
    ),
    TableOf(
        "compiled again",
        "starts",
        "The same with kept programs",
        {"mode": "mode", "seconds": "s", "load_s": "of that, loading, s"},
    ),
    TableOf(
        "loading",
        "acts",
        "Eight sessions are served while a second checkpoint loads",
        {"while": "while", **_ACTS},
    ),
    TableOf(
        "captures",
        "acts",
        "Graphs that are replayed while others are captured, without the lock that calls acquire",
        {"while": "while", **_ACTS, "failed": "failed", "failed_captures": "failed captures"},
    ),
    TableOf(
        "pushes",
        "pushes",
        "Pushes of all weights while eight sessions are served",
        {"from": "from", "seconds": "s", **_ACTS, "peak_mib": "MiB"},
    ),
    TableOf(
        "sleep",
        "sleep",
        "Sleep and wake",
        {
            "sleep": "sleep",
            "sleep_s": "to sleep, s",
            "wake_s": "to wake, s",
            "push_s": "to take a push, s",
            "awake_mib": "awake, MiB",
            "asleep_mib": "asleep, MiB",
        },
    ),
    TableOf(
        "numerics",
        "number_formats",
        "Numbers of 8 bits: the error of actions against float32",
        {
            "numbers": "numbers",
            "compile": "compile",
            "1 rows, ms": "1 row, ms",
            "8 rows, ms": "8 rows, ms",
            "error": "error",
            "peak_mib": "MiB",
        },
    ),
)


def merged(latest: Mapping[str, Any], report: Mapping[str, Any]) -> dict[str, Any]:
    """Return the latest steps, after replacing older steps with those of a report.

    Args:
        latest: Steps by name, each with its "origin".
        report: `gpu.json` of a run.

    Raises:
        ConfigError: The report is that of a dry run, or does not name its card or its commit.
    """
    if report["dry"]:
        raise ConfigError("report: expected a run on a GPU, got a dry run; run it without --dry")
    if not report["commit"] or report["gpu"] in ("", NO_GPU):
        raise ConfigError(
            f"report: expected a card and a commit, got {report['gpu']!r} and "
            f"{report['commit']!r}; write them into the report, or measure again with --commit"
        )
    origin = {key: report.get(key, "") for key in _ORIGIN}
    steps = dict(latest)
    for name, step in report["steps"].items():
        known = steps.get(name, {}).get("origin", {}).get("date", _LEAST_DATE)
        if known <= origin["date"]:
            steps[name] = {**step, "origin": origin}
    return steps


def to_markdown(steps: Mapping[str, Any]) -> str:
    """Return the tables of the page, in their order, each with its origin."""
    newest = max((step["origin"] for step in steps.values()), key=lambda one: one["date"])
    blocks: list[str] = []
    for wanted in TABLES:
        rows = steps.get(wanted.step, {}).get("figures", {}).get(wanted.figure)
        if isinstance(rows, list) and rows:
            caption = _caption(wanted.title, steps[wanted.step], newest)
            blocks += [caption, _table(rows, wanted.columns)]
    for name, step in steps.items():
        for figure, rows in step["figures"].items():
            if figure.startswith("kernels of ") and isinstance(rows, list):
                title = f"{name}: the {_KERNELS} longest {figure}"
                blocks.append(_caption(title, step, newest))
                columns = {"kernel": "kernel", "calls": "calls", "ms": "ms", "share": "share"}
                blocks.append(_table(rows[:_KERNELS], columns))
    blocks.append(_unmet(steps))
    return "\n\n".join(block for block in blocks if block)


def _caption(title: str, step: Mapping[str, Any], newest: Mapping[str, Any]) -> str:
    """Return the caption of a table: its content, and the card, date and commit of the
    measurement.
    """
    origin, figures = step["origin"], step["figures"]
    facts = [origin["gpu"]]
    if "clock_mhz" in figures:
        limited_by = figures["clock_limited_by"]
        limit = "" if limited_by == "nothing" else f" (limited by {limited_by})"
        facts.append(f"{figures['clock_mhz']:.0f} MHz{limit}")
    versions = origin["versions"] or {}
    facts += [f"{name} {versions[name]}" for name in _SHOWN_VERSIONS if name in versions]
    facts += [origin["date"], f"commit {origin['commit']}"]

    notes = []
    if origin["date"] < newest["date"] or origin["commit"] != newest["commit"]:
        notes.append("older than the newest run")
    if origin.get("note"):
        notes.append(origin["note"])
    return f"{title} ({'; '.join([', '.join(facts), *notes])}):"


def _table(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> str:
    """Return a table with each column that at least one row has."""
    filled: set[str] = set().union(*rows)
    present = [key for key in columns if key in filled]
    lines = [[columns[key] for key in present], ["---"] * len(present)]
    for row in rows:
        lines.append([_cell(row.get(key, "")) for key in present])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _unmet(steps: Mapping[str, Any]) -> str:
    """Return a list of the criteria that were not met; empty if there are none."""
    lines = []
    for name, step in steps.items():
        for check in step["checks"]:
            if check["passed"] is False:
                got = _cell(check["got"])
                lines.append(f"- {name}: {check['name']}: {got}, where {check['want']} was wanted")
    return "\n".join(["Criteria that were not met:", "", *lines]) if lines else ""


def _cell(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}" if math.fabs(value) < 1000 else f"{value:,.0f}"
    if isinstance(value, int):
        return f"{value:,}"
    return str(value).replace("|", "/")


def write_page(page: Path, steps: Mapping[str, Any]) -> None:
    """Replace the tables between the marks of a page.

    Raises:
        ConfigError: The page has no marks.
    """
    text = page.read_text()
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise ConfigError(f"{page}: expected the marks {BEGIN} and {END}, got none; add them")
    page.write_text(f"{before}{BEGIN}\n\n{to_markdown(steps)}\n\n{END}{after}")


def main(
    reports: Annotated[
        list[Path],
        typer.Argument(help="gpu.json files of runs; without any, only the page is written."),
    ] = [],  # noqa: B006
    latest: Annotated[Path, typer.Option(help="The figures of all steps.")] = LATEST,
    page: Annotated[Path, typer.Option(help="The page with the tables.")] = PAGE,
) -> None:
    """Make the tables of the page from the newest figures of each step."""
    steps = json.loads(latest.read_text()) if latest.is_file() else {}
    for report in reports:
        steps = merged(steps, json.loads(report.read_text()))
    latest.write_text(json.dumps(steps, indent=1, ensure_ascii=False) + "\n")
    write_page(page, steps)


if __name__ == "__main__":
    typer.run(main)
