"""Counts the ticks in time and the successful robots behind this server, plain Ray Serve, openpi's
server and vlagents.

Robots run in separate processes. Each has two 224x224 RGB cameras. With the *chunk player*, it
executes a row of its newest chunk at each tick, and requests the next chunk in the background. The
ticks do not wait for the server: a tick without a row is late. A robot is in time if at least 98 %
of its ticks are. With the *waiting loop*, which is that of the other systems, it executes a chunk,
and then waits for the next one. `benchmarks.successful` defines successful robots and tasks per
GPU-hour, with the measured success of the reference policy at each delay.

The policy takes the time of a real one without computing: a batch of n takes `base + row * n` ms,
one batch at a time, as on one GPU; by default these are the times of π0 on an H200. From these
times follows the capacity: the number of robots that the policy could serve if all batches were
full and nothing else took time. Each system runs with a number of robots below and above it.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import socket
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer

from benchmarks import peers as others
from benchmarks.console import Out, Seconds, save, show_skipped
from benchmarks.figures import measured_on
from benchmarks.line_process import LineProcess, ProcessFailed, our_environment
from benchmarks.robot_process import CONNECT_S, OPENPI, OURS, RAY_SERVE, VLAGENTS, Loop, Robot
from benchmarks.successful import CHECKPOINT, ENOUGH, FleetSuccess, ServedRobot, curve_of
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray.success import SuccessCurve

SYSTEMS = (OURS, RAY_SERVE, OPENPI, VLAGENTS)
LOOPS: tuple[Loop, ...] = ("player", "waiting")
# Rows of an answer that robots execute, which take turns, by the name of a fleet.
FLEETS: Mapping[str, Sequence[int]] = {"8": (8,), "50": (50,), "mixed": (8, 50)}
# Clients by the names in `peers`.
_CLIENTS = {RAY_SERVE: "Ray Serve HTTP", OPENPI: "openpi", VLAGENTS: "vlagents JPEG"}
_SCHEMES = {RAY_SERVE: "http", OPENPI: "ws", VLAGENTS: "rpyc"}
_AHEAD_S = 0.5
_LATE_S = 90.0
# For a server that starts: time limit of an answer, and time between two attempts, s.
_ANSWER_S, _POLL_S = 5.0, 0.1
_ROBOTS_A_PROCESS = 16


@dataclass(frozen=True, slots=True)
class RobotsPlan:
    """The settings of `measure_robots`."""

    systems: Sequence[str] = SYSTEMS
    # The control loops of the robots, in turn.
    loops: Sequence[Loop] = LOOPS
    fleets: Sequence[str] = ("8",)  # names in `FLEETS`
    loads: Sequence[float] = (0.7, 1.05)  # numbers of robots, relative to the capacity
    hz: float = 10.0
    # Duration of a batch, and additional duration of each row, ms; those of π0 on an H200,
    # compiled.
    base_ms: float = 29.3
    row_ms: float = 8.06
    batch: int = 16  # largest batch
    warm: float = 10.0  # time before each measurement, s, as all robots start at once
    seconds: float = 20.0  # duration of each measurement, s
    checkpoint: Path = CHECKPOINT  # folder of the checkpoint whose success is assumed
    # Python interpreter of the other systems.
    python: Path = field(default=others.PYTHON)

    def capacity(self, fleet: str) -> float:
        """Return the number of robots that the policy could serve in time with the best size of its
        batches.

        A request waits for the running batch and for its own. A robot therefore needs the next
        chunk two batches before the end of its rows.
        """
        most = 0.0
        for size in range(1, self.batch + 1):
            batch_s = (self.base_ms + self.row_ms * size) / 1e3
            intervals_s = [rows / self.hz - 2 * batch_s for rows in FLEETS[fleet]]
            if min(intervals_s) > 0:
                requests_hz = float(np.mean([1 / interval_s for interval_s in intervals_s]))
                most = max(most, size / batch_s / requests_hz)
        return most


def measure_robots(
    plan: RobotsPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure all systems with all fleets and loads; returns plain JSON values."""
    clients, reasons, versions = others.peer_clients(["all"], plan.python)
    installed = {client.name: client for client in clients}
    peers = {client.name: client.peer for client in others.PEER_CLIENTS}
    points: list[dict[str, Any]] = []
    skipped: dict[str, str] = {}
    for system in plan.systems:
        client = _CLIENTS.get(system)
        if client is not None and client not in installed:
            skipped[system] = reasons[peers[client]]
            continue
        for fleet in plan.fleets:
            with _serving(plan, system, max(FLEETS[fleet]), installed) as url:
                for loop, load in itertools.product(plan.loops, plan.loads):
                    point = _point(plan, system, url, fleet, load, loop)
                    points.append(point)
                    progress(
                        f"{system}, {loop}: {point['robots']} robots, {point['in_time']} in time, "
                        f"{_whole(point['successful'])} successful, {point['share']:.1%} of ticks"
                    )
    return {
        "plan": asdict(plan) | {"python": str(plan.python), "checkpoint": str(plan.checkpoint)},
        "curves": {loop: _json(curve_of(plan.checkpoint, loop)) for loop in plan.loops},
        "points": points,
        "skipped": skipped,
        "versions": versions,
    }


