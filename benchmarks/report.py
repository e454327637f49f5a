"""The figures of docs/measured_tables.md: measured in one run, compared with targets, and written
as Markdown.

The page also has the tables of `further_tables.json`. Figures of `python -m benchmarks.evaluation
--report FILE` in the same file are also compared.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.text import Text

from benchmarks import link
from benchmarks.console import USE_COLUMNS, Calls, use_cells
from benchmarks.figures import measured_on
from benchmarks.further_tables import FurtherTable, read_tables, table_markdown
from benchmarks.line_process import ProcessFailed
from benchmarks.peers import PYTHON, PeersPython
from benchmarks.picture import plot_league, plot_throughput
from benchmarks.rtt import measure_with_peers
from benchmarks.throughput import WITHOUT_GAIN, ThroughputPlan, measure_throughput
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

COMMAND = "python -m benchmarks.report"
_INTRODUCTION = """# All tables

[The main results](measured.md) come from these tables; that page explains the method. `python -m
benchmarks.report` writes this page.

## Round trips and throughput
"""
# File name of the picture, in the folder of the page.
PICTURE = Path("pictures", "league.svg")
THROUGHPUT_PICTURE = Path("pictures", "throughput.svg")
Results = Mapping[str, Any]  # the results of `collect`

ON_NODE = ("plasma, Ray actor", "shm, Ray actor")  # two clients, the faster one first
DEFAULT, JPEG = "websocket, default", "websocket, jpeg"
THROUGHPUTS = ("throughput", "without_gain")
# The parts of the figures that may lack systems, in words before the name of a system.
_MEASUREMENTS = {
    "rtt": "round trips of",
    "link": "round trips over the link of",
    **dict.fromkeys(THROUGHPUTS, "throughput of"),
    "evaluation": "an evaluation with",
}
_WAIT = "wait of a robot, p50 / p99 ms"
LIMIT_P99 = 3.0
LIMIT_OF_IDEAL = 0.98
LIMIT_WAIT_MS = 72.0  # two full batches of 20 ms + 16 x 1 ms
LIMIT_VLA_EVAL = 1.3


def collect(
    peers_python: Path,
    *,
    calls: int = 1000,
    link_calls: int = 600,
    plan: ThroughputPlan | None = None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Measure round trips with all peers, the link if this machine can make one, and throughput,
    as JSON values.
    """
    results: dict[str, Any] = {
        **measured_on(),
        "command": COMMAND,
        "skipped": {},
    }
    results["rtt"] = measure_with_peers(
        calls, peers=["all"], peers_python=peers_python, progress=progress
    )
    results["versions"] |= results["rtt"]["versions"]
    plan = plan or ThroughputPlan(peers=["all"], peers_python=peers_python)
    parts = {
        "link": partial(
            link.measure_link,
            link_calls,
            peers=link.PEERS,
            peers_python=peers_python,
            progress=progress,
        ),
        "throughput": partial(measure_throughput, plan, progress),
        "without_gain": partial(
            measure_throughput, replace(plan, config=WITHOUT_GAIN, batch=1), progress
        ),
    }
    for name, part in parts.items():
        try:
            results[name] = part()
        except (ConfigError, ProcessFailed) as error:  # the other parts are kept
            progress(str(error))
            results["skipped"][name] = str(error).partition("\n")[0]
    return results


def write(results: Mapping[str, Any], page: Path, file: Path | None) -> None:
    """Write the page, the pictures in the same folder, and the figures into `file` for the next
    run.
    """
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(results, indent=1) + "\n")
    if results.get("rtt"):
        picture = page.parent / PICTURE
        picture.parent.mkdir(exist_ok=True)
        plot_league(results, picture)
        if any(results.get(name) for name in THROUGHPUTS):
            plot_throughput(results, page.parent / THROUGHPUT_PICTURE)
    page.write_text(page_text(results, read_tables()))


@dataclass(frozen=True, slots=True)
class Outcome:
    """A line of the table: a target and the measured value."""

    what: str
    wanted: str
    measured: str
    met: bool | None  # None: not measured


