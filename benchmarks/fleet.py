"""Measures how many robots of a rate a server can serve in time, and the ages of their actions.

The policy takes the time of a real one without computing: a batch of n takes `base + row * n` ms,
one batch at a time, as on one GPU. Each robot has two 224x224 RGB cameras, executes a row of its
newest chunk at each of its ticks, and requests the next chunk in the background. The ticks do not
wait for the server. A tick without a row is starved. A robot counts as served if at least 98 % of
its ticks are not starved.

Systems: this server; the same server with clients that do not report their slack; plain Ray Serve
with `@serve.batch`; openpi's server, shared by all robots, and one for each robot on the same
accelerator; vlagents' server. All robots use the same chunk player.
"""

from __future__ import annotations

import contextlib
import json
import sys
import tempfile
import urllib.request
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from benchmarks import peers as others
from benchmarks.console import Out, parse_counts, save, show_skipped
from benchmarks.figures import measured_on
from benchmarks.fleet_robots import Robot
from benchmarks.fleet_runs import run_robots, summary
from benchmarks.link import INSIDE, SERVER, EmulatedLink, answer_from_inside, run_inside
from benchmarks.round_trips import LOOPBACK
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.fleet import CostCurve, RobotNeed, replica_load
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

CURVES = {  # duration of a batch and of each row, ms
    "pi0": (29.3, 8.06),  # measured on an H200, compiled
    "pi0-graphs": (41.5, 10.5),  # measured on an H200, CUDA graphs
    "small": (5.0, 0.5),
}
OURS, TODAY = "vlagents_ray", "vlagents_ray without slack"
RAY_SERVE, OPENPI, OPENPI_EACH, VLAGENTS = "ray serve", "openpi", "openpi each", "vlagents"
SYSTEMS = (OURS, TODAY, RAY_SERVE, OPENPI, OPENPI_EACH, VLAGENTS)
TRANSPORTS = ("websocket", "http", "shm")
_METADATA_S = 20.0
_CLIENTS = {  # clients by the names in `benchmarks.peers`
    RAY_SERVE: "Ray Serve HTTP",
    OPENPI: "openpi",
    OPENPI_EACH: "openpi",
    VLAGENTS: "vlagents JPEG",
}


@dataclass(frozen=True, slots=True)
class Kind:
    """Robots of one kind."""

    hz: float
    rows: int  # maximum number of rows of an answer that a robot executes
    weight: int = 1  # share of the fleet relative to the other kinds


@dataclass(frozen=True, slots=True)
class FleetPlan:
    """The settings of `measure_fleet`."""

    systems: Sequence[str] = (OURS, TODAY)
    robots: Sequence[int] = (8, 16, 32, 64)
    kinds: Sequence[Kind] = (Kind(10.0, 50),)
    chunk: int = 50  # number of rows in an answer
    base_ms: float = 29.3
    row_ms: float = 8.06
    batch: int = 16
    warm: float = 10.0  # time before each measurement, s, as all robots start at once
    seconds: float = 20.0  # duration of each measurement, s
    transport: str = "websocket"
    real_time_chunking: bool = False
    link: str | None = None  # rate of an emulated link, in the notation of `tc`; None for no link
    # Delay of the link in each direction, in the notation of `tc`; None adds none.
    delay: str | None = None
    # Python interpreter of the other systems.
    python: Path = field(default=others.FOLDER / "bin" / "python")

    def to_json(self) -> dict[str, Any]:
        """Return the settings as JSON values, from which `from_json` makes an equal plan."""
        # Not resolved: a virtual environment's Python is a link.
        return {**asdict(self), "python": str(self.python.absolute())}

    @classmethod
    def from_json(cls, settings: Mapping[str, Any]) -> FleetPlan:
        """Return a plan from the result of `to_json`."""
        kinds = [Kind(**kind) for kind in settings["kinds"]]
        return cls(**{**settings, "kinds": kinds, "python": Path(settings["python"])})

    def fleet(self, robots: int) -> list[Kind]:
        """Return the kind of each robot, interleaved by their weights."""
        turn: list[Kind] = []
        for kind in self.kinds:
            turn += [kind] * kind.weight
        return [turn[robot % len(turn)] for robot in range(robots)]