def _json(curve: SuccessCurve | None) -> dict[str, Any] | None:
    return None if curve is None else curve.to_json()


@contextlib.contextmanager
def _serving(
    plan: RobotsPlan, system: str, chunk: int, installed: Mapping[str, others.PeerClient]
) -> Iterator[str]:
    """Run the server of a system within a context, and yield its URL."""
    costs = {"base_ms": plan.base_ms, "per_item_ms": plan.row_ms}
    if system == OURS:
        most = max(plan.loads) * max(plan.capacity(fleet) for fleet in plan.fleets)
        served = deployment(
            "noop",
            config={**costs, "chunk": chunk, "delta": True},
            batch={"max_size": plan.batch},
            sessions={"limit": 2 * round(most)},
        )
        with running_server(served) as server:
            yield server.url
        return

    policy = {**costs, "batch": plan.batch, "chunk": chunk}
    with others.serving(installed[_CLIENTS[system]], plan.python, {}, policy) as peer:
        _wait_until_ready(peer, system)
        yield "{}://{}:{}".format(_SCHEMES[system], *peer.address)


def _wait_until_ready(peer: others.PeerServer, system: str) -> None:
    """Wait until a server listens, and, if it is Ray Serve, until its replica answers.

    Raises:
        ProcessFailed: The server has ended, or is not ready in time.
    """
    host, port = peer.address
    deadline = time.monotonic() + others.READY_S
    while time.monotonic() < deadline:
        if peer.process is not None:
            peer.process.require_running()
        try:
            if system == RAY_SERVE:
                urllib.request.urlopen(f"http://{host}:{port}/", timeout=_ANSWER_S).close()
            else:
                socket.create_connection((host, int(port)), timeout=_ANSWER_S).close()
        except OSError:
            time.sleep(_POLL_S)
        else:
            return
    raise ProcessFailed(f"{system}: not ready within {others.READY_S:g} s")


def _point(
    plan: RobotsPlan, system: str, url: str, fleet: str, load: float, loop: Loop
) -> dict[str, Any]:
    """Measure one number of robots."""
    kinds = FLEETS[fleet]
    count = max(1, round(load * plan.capacity(fleet)))
    robots = [
        Robot(url, system, plan.hz, max(kinds), kinds[number % len(kinds)], loop)
        for number in range(count)
    ]
    figures = _run(robots, plan.warm, plan.seconds)
    return {
        "system": system,
        "loop": loop,
        "fleet": fleet,
        "load": load,
        "robots": count,
        **summary(figures, plan.hz, curve_of(plan.checkpoint, loop)),
        "failed": sorted({robot["failed"] for robot in figures if robot["failed"]}),
    }