def outcomes(results: Results) -> list[Outcome]:
    """Return every target, in order, with the measured value."""
    rtt, link = results.get("rtt") or {}, results.get("link") or {}
    actor = next((name for name in ON_NODE if name in rtt.get("ratios", {})), ON_NODE[0])
    node, shm = "a Ray env actor and the replica on its node", "a local process and the replica"
    return [
        _ratio(rtt, f"{node} ({actor.partition(',')[0]})", actor, "vlagents shm", 0.20),
        _ratio(rtt, f"{shm} (shm)", "shm", "vlagents shm", 0.10),
        _ratio(rtt, f"{shm} (shm)", "shm", "openpi", 0.12),
        _ratio(
            rtt, "WebSocket, JPEG at vlagents' setting (q85 4:4:4)", JPEG, "vlagents JPEG", 0.62
        ),
        _ratio(rtt, "WebSocket, raw", "websocket, raw", "openpi", 0.80),
        _default(rtt),
        _ratio(rtt, "HTTP, JPEG", "http, jpeg", "vlagents JPEG", 0.45),
        _ratio(rtt, "HTTP, JPEG", "http, jpeg", "OpenVLA REST", 0.60),
        _ratio(rtt, "Serve handle", "handle, Ray actor", "vlagents JPEG", 1.0),
        _ratio(link, "WebSocket, our default, over the link", DEFAULT, "vlagents JPEG", 0.50),
        _ratio(link, "WebSocket, our default, over the link", DEFAULT, "openpi", 0.45),
        *(_tail(rtt, name) for name in dict.fromkeys([actor, "shm"])),
        *_throughput_targets(results.get("throughput") or {}),
        *(evaluation_outcomes(results["evaluation"]) if "evaluation" in results else []),
    ]


def evaluation_outcomes(found: Results) -> list[Outcome]:
    """Return the targets of `benchmarks.evaluation`."""
    workers = found["plan"]["workers"]
    cores = min(found["cores"], workers)
    # Its steps take most of the time.
    simulator = found["plan"].get("name", "tabletop") != "tabletop"
    limits = {
        "vlagents": float(cores),
        "vlagents, split": 1.0,
        "vla-eval": LIMIT_VLA_EVAL,
        "lerobot": float(cores),
    }
    limits |= {"vla-eval": 1.0, "lerobot": 1.0} if simulator else {}
    names = {
        "vlagents": "vlagents run-eval, one process",
        "vlagents, split": f"vlagents run-eval, {workers} processes and servers",
        "vla-eval": f"vla-eval, {workers} shards",
        "lerobot": f"lerobot-eval, {workers} environments in one process",
    }
    return [
        Outcome(
            f"episodes a minute of whole evaluations, {workers} workers",
            f"≥ {limits[name]:g} x {names[name]}",
            f"{row['median']:.2f}",
            row["median"] >= limits[name],
        )
        for name, row in found["ratios"].items()
    ]


def _ratio(part: Results, what: str, ours: str, theirs: str, limit: float) -> Outcome:
    wanted = f"≤ {limit:.2f} x {theirs}"
    found = part.get("ratios", {}).get(ours, {}).get(theirs)
    if found is None:
        return unmeasured(what, wanted)
    low, high = found["ci95"]
    return Outcome(
        what, wanted, f"{found['ratio']:.3f} ({low:.3f} to {high:.3f})", found["ratio"] <= limit
    )


def _default(rtt: Results) -> Outcome:
    """Compare time and image quality with vlagents' images, which are our JPEG at its setting."""
    found = _ratio(rtt, "WebSocket, our default setting", DEFAULT, "vlagents JPEG", 0.15)
    ours, theirs = _way(rtt, DEFAULT), _way(rtt, JPEG)
    if found.met is None or ours is None or theirs is None:
        return found
    as_good = ours["psnr_db"] is None or (
        theirs["psnr_db"] is not None and ours["psnr_db"] >= theirs["psnr_db"]
    )
    seen = f"{found.measured}; PSNR {_decibels(ours)}, theirs {_decibels(theirs)}"
    return Outcome(found.what, f"{found.wanted}, PSNR no worse", seen, found.met and as_good)


def _tail(rtt: Results, name: str) -> Outcome:
    what, wanted = (
        f"p99 over median, {name}, calls without a break",
        f"≤ {LIMIT_P99:g}, idle machine",
    )
    way = next((way for way in rtt.get("steady", ()) if way["way"] == name), None)
    if way is None:
        return unmeasured(what, wanted)
    ratio = way["p99_ms"] / way["median_ms"]
    return Outcome(what, wanted, f"{ratio:.1f}", ratio <= LIMIT_P99)


def _throughput_targets(part: Results) -> Sequence[Outcome]:
    found = []
    for transport in ("plasma", "handle", "shm", "websocket"):
        row = part.get("transports", {}).get(transport)
        what = f"actions a second, 32 sessions, batches of 16, {transport}"
        wanted = f"≥ {LIMIT_OF_IDEAL:.2f} of the ideal"
        found.append(
            Outcome(what, wanted, f"{row['of_ideal']:.3f}", row["of_ideal"] >= LIMIT_OF_IDEAL)
            if row
            else unmeasured(what, wanted)
        )
    for transport, row in part.get("transports", {}).items():
        if row["robot"] is not None:
            p99 = row["robot"]["wait_p99_ms"]
            wanted = f"p99 ≤ {LIMIT_WAIT_MS:g} ms"
            what = f"a robot's wait among 31 simulations, {transport}"
            found.append(Outcome(what, wanted, f"{p99:.1f} ms", p99 <= LIMIT_WAIT_MS))
    return found


