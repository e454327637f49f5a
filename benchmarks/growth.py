"""Measures a fleet of robots, and how the cost of an inference call changes with the number of
sessions and of replicas.

The policy does nothing; each client sends two 224x224 RGB cameras as JPEG. The fleet acts at its
rate. Along a curve, all sessions together act at one low rate, so that only their number, or that
of the replicas, differs. The ticks of each session begin at a random moment. The time of a call
counts from its tick; a call is on time if it ends before the next tick.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.autoscaling import check_plot_file
from benchmarks.console import Out, parse_counts, save
from benchmarks.drivers import START_S
from benchmarks.figures import measured_on
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.processes import UsageMeter, count_idle, server_processes
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import Server, running_server

POLICY = "benchmarks.live:Measured"  # its `reset` returns the process id of the replica
TRANSPORTS = ("websocket", "http", "shm")  # transports of clients outside of Ray
CURVES = ("sessions", "replicas")
_PROCESSES = 4  # number of processes that share the robots
_AHEAD_S = 0.5  # time before the beginning at which the clients' processes are informed of it, s
_WARM_S = 1.0
_LATE_S = 60.0
_CONNECT_S = 0.1  # time for each robot to connect, s


@dataclass(frozen=True, slots=True)
class GrowthPlan:
    """The settings of `measure_growth`."""

    robots: int = 64
    hz: float = 10.0  # rate of each robot, Hz
    sessions: Sequence[int] = (1, 4, 16, 64, 256, 1000)
    replicas: Sequence[int] = (1, 2, 4, 8)
    acts_per_s: float = 50.0  # actions per second of all sessions at each point of a curve
    seconds: float = 20.0  # duration of each measurement, s
    transport: str = "websocket"


def measure_growth(
    plan: GrowthPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure the fleet and both curves, and return plain JSON values.

    The curve of replicas has as many sessions as there are robots.
    """
    rate = plan.acts_per_s
    # Sessions of the previous measurement may still be ending.
    limit = 2 * max(plan.robots, *plan.sessions)
    found: dict[str, Any] = {"plan": asdict(plan), "sessions": [], "replicas": []}
    for replicas in sorted({1, *plan.replicas}):
        with running_server(
            deployment(POLICY, replicas=replicas, sessions={"limit": limit})
        ) as server:
            if replicas == 1:
                found["fleet"] = _point(plan, server, plan.robots, plan.hz)
                progress(
                    f"{plan.robots} robots: {found['fleet']['on_time']:.1%} of the acts on time"
                )
                for n in plan.sessions:
                    found["sessions"].append(_point(plan, server, n, rate / n))
                    progress(f"{n} sessions: {found['sessions'][-1]['p50_ms']:.2f} ms")
            if replicas in plan.replicas:
                found["replicas"].append(
                    {"replicas": replicas, **_point(plan, server, plan.robots, rate / plan.robots)}
                )
                progress(f"{replicas} replicas: {found['replicas'][-1]['p50_ms']:.2f} ms")
    return found