@dataclass(frozen=True, slots=True)
class Network:
    """The address at which servers listen, and the way in which robots reach them."""

    host: str = LOOPBACK
    prefix: Sequence[str] = ()  # words that precede the command of the robots' processes


def measure_fleet(
    plan: FleetPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure all systems with all numbers of robots; returns plain JSON values.

    Raises:
        ConfigError: The plan has a link, and this machine or user cannot make network namespaces.
    """
    if plan.link is None:
        return _measure_in(Network(), plan, progress)
    settings = {"plan": plan.to_json(), "rate": plan.link, "delay": plan.delay}
    measured: dict[str, Any] = run_inside("benchmarks.fleet", settings, progress)
    return measured


def _measure_inside(
    plan: Mapping[str, Any], rate: str, delay: str | None, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Measure in the server's network namespace, over an emulated link."""
    with EmulatedLink(rate, delay) as link:
        megabits = link.megabits()
        progress(f"the link carries {megabits:.0f} Mbit/s")
        network = Network(SERVER, link.prefix)
        measured = _measure_in(network, FleetPlan.from_json(plan), progress)
    return {**measured, "measured_mbit_per_s": megabits}


def _measure_in(
    network: Network, plan: FleetPlan, progress: Callable[[str], None]
) -> dict[str, Any]:
    """Measure all systems with servers and robots in a network."""
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
        for point in _measure_system(network, plan, system, installed):
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
        "plan": plan.to_json(),
        "points": points,
        "arithmetic": arithmetic,
        "skipped": skipped,
        "versions": versions,
    }


def _measure_system(
    network: Network,
    plan: FleetPlan,
    system: str,
    installed: Mapping[str, others.PeerClient],
) -> Iterator[dict[str, Any]]:
    """Measure a system with all numbers of robots; if each robot has a server, the servers are
    started each time.
    """
    if system == OPENPI_EACH:
        for robots in plan.robots:
            with _serving(network, plan, system, robots, installed) as urls:
                yield _point(network, plan, system, urls)
        return
    with _serving(network, plan, system, max(plan.robots), installed) as urls:
        for robots in plan.robots:
            yield _point(network, plan, system, urls[:robots])


def _load(curve: CostCurve, fleet: Sequence[Kind], batch: int) -> float:
    needs: dict[RobotNeed, int] = {}
    for kind in fleet:
        need = RobotNeed(kind.hz, kind.rows)
        needs[need] = needs.get(need, 0) + 1
    return replica_load(curve, needs, batch).load