def _way(part: Results, name: str) -> Results | None:
    return next((way for way in part.get("ways", ()) if way["way"] == name), None)


def _decibels(way: Results) -> str:
    return "lossless" if way["psnr_db"] is None else f"{way['psnr_db']:.1f} dB"


def unmeasured(what: str, wanted: str) -> Outcome:
    """Return the line of a target that was not measured."""
    return Outcome(what, wanted, "not measured", None)


def page_text(results: Results, further: Sequence[FurtherTable]) -> str:
    """Return the text of the page: the figures of `collect`, then the further tables."""
    sections = [f"{_INTRODUCTION}\n{section(results)}", *(table.to_markdown() for table in further)]
    return "\n\n".join(sections) + "\n"


def section(results: Mapping[str, Any]) -> str:
    """Return the first section: round trips, the link, throughput, and their origin.

    The comparison with targets is printed, see `show_outcomes`.
    """
    parts = [_origin(results)]
    if rtt := results.get("rtt"):
        parts.append(_league(results))
        if use := rtt.get("use"):
            parts.append(_use(use))
    if link := results.get("link"):
        name = (
            f"Round trips of one call over a link of {link['link']['measured_mbit_per_s']:.0f} "
            "Mbit/s between two network namespaces"
        )
        parts.append(_round_trips(name, link))
    parts += [_throughput(results[name]) for name in THROUGHPUTS if results.get(name)]
    if skipped := list(_skipped(results)):
        parts.append("Not measured: " + "; ".join(skipped) + ".")
    return "\n\n".join(parts)


def _origin(results: Mapping[str, Any]) -> str:
    machine = results["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    return (
        f"Measured {results['date']} by `{results['command']}` on {machine['cpu']}, "
        f"{machine['cores']} cores, {machine['memory_gb']} GB, Linux {machine['kernel']}; "
        f"the load average before the measurement was {machine['load']:.1f}. {versions}. "
        "Two 224x224 RGB cameras, a policy that does nothing, all systems interleaved in rounds of "
        "100 calls; brackets contain 95 % intervals. Each round begins cold, which explains most "
        "of the p99 times."
    )


def _league(results: Results) -> str:
    """Return the table of all systems: round trips, and the actions per second of the largest
    number of clients with each policy.
    """
    rtt = results["rtt"]
    found = [{way["way"]: way for way in rows_of(results.get(name) or {})} for name in THROUGHPUTS]
    theirs = {peer["way"] for peer in rtt["peers"]}
    ways = sorted([*rtt["ways"], *rtt["peers"]], key=lambda one: float(one["median_ms"]))
    rows = []
    for way in ways:
        name, (low, high) = way["way"], way["ci95_ms"]
        row = [
            f"*{name}*" if name in theirs else name,
            f"{way['median_ms']:.3f} ({low:.3f} to {high:.3f})",
            f"{way['p99_ms']:.2f}",
            f"{way['median_ms'] / ways[0]['median_ms']:.3g}",
        ]
        for one in found:
            row += [_rate(one[name]["curve"][-1]), _waits(one[name])] if name in one else ["", ""]
        rows.append(row)
    head = ["system", "median ms", "p99 ms", "of the fastest"]
    for name in THROUGHPUTS:
        part = results.get(name) or {}
        head += [f"actions/s of {part['clients']}, {policy_of(part)}", _WAIT] if part else ["", ""]
    text = "Round trips of one call on one machine, and actions per second of many clients"
    pictures = f"![Median round trips of one call on one machine]({PICTURE})"
    if any(found):
        pictures += f"\n\n![Actions per second of many clients, by system]({THROUGHPUT_PICTURE})"
    return (
        f"{pictures}\n\n{text}; *other systems* use their own servers and "
        f"clients:\n\n{table_markdown(head, rows)}"
    )


def rows_of(part: Results) -> list[Results]:
    """Return the rows of a measurement of throughput, ours and the peers', each with the name of
    its client.
    """
    return [
        {"way": name, **row}
        for name, row in {**part.get("transports", {}), **part.get("peers", {})}.items()
    ]


def policy_of(part: Results) -> str:
    """Return the policy of a measurement of throughput, with its settings and the largest batch."""
    settings = "".join(f", {key} {value}" for key, value in part["config"].items())
    return f"{part['policy']}{settings}, batches of {part['batch']} at most"


def _rate(point: Results) -> str:
    rate = f"{point['actions_per_s']:.0f}"
    return (
        rate if point.get("ci95") is None else "{} ({:.0f} to {:.0f})".format(rate, *point["ci95"])
    )


def _waits(row: Results) -> str:
    robot = row["robot"]
    return f"{robot['wait_p50_ms']:.1f} / {robot['wait_p99_ms']:.1f}" if robot else ""


