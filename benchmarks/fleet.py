"""Robots served in time: how many robots of a rate a server can give their actions, and how old
those are.

The policy takes the time of a real one without computing: a batch of n takes `base + row * n` ms,
one batch at a time, as on one GPU. Each robot has two 224x224 RGB cameras, executes a row of its
newest chunk at each of its ticks, and asks for the next chunk in the background. The ticks come
whatever the server does. A tick without a row is starved; the share in time of a robot is that of
its other ticks, and a robot is served if its share is at least 98 %.

Systems: this server; the same server for clients that do not say how long they can wait; plain Ray
Serve with `@serve.batch`; openpi's server, shared by all robots, and one for each robot on the same
accelerator; vlagents' server. All robots use the same chunk player.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks import peers as others
from benchmarks.console import Out, parse_counts, save, show_skipped
from benchmarks.figures import measured_on
from benchmarks.fleet_robots import CONNECT_S, Robot
from benchmarks.processes import cpu_seconds, server_processes
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.fleet import CostCurve, RobotNeed, replica_load
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray_cluster.tune.line_process import LineProcess, our_environment

CURVES = {  # base and row, ms
    "pi0": (29.3, 8.06),  # on an H200, compiled
    "pi0-graphs": (41.5, 10.5),  # on an H200, CUDA graphs
    "small": (5.0, 0.5),
}
OURS, TODAY = "vlagents_ray", "vlagents_ray without slack"
RAY_SERVE, OPENPI, OPENPI_EACH, VLAGENTS = "ray serve", "openpi", "openpi each", "vlagents"
SYSTEMS = (OURS, TODAY, RAY_SERVE, OPENPI, OPENPI_EACH, VLAGENTS)
_CLIENTS = {  # by the names of `benchmarks.peers`
    RAY_SERVE: "Ray Serve HTTP",
    OPENPI: "openpi",
    OPENPI_EACH: "openpi",
    VLAGENTS: "vlagents JPEG",
}
SERVED = 0.98  # share in time of a robot that counts as served
_AHEAD_S = 0.5
_LATE_S = 90.0
_ROBOTS_A_PROCESS = 16


@dataclass(frozen=True, slots=True)
class Kind:
    """Robots of one kind."""

    hz: float
    rows: int  # that it executes of an answer at most
    weight: int = 1  # their part of the fleet


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """The settings of `measure_fleet`."""

    systems: Sequence[str] = (OURS, TODAY)
    robots: Sequence[int] = (8, 16, 32, 64)
    kinds: Sequence[Kind] = (Kind(10.0, 50),)
    chunk: int = 50  # rows of an answer
    base_ms: float = 29.3
    row_ms: float = 8.06
    batch: int = 16
    warm: float = 10.0  # s before each measurement: all robots start at once
    seconds: float = 20.0  # of each measurement
    transport: str = "websocket"
    real_time_chunking: bool = False
    python: Path = field(default=others.FOLDER / "bin" / "python")  # of the peers

    def fleet(self, robots: int) -> list[Kind]:
        """Return the kind of each robot, in turns by their weights."""
        turn: list[Kind] = []
        for kind in self.kinds:
            turn += [kind] * kind.weight
        return [turn[robot % len(turn)] for robot in range(robots)]


def measure_fleet(
    plan: FleetPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure all systems with all numbers of robots; returns plain JSON values."""
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
        for point in _measure_system(plan, system, installed):
            points.append(point)
            progress(
                f"{system}: {point['robots']} robots, {point['served']} served, "
                f"{point['share']:.1%} of the ticks in time"
            )

    curve = CostCurve(plan.base_ms / 1e3, plan.row_ms / 1e3)
    arithmetic = [
        {"robots": robots, "load": _load(curve, plan.fleet(robots), plan.batch)}
        for robots in plan.robots
    ]
    return {
        "plan": {**asdict(plan), "python": str(plan.python)},
        "points": points,
        "arithmetic": arithmetic,
        "skipped": skipped,
        "versions": versions,
    }


def _measure_system(
    plan: FleetPlan, system: str, installed: Mapping[str, others.PeerClient]
) -> Iterator[dict[str, Any]]:
    """Measure a system with all numbers of robots; a server for each robot starts each time."""
    if system == OPENPI_EACH:
        for robots in plan.robots:
            with _serving(plan, system, robots, installed) as urls:
                yield _point(plan, system, robots, urls)
        return
    with _serving(plan, system, max(plan.robots), installed) as urls:
        for robots in plan.robots:
            yield _point(plan, system, robots, urls[:robots])


def _load(curve: CostCurve, fleet: Sequence[Kind], batch: int) -> float:
    needs: dict[RobotNeed, int] = {}
    for kind in fleet:
        need = RobotNeed(kind.hz, kind.rows)
        needs[need] = needs.get(need, 0) + 1
    return replica_load(curve, needs, batch).load