def _run(robots: Sequence[Robot], warm: float, seconds: float) -> list[dict[str, Any]]:
    """Run robots in separate processes, which all begin at the same time, and return the figures of
    each.

    Args:
        robots: The robots.
        warm: The time before the measurement, s.
        seconds: The length of the measurement, s.
    """
    with contextlib.ExitStack() as stack:
        processes = []
        for first in range(0, len(robots), _ROBOTS_A_PROCESS):
            some = [asdict(robot) for robot in robots[first : first + _ROBOTS_A_PROCESS]]
            command = [sys.executable, "-m", "benchmarks.robot_process", json.dumps(some)]
            processes.append(stack.enter_context(LineProcess("robots", command, our_environment())))
        for process in processes:
            process.read(CONNECT_S)
        begin = time.monotonic() + _AHEAD_S
        counted = begin + warm
        times = {"begin": begin, "counted": counted, "end": counted + seconds}
        for process in processes:
            process.send(json.dumps(times))
        figures: list[dict[str, Any]] = []
        for process in processes:
            figures += process.read(warm + seconds + _LATE_S)
        return figures


def summary(
    robots: Sequence[Mapping[str, Any]], hz: float, curve: SuccessCurve | None
) -> dict[str, Any]:
    """Return the figures of some robots.

    Args:
        robots: The figures of each robot.
        hz: The rate of their ticks.
        curve: The success of the policy at each delay, with the loop of these robots. Without a
            curve, no wait is tolerated, and the figures of success are None.

    Returns:
        The numbers of robots in time and of successful robots, tasks per GPU-hour, shares of ticks
        (`share` in time, `waiting`: in waits that the loop chose), delays of answers in rows, and
        ages of actions in ms. Quantiles are None without values.
    """
    served = [
        ServedRobot(hz, robot["ticks"], robot["late"], robot["waits"], robot["delays"])
        for robot in robots
    ]
    success = None if curve is None else FleetSuccess.from_robots(served, curve)
    tolerated = 0 if curve is None else curve.tolerated
    ticks = max(1.0, sum(robot["ticks"] for robot in robots))
    shares = [robot.in_time(tolerated) for robot in served]
    in_time = sum(share * robot.ticks for share, robot in zip(shares, served, strict=True))
    delays = np.concatenate([robot["delays"] for robot in robots])
    within = None
    if curve is not None and len(delays):
        within = float(np.mean(delays <= tolerated))
    ages_p50, ages_p99 = _quantiles(np.concatenate([robot["ages"] for robot in robots]))
    delay_p50, delay_p99 = _quantiles(delays)
    return {
        "in_time": sum(share >= ENOUGH for share in shares),
        "successful": None if success is None else success.successful,
        "tasks_per_gpu_hour": None if success is None else success.tasks_per_gpu_hour,
        "share": in_time / ticks,
        "least_share": min(shares),
        "waiting": sum(sum(robot["waits"]) for robot in robots) / ticks,
        # Ticks that the robot's own process began too late, as the machine was busy.
        "missed": sum(robot["missed"] for robot in robots) / ticks,
        "within_tolerance": within,
        "delay_p50_rows": delay_p50,
        "delay_p99_rows": delay_p99,
        "age_p50_ms": ages_p50,
        "age_p99_ms": ages_p99,
    }


def _quantiles(values: np.ndarray) -> list[float | None]:
    """Return the median and the 99th percentile (values that occur); None without values, or for
    an answer without a row left.
    """
    if not len(values):
        return [None, None]
    quantiles = np.quantile(values, (0.5, 0.99), method="inverted_cdf")
    return [float(value) if np.isfinite(value) else None for value in quantiles]