@contextlib.contextmanager
def _serving(
    network: Network,
    plan: FleetPlan,
    system: str,
    robots: int,
    installed: Mapping[str, others.PeerClient],
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
        # No keys are needed: a host other than loopback is one end of a link that only this run
        # uses.
        is_open = network.host != LOOPBACK
        with running_server(config, host=network.host, insecure=is_open) as server:
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
            peer = stack.enter_context(
                others.serving(client, plan.python, {}, policy, host=network.host)
            )
            urls.append("{}://{}:{}".format(scheme, *peer.address))
        _wait_until_listening(urls)
        yield urls * robots if servers == 1 else urls


def _wait_until_listening(urls: Sequence[str]) -> None:
    from benchmarks.peers.peer import wait_for_port

    for url in urls:
        _, _, address = url.partition("://")
        host, _, port = address.partition(":")
        wait_for_port(host, int(port))


def _point(network: Network, plan: FleetPlan, system: str, urls: Sequence[str]) -> dict[str, Any]:
    """Measure a fleet with a robot for each URL."""
    robots = len(urls)
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
    run = run_robots(fleet, plan.warm, plan.seconds, network.prefix)
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
    if system in (OURS, TODAY):
        # The load follows from what the server has measured: batches take longer than the policy
        # alone.
        batch_ms = batch_ms_of(urls[0])
        point["batch_ms"] = batch_ms
        if batch_ms:
            durations_s = [(int(size), ms / 1e3) for size, ms in batch_ms.items()]
            point["measured_load"] = _load(CostCurve(table=tuple(durations_s)), kinds, plan.batch)
    for kind in plan.kinds:
        of_kind = [robot for robot, its in zip(figures, kinds, strict=True) if its == kind]
        if of_kind:
            point["kinds"].append({"hz": kind.hz, "rows": kind.rows, **summary(of_kind)})
    return point


def batch_ms_of(url: str) -> dict[str, float]:
    """Return the durations of batches that a server of ours has measured, ms by size; empty if
    they are too short to matter.
    """
    with urllib.request.urlopen(f"{url}/v1/metadata", timeout=_METADATA_S) as answer:  # noqa: S310
        costs = json.load(answer)["batch_costs"]
    batch_ms: dict[str, float] = {} if costs is None else costs["ms_by_size"]
    return batch_ms


def most_served(points: Sequence[Mapping[str, Any]], system: str) -> int:
    """Return the largest number of robots with which a system served each robot in time."""
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
        "measured",
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
            f"{point['measured_load']:.2f}" if "measured_load" in point else "",
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
    """Parse a comma-separated list of HZ:ROWS or HZ:ROWS:WEIGHT."""
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
        str, typer.Option(help=f"Some of {', '.join(SYSTEMS)}, separated by commas.")
    ] = f"{OURS},{TODAY}",
    robots: Annotated[str, typer.Option(help="Numbers of robots.")] = "8,16,32,64",
    kinds: Annotated[
        str,
        typer.Option(help="Kinds of robots as HZ:ROWS or HZ:ROWS:WEIGHT, which are interleaved."),
    ] = "10:50",
    chunk: Annotated[int, typer.Option(min=1, help="Number of rows in an answer.")] = 50,
    curve: Annotated[
        str, typer.Option(help=f"One of {', '.join(CURVES)}, or BASE:ROW in ms.")
    ] = "pi0",
    batch: Annotated[int, typer.Option(min=1, help="Largest batch.")] = 16,
    warm: Annotated[
        float,
        typer.Option(min=0, help="Seconds before each measurement, as all robots start at once."),
    ] = 10.0,
    seconds: Annotated[
        float, typer.Option(min=1, help="Duration of each measurement, in seconds.")
    ] = 20.0,
    transport: Annotated[str, typer.Option(help="websocket, http or shm.")] = "websocket",
    rtc: Annotated[
        bool, typer.Option("--rtc", help="Send the remaining rows of the plan with each request.")
    ] = False,
    link: Annotated[
        str | None,
        typer.Option(help="Rate of an emulated link to the robots, as tc writes it: 1gbit."),
    ] = None,
    delay: Annotated[
        str | None,
        typer.Option(
            help="Delay of the link in each direction, as tc writes it: 2ms. Needs the "
            "kernel's netem."
        ),
    ] = None,
    peers_python: others.PeersPython = others.PYTHON,
    out_file: Out = None,
) -> None:
    """Measure how many robots each system serves in time."""
    with errors():
        names = parse_list(systems)
        if unknown := [name for name in names if name not in SYSTEMS]:
            raise ConfigError(f"--systems: expected only {list(SYSTEMS)}, got {unknown}")
        if transport not in TRANSPORTS:
            raise ConfigError(f"--transport: expected one of {list(TRANSPORTS)}, got {transport!r}")
        if delay is not None and link is None:
            raise ConfigError("--delay: expected --link with it, got none; add --link 1gbit")
        if link is not None and transport == "shm":
            raise ConfigError(
                "--link: expected --transport websocket or http with it, got shm, which does not "
                "cross a network"
            )
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
            link=link,
            delay=delay,
            python=peers_python,
        )
        measured = measure_fleet(plan, progress)
        show_fleet(measured)
        for system in names:
            out.print(f"{system}: at most {most_served(measured['points'], system)} robots")
        save({**origin, **measured}, out_file)


if __name__ == "__main__":
    if sys.argv[1:2] == [INSIDE]:
        answer_from_inside(_measure_inside, sys.argv[2])
    else:
        typer.run(main)