@contextlib.contextmanager
def _serving(
    plan: FleetPlan, system: str, robots: int, installed: Mapping[str, others.PeerClient]
) -> Iterator[list[str]]:
    """Run the server of a system within a context, and yield the URL of each robot."""
    costs = {"base_ms": plan.base_ms, "per_item_ms": plan.row_ms}
    if system in (OURS, TODAY):
        config = deployment(
            "noop",
            config={**costs, "chunk": plan.chunk, "delta": True},
            batch={"max_size": plan.batch},
            sessions={"limit": 2 * max(plan.robots)},
        )
        with running_server(config) as server:
            yield [server.url] * robots
        return

    client = installed[_CLIENTS[system]]
    with contextlib.ExitStack() as stack:
        policy: dict[str, Any] = {**costs, "batch": plan.batch, "chunk": plan.chunk}
        servers = 1
        if system == OPENPI_EACH:
            servers = robots
            folder = stack.enter_context(tempfile.TemporaryDirectory())
            policy["accelerator"] = str(Path(folder) / "accelerator")
        scheme = {RAY_SERVE: "http", VLAGENTS: "rpyc"}.get(system, "ws")
        urls = []
        for _ in range(servers):
            peer = stack.enter_context(others.serving(client, plan.python, {}, policy))
            urls.append("{}://{}:{}".format(scheme, *peer.address))
        _wait_until_listening(urls)
        yield urls * robots if servers == 1 else urls


def _wait_until_listening(urls: Sequence[str]) -> None:
    from benchmarks.peers.peer import wait_for_port

    for url in urls:
        _, _, address = url.partition("://")
        host, _, port = address.partition(":")
        wait_for_port(host, int(port))


def _point(plan: FleetPlan, system: str, robots: int, urls: Sequence[str]) -> dict[str, Any]:
    """Measure a fleet of a number of robots."""
    ways = {RAY_SERVE: RAY_SERVE, OPENPI: "openpi", OPENPI_EACH: "openpi", VLAGENTS: "vlagents"}
    fleet = [
        Robot(
            url,
            kind.hz,
            plan.chunk,
            rows=kind.rows,
            way=ways.get(system, plan.transport),
            states_slack=system == OURS,
            real_time_chunking=plan.real_time_chunking and system in (OURS, TODAY),
        )
        for url, kind in zip(urls, plan.fleet(robots), strict=True)
    ]
    run = run_robots(fleet, plan.warm, plan.seconds)
    figures = run.figures
    robot_hours = robots * plan.seconds / 3600
    point = {
        "system": system,
        "robots": robots,
        **summary(figures),
        "client_cpu_s": run.client_cpu_s / robot_hours,
        "server_cpu_s": run.server_cpu_s / robot_hours,
        "failed": sorted({robot["failed"] for robot in figures if robot["failed"]}),
        "kinds": [],
    }
    kinds = plan.fleet(robots)
    for kind in plan.kinds:
        of_kind = [robot for robot, its in zip(figures, kinds, strict=True) if its == kind]
        if of_kind:
            point["kinds"].append({"hz": kind.hz, "rows": kind.rows, **summary(of_kind)})
    return point


@dataclass(frozen=True, slots=True)
class RobotsRun:
    """What robots got, and the CPU time that they and their servers took, s."""

    figures: Sequence[Mapping[str, Any]]  # of each robot
    client_cpu_s: float
    server_cpu_s: float


def run_robots(fleet: Sequence[Robot], warm: float, seconds: float) -> RobotsRun:
    """Run robots in processes of their own, all of which begin at once.

    Args:
        fleet: The robots.
        warm: The time before the measurement, s.
        seconds: The length of the measurement, s.
    """
    with contextlib.ExitStack() as stack:
        processes = start_robots(stack, fleet)
        client_pids = [process.pid for process in processes]
        server_pids = server_processes(os.getpid(), client_pids)
        begin = time.monotonic() + _AHEAD_S
        counted = begin + warm
        times = {"begin": begin, "counted": counted, "end": counted + seconds}
        for process in processes:
            process.send(json.dumps(times))
        time.sleep(max(0.0, counted - time.monotonic()))
        clients_before, server_before = _cpu_s(client_pids), _cpu_s(server_pids)
        figures: list[dict[str, Any]] = []
        for process in processes:
            figures += process.read(seconds + _LATE_S)
        return RobotsRun(
            figures, _cpu_s(client_pids) - clients_before, _cpu_s(server_pids) - server_before
        )


def start_robots(stack: contextlib.ExitStack, fleet: Sequence[Robot]) -> list[LineProcess]:
    """Start the processes of robots, which `stack` ends, and return them connected."""
    processes = []
    for first in range(0, len(fleet), _ROBOTS_A_PROCESS):
        robots_of_process = fleet[first : first + _ROBOTS_A_PROCESS]
        arguments = json.dumps([asdict(robot) for robot in robots_of_process])
        command = [sys.executable, "-m", "benchmarks.fleet_robots", arguments]
        processes.append(stack.enter_context(LineProcess("robots", command, our_environment())))
    for process in processes:
        process.read(CONNECT_S)
    return processes


def _cpu_s(pids: Sequence[int]) -> float:
    seconds = 0.0
    for pid in pids:
        with contextlib.suppress(OSError):  # it has ended
            seconds += cpu_seconds(pid)
    return seconds