def _point(plan: GrowthPlan, server: Server, sessions: int, hz: float) -> dict[str, Any]:
    """Measure `sessions` robots that act at `hz` each."""
    parts = min(_PROCESSES, sessions)
    shares = [sessions // parts + (part < sessions % parts) for part in range(parts)]
    with contextlib.ExitStack() as stack:
        clients = []
        for share in shares:
            command = [
                sys.executable,
                "-m",
                "benchmarks.robots",
                server.url,
                plan.transport,
                str(share),
            ]
            clients.append(stack.enter_context(LineProcess("robots", command, our_environment())))
        replicas = Counter(
            pid for one in clients for pid in one.read(START_S + _CONNECT_S * sessions)
        )

        def run(seconds: float) -> np.ndarray:
            begin = time.monotonic() + _AHEAD_S
            for one in clients:
                one.send(json.dumps({"begin": begin, "end": begin + seconds, "hz": hz}))
            return np.array([ms for one in clients for ms in one.read(seconds + _LATE_S)])

        run(_WARM_S)
        pids = [one.pid for one in clients]
        used, served = UsageMeter(pids), UsageMeter(server_processes(os.getpid(), pids))
        _, idle_server_cores = count_idle([used, served])
        with used.counting(), served.counting():
            ms = run(plan.seconds)
    return {
        "sessions": sessions,
        "hz": hz,
        "acts": len(ms),
        "acts_per_s": len(ms) / plan.seconds,
        **figures(ms, hz),
        "idle_server_cores": idle_server_cores,
        "sessions_by_replica": sorted(replicas.values()),
        "client": used.per_act(len(ms)),
        "server": served.per_act(len(ms)),
    }


def figures(ms: np.ndarray, hz: float) -> dict[str, Any]:
    """Return the share of ticks whose call was on time, and quantiles of the calls, which end `ms`
    after their ticks at the rate `hz`.
    """
    # The tick of each call, and the ticks that passed during the call.
    ticks = np.maximum(1, np.ceil(ms * hz / 1e3))
    return {
        "on_time": float(np.sum(ms * hz <= 1e3) / np.sum(ticks)),
        "p50_ms": float(np.median(ms)),
        "p99_ms": float(np.quantile(ms, 0.99)),
    }


def show_growth(found: Mapping[str, Any]) -> None:
    """Print a row for the fleet, and for each point of the curves."""
    rows = table(
        "",
        "sessions",
        "replicas",
        "acts/s",
        "on time",
        "p50 ms",
        "p99 ms",
        "client CPU ms",
        "server CPU ms",
        "server waits",
        "server, cores",
        "idle",
        "sessions by replica",
    )
    for name, points in (("robots", [found["fleet"]]), *((name, found[name]) for name in CURVES)):
        for one in points:
            rows.add_row(
                name,
                str(one["sessions"]),
                str(one.get("replicas", 1)),
                f"{one['acts_per_s']:.1f}",
                f"{one['on_time']:.1%}",
                f"{one['p50_ms']:.2f}",
                f"{one['p99_ms']:.2f}",
                f"{one['client']['cpu_ms']:.3f}",
                f"{one['server']['cpu_ms']:.3f}",
                f"{one['server']['voluntary_switches']:.1f}",
                f"{1e-3 * one['server']['cpu_ms'] * one['acts_per_s']:.3f}",
                f"{one['idle_server_cores']:.3f}",
                ", ".join(map(str, one["sessions_by_replica"])),
            )
        rows.add_section()
    out.print(rows)


def plot_growth(found: Mapping[str, Any], file: Path) -> None:
    """Draw the median and the CPU time of a call by the number of sessions, and by the number of
    replicas.
    """
    figure = require("matplotlib.figure").Figure(figsize=(9, 3.5), layout="constrained")
    for axes, name in zip(figure.subplots(1, 2, sharey=True), CURVES, strict=True):
        counts = [one[name] for one in found[name]]
        for label, values in (
            ("median, from the tick", [one["p50_ms"] for one in found[name]]),
            ("CPU time of the server", [one["server"]["cpu_ms"] for one in found[name]]),
            ("CPU time of the client", [one["client"]["cpu_ms"] for one in found[name]]),
        ):
            axes.plot(counts, values, ".-", label=label)
        axes.set_xscale("log", base=2)
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.set_xlabel(name)
        axes.set_ylim(bottom=0)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("ms an act")
    figure.axes[0].legend(fontsize=8, frameon=False)
    figure.savefig(file, dpi=100)


def main(
    robots: Annotated[
        int,
        typer.Option(
            min=1, help="Number of robots of the fleet, and of sessions in the curve of replicas."
        ),
    ] = 64,
    hz: Annotated[
        float, typer.Option(min=0.1, help="Rate of each robot of the fleet, in Hz.")
    ] = 10.0,
    sessions: Annotated[
        str, typer.Option(help="Numbers of sessions with one replica.")
    ] = "1,4,16,64,256,1000",
    replicas: Annotated[str, typer.Option(help="Numbers of replicas.")] = "1,2,4,8",
    rate: Annotated[
        float,
        typer.Option(min=10, help="Actions per second of all sessions at each point of a curve."),
    ] = 50.0,
    seconds: Annotated[
        float, typer.Option(min=1, help="Duration of each measurement, in seconds.")
    ] = 20.0,
    transport: Annotated[str, typer.Option(help="websocket, http or shm.")] = "websocket",
    out_file: Out = None,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="File for the picture: .png, .svg or .pdf.")
    ] = None,
) -> None:
    """Measure a fleet of robots, and the cost of a call by the number of sessions and
    of replicas.
    """
    with errors():
        if transport not in TRANSPORTS:
            raise ConfigError(f"--transport: expected one of {list(TRANSPORTS)}, got {transport!r}")
        check_plot_file(plot)
        origin = measured_on("python -m benchmarks.growth")
        plan = GrowthPlan(
            robots=robots,
            hz=hz,
            sessions=parse_counts(sessions, "--sessions"),
            replicas=parse_counts(replicas, "--replicas"),
            acts_per_s=rate,
            seconds=seconds,
            transport=transport,
        )
        found = measure_growth(plan, progress)
        show_growth(found)
        save({**origin, **found}, out_file)
        if plot is not None:
            plot_growth(found, plot)


if __name__ == "__main__":
    typer.run(main)