def _round_trips(title: str, part: Mapping[str, Any]) -> str:
    theirs = [peer["way"] for peer in part["peers"]]
    rows = []
    for way in sorted([*part["ways"], *part["peers"]], key=lambda one: float(one["median_ms"])):
        low, high = way["ci95_ms"]
        ratios = part["ratios"].get(way["way"], {})
        name = f"*{way['way']}*" if way["way"] in theirs else way["way"]
        rows.append(
            (
                name,
                f"{way['median_ms']:.3f} ({low:.3f} to {high:.3f})",
                f"{way['p99_ms']:.2f}",
                *(f"{ratios[peer]['ratio']:.2f}" if peer in ratios else "" for peer in theirs),
            )
        )
    return f"{title}:\n\n" + table_markdown(
        ("system", "median ms", "p99 ms", *(f"/ {peer}" for peer in theirs)), rows
    )


def _use(use: Results) -> str:
    rows = [
        (name, *use_cells(one))
        for name, one in sorted(use.items(), key=lambda one: one[1]["server"]["cpu_ms"])
    ]
    text = (
        "The table shows the CPU time of the same calls, without the CPU time of the idle "
        "processes, and how often a thread of the client or the server waited or was preempted:"
    )
    return f"{text}\n\n{table_markdown(('system', *USE_COLUMNS), rows)}"


def _throughput(part: Results) -> str:
    counts = list(
        dict.fromkeys(point["clients"] for row in rows_of(part) for point in row["curve"])
    )
    head = ("system", "of the ideal", *(f"K = {k}" for k in counts), _WAIT)
    rows = []
    for row in rows_of(part):
        rates = {point["clients"]: _rate(point) for point in row["curve"]}
        name = f"*{row['way']}*" if row["way"] in part.get("peers", {}) else row["way"]
        rows.append(
            (name, f"{row['of_ideal']:.3f}", *(rates.get(k, "") for k in counts), _waits(row))
        )
    text = (
        f"Actions per second of one replica with K clients ({policy_of(part)}; ideal "
        f"{part['ideal_actions_per_s']:.0f}, {part['ideal_is']}), and how long a robot among "
        f"{part['clients'] - 1} simulations waits:"
    )
    return f"{text}\n\n{table_markdown(head, rows)}"


def _skipped(results: Mapping[str, Any]) -> Iterator[str]:
    """Yield each system that was not measured, with the measurement and the reason.

    Measurements have their own names of systems, and one that lacks a system does not explain why
    another lacks it.
    """
    for name, reason in (results.get("skipped") or {}).items():
        yield f"{name} ({reason})"
    listed: set[str] = set()
    for part, measurement in _MEASUREMENTS.items():
        for name, reason in ((results.get(part) or {}).get("skipped") or {}).items():
            text = f"{measurement} {name} ({reason.partition(';')[0]})"  # without the cure
            if text not in listed:
                listed.add(text)
                yield text


def show_outcomes(lines: Sequence[Outcome]) -> None:
    """Print targets, and whether they are met."""
    if not lines:
        return
    rows = table("", "target", "measured", "met")
    met = {True: Text("yes"), False: Text("no", "red"), None: Text("")}
    for one in lines:
        rows.add_row(one.what, one.wanted, one.measured, met[one.met])
    out.print(rows)


def main(
    page: Annotated[Path, typer.Option(help="The page that is written.")] = Path(
        "docs/measured_tables.md"
    ),
    file: Annotated[Path, typer.Option("--out", help="File for the figures.")] = Path(
        "benchmarks/latest.json"
    ),
    calls: Calls = 1000,
    seconds: Annotated[
        float,
        typer.Option(min=0.1, help="Duration of each measurement of the throughput, in seconds."),
    ] = 2.0,
    peers_python: PeersPython = PYTHON,
    from_json: Annotated[
        bool, typer.Option("--from-json", help="Measure nothing: use the figures in --out.")
    ] = False,
) -> None:
    """Measure round trips, the link and throughput, and write the figures of
    docs/measured_tables.md again.
    """
    with errors():
        if not page.parent.is_dir():
            raise ConfigError(f"--page {page}: expected an existing folder, got {page.parent}")
        require("matplotlib")
        if from_json:
            try:
                results = json.loads(file.read_text())
            except (OSError, ValueError) as error:
                raise ConfigError(f"--out {file}: cannot be read ({error})") from error
        else:
            results = collect(
                peers_python, calls=calls, link_calls=calls, progress=progress,
                plan=ThroughputPlan(seconds=seconds, peers=["all"], peers_python=peers_python),
            )  # fmt: skip
        write(results, page, None if from_json else file)
    out.print(f"wrote {page}")


if __name__ == "__main__":
    typer.run(main)