def summary(robots: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of some robots: the share of their ticks, and the ages of actions, ms."""
    shares = [1 - robot["starved"] / max(1, robot["ticks"]) for robot in robots]
    ticks = sum(robot["ticks"] for robot in robots)
    starved = sum(robot["starved"] for robot in robots)
    ages = np.concatenate([robot["ages"] for robot in robots])
    if not len(ages):
        ages = np.array([np.nan])
    p50, p95, p99 = (float(age) for age in np.quantile(ages, (0.5, 0.95, 0.99)))
    return {
        "served": sum(share >= SERVED for share in shares),
        "share": 1 - starved / max(1, ticks),
        "least_share": min(shares),
        "missed": sum(robot.get("missed", 0) for robot in robots),
        "age_p50_ms": p50,
        "age_p95_ms": p95,
        "age_p99_ms": p99,
    }


def most_served(points: Sequence[Mapping[str, Any]], system: str) -> int:
    """Return the largest number of robots that a system served, each of them in time."""
    served = [
        point["robots"]
        for point in points
        if point["system"] == system and point["served"] == point["robots"]
    ]
    return max(served, default=0)


def show_fleet(measured: Mapping[str, Any]) -> None:
    """Print a row for each system and number of robots."""
    rows = table(
        "system",
        "robots",
        "load",
        "served",
        "in time",
        "least",
        "age p50 ms",
        "p95",
        "p99",
        "client CPU s a robot-hour",
        "server",
    )
    loads = {point["robots"]: point["load"] for point in measured["arithmetic"]}
    for point in measured["points"]:
        rows.add_row(
            point["system"],
            str(point["robots"]),
            f"{loads[point['robots']]:.2f}",
            str(point["served"]),
            f"{point['share']:.1%}",
            f"{point['least_share']:.1%}",
            f"{point['age_p50_ms']:.0f}",
            f"{point['age_p95_ms']:.0f}",
            f"{point['age_p99_ms']:.0f}",
            f"{point['client_cpu_s']:.0f}",
            f"{point['server_cpu_s']:.0f}",
        )
    out.print(rows)
    show_skipped(measured)


def parse_kinds(text: str) -> list[Kind]:
    """Parse HZ:ROWS or HZ:ROWS:WEIGHT with commas between them."""
    kinds = []
    for kind in parse_list(text):
        numbers = kind.split(":")
        try:
            kinds.append(Kind(float(numbers[0]), *(int(number) for number in numbers[1:])))
        except (TypeError, ValueError) as error:
            raise ConfigError(
                f"--kinds: expected HZ:ROWS or HZ:ROWS:WEIGHT, as in 10:50, got {kind!r}"
            ) from error
    return kinds


def main(
    systems: Annotated[
        str, typer.Option(help=f"Some of {', '.join(SYSTEMS)}, with commas between them.")
    ] = f"{OURS},{TODAY}",
    robots: Annotated[str, typer.Option(help="Numbers of robots.")] = "8,16,32,64",
    kinds: Annotated[
        str, typer.Option(help="Robots as HZ:ROWS or HZ:ROWS:WEIGHT; they take turns.")
    ] = "10:50",
    chunk: Annotated[int, typer.Option(min=1, help="Rows of an answer.")] = 50,
    curve: Annotated[
        str, typer.Option(help=f"One of {', '.join(CURVES)}, or BASE:ROW in ms.")
    ] = "pi0",
    batch: Annotated[int, typer.Option(min=1, help="Largest batch.")] = 16,
    warm: Annotated[
        float, typer.Option(min=0, help="Seconds before each: all robots start at once.")
    ] = 10.0,
    seconds: Annotated[float, typer.Option(min=1, help="Of each measurement.")] = 20.0,
    transport: Annotated[str, typer.Option(help="websocket, http or shm.")] = "websocket",
    rtc: Annotated[bool, typer.Option("--rtc", help="Send the rest of the plan.")] = False,
    out_file: Out = None,
) -> None:
    """Measure how many robots each system serves in time."""
    with errors():
        names = parse_list(systems)
        if unknown := [name for name in names if name not in SYSTEMS]:
            raise ConfigError(f"--systems: expected some of {list(SYSTEMS)}, got {unknown}")
        if curve in CURVES:
            base_ms, row_ms = CURVES[curve]
        else:
            try:
                base_ms, row_ms = (float(number) for number in curve.split(":"))
            except ValueError as error:
                raise ConfigError(
                    f"--curve: expected one of {list(CURVES)}, or BASE:ROW, got {curve!r}"
                ) from error
        origin = measured_on("python -m benchmarks.fleet")
        plan = FleetPlan(
            systems=names,
            robots=parse_counts(robots, "--robots"),
            kinds=parse_kinds(kinds),
            chunk=chunk,
            base_ms=base_ms,
            row_ms=row_ms,
            batch=batch,
            warm=warm,
            seconds=seconds,
            transport=transport,
            real_time_chunking=rtc,
        )
        measured = measure_fleet(plan, progress)
        show_fleet(measured)
        for system in names:
            out.print(f"{system}: at most {most_served(measured['points'], system)} robots")
        save({**origin, **measured}, out_file)


if __name__ == "__main__":
    typer.run(main)