def show_robots(measured: Mapping[str, Any]) -> None:
    """Print a row for each system, fleet and load."""
    rows = table(
        "system",
        "loop",
        "rows of a chunk",
        "robots",
        "of the capacity",
        "robots in time",
        "successful",
        "tasks per GPU-hour",
        "ticks in time",
        "of the worst robot",
        "waiting",
        "missed by the robots",
        "delay p50 rows",
        "p99",
        "age p50 ms",
        "p99",
    )
    for point in measured["points"]:
        rows.add_row(
            point["system"],
            point["loop"],
            point["fleet"],
            str(point["robots"]),
            f"{point['load']:.0%}",
            str(point["in_time"]),
            _whole(point["successful"]),
            _whole(point["tasks_per_gpu_hour"]),
            f"{point['share']:.1%}",
            f"{point['least_share']:.1%}",
            f"{point['waiting']:.1%}",
            f"{point['missed']:.1%}",
            *(_whole(point[f"delay_{quantile}_rows"]) for quantile in ("p50", "p99")),
            *(_whole(point[f"age_{quantile}_ms"]) for quantile in ("p50", "p99")),
        )
    out.print(rows)
    for point in measured["points"]:
        for reason in point["failed"]:
            out.print(f"{point['system']}, {point['robots']} robots: {reason}")
    show_skipped(measured)


def _whole(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}"


def parse_names(text: str, option: str, known: Sequence[str]) -> list[str]:
    """Parse a comma-separated list of names."""
    names = parse_list(text)
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"{option}: expected only {list(known)}, got {unknown}")
    return names


def parse_numbers(text: str, option: str, separator: str) -> list[float]:
    """Parse a list of numbers above 0."""
    try:
        numbers = [float(number) for number in text.split(separator)]
    except ValueError as error:
        raise ConfigError(
            f"{option}: expected numbers that are separated by {separator!r}, got {text!r}"
        ) from error
    if min(numbers) <= 0:
        raise ConfigError(f"{option}: expected numbers above 0, got {text!r}")
    return numbers


def main(
    systems: Annotated[
        str, typer.Option(help=f"Some of {', '.join(SYSTEMS)}, separated by commas.")
    ] = ",".join(SYSTEMS),
    chunks: Annotated[
        str,
        typer.Option(help="Rows that a robot executes of a chunk: some of 8, 50 and mixed."),
    ] = "8",
    loops: Annotated[
        str,
        typer.Option(
            help="Control loops: player (in the background), waiting (the other systems' own)."
        ),
    ] = ",".join(LOOPS),
    loads: Annotated[
        str, typer.Option(help="Numbers of robots, as shares of the capacity.")
    ] = "0.7,1.05",
    times: Annotated[
        str, typer.Option(help="Duration of a batch and of each row, BASE:ROW in ms.")
    ] = "29.3:8.06",
    warm: Annotated[
        float,
        typer.Option(min=0, help="Seconds before each measurement, as all robots start at once."),
    ] = 10.0,
    seconds: Seconds = 20.0,
    checkpoint: Annotated[
        Path, typer.Option(help="Folder of the checkpoint whose success at each delay is assumed.")
    ] = CHECKPOINT,
    peers_python: others.PeersPython = others.PYTHON,
    out_file: Out = None,
) -> None:
    """Count the ticks in time and the successful robots at 10 Hz behind each system."""
    with errors():
        durations = parse_numbers(times, "--times", ":")
        if len(durations) != 2:
            raise ConfigError(f"--times: expected BASE:ROW, got {times!r}")
        plan = RobotsPlan(
            systems=parse_names(systems, "--systems", SYSTEMS),
            loops=cast(Sequence[Loop], parse_names(loops, "--loops", LOOPS)),
            fleets=parse_names(chunks, "--chunks", tuple(FLEETS)),
            loads=parse_numbers(loads, "--loads", ","),
            base_ms=durations[0],
            row_ms=durations[1],
            warm=warm,
            seconds=seconds,
            checkpoint=checkpoint,
            python=peers_python,
        )
        for fleet in plan.fleets:
            if plan.capacity(fleet) < 1:
                raise ConfigError(
                    f"--times: expected durations with which one robot with --chunks {fleet} is in "
                    f"time, got {times}"
                )
        origin = measured_on("python -m benchmarks.robots")
        measured = measure_robots(plan, progress)
        show_robots(measured)
        save(
            {**origin, **measured, "versions": origin["versions"] | measured["versions"]}, out_file
        )


if __name__ == "__main__":
    typer.run(main)
