"""Measures the actions per second that many clients receive from one replica, compared with those
of the policy alone.

The default policy takes 20 ms for a batch and 1 ms for each observation in it, without using the
CPU: with 16 in a batch, 444 actions a second are the ideal. Any other policy is measured bare in
the same run. All transports alternate. A robot that sends requests at random times among
simulations is also measured. Other policy servers are measured with the same policy, in batches of
at most 16 if they support batches.
"""

from __future__ import annotations

import contextlib
import json
import random
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks import peers as others
from benchmarks.closed_loop import Call
from benchmarks.console import Out, Rounds, Seconds, parse_counts, save, show_skipped
from benchmarks.drivers import START_S
from benchmarks.figures import mean_interval, measured_on, median_interval
from benchmarks.line_process import LineProcess, our_environment
from benchmarks.measured_policy import rate_of
from benchmarks.own_clients import (
    LoadGenerator,
    OwnClient,
    observation,
    own_clients,
    save_observation,
)
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import Set, parse_list
from vlagents_ray.errors import ConfigError
from vlagents_ray.overrides import parse_settings
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.serve.launch.server import running_server

DEFAULT_TRANSPORTS = ("plasma", "handle", "shm", "websocket")
BASE_MS, PER_ITEM_MS = 20.0, 1.0
SLOW_NOOP = ("noop", {"base_ms": BASE_MS, "per_item_ms": PER_ITEM_MS})
_PROCESSES = 4  # number of processes that share the clients, in addition to the robot's process
_WARM_S = 0.5
_LATE_S = 60.0
_BARE = "benchmarks.bare_policy"


@dataclass(frozen=True, slots=True)
class ThroughputPlan:
    """The settings of `measure_throughput`."""

    policy: str = SLOW_NOOP[0]
    config: Mapping[str, Any] = field(default_factory=lambda: SLOW_NOOP[1])
    num_gpus: float = 0  # number of GPUs that Ray assigns to the replica
    batch: int = 16
    # Numbers of clients, ascending; the last one is measured in each round.
    clients: Sequence[int] = (1, 2, 4, 8, 16, 32)
    seconds: float = 2.0  # duration of each measurement, s
    rounds: int = 3
    robot_seconds: float = 10.0
    transports: Sequence[str] = DEFAULT_TRANSPORTS
    peers: Sequence[str] = ()  # names of `peers.PEERS`, or "all", which need the policy `noop`
    peers_python: Path = others.PYTHON

    @property
    def ideal(self) -> Callable[[int], float] | None:
        """The actions per second of K clients if only the policy took time; None if this rate must
        be measured.
        """
        if self.policy != "noop":
            return None
        base = float(self.config.get("base_ms", 0.0))
        each = float(self.config.get("per_item_ms", 0.0))
        if base + each == 0:
            return None
        return lambda clients: (
            min(clients, self.batch) * 1e3 / (base + each * min(clients, self.batch))
        )


def measure_throughput(
    plan: ThroughputPlan, progress: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Measure the plan, with all fleets in a new random order in each round, and return plain JSON
    values.
    """
    chosen = _one_each(own_clients(plan.transports))
    theirs, absent, versions = others.peer_clients(plan.peers, plan.peers_python)
    skipped = absent | {one.name: "its server has one client" for one in theirs if not one.several}
    served = deployment(
        plan.policy,
        config=dict(plan.config),
        batch={"max_size": plan.batch},
        resources={"num_gpus": plan.num_gpus},
    )
    most = max(plan.clients)
    with contextlib.ExitStack() as stack:
        bare = None if plan.ideal else stack.enter_context(_bare(plan))
        server = stack.enter_context(running_server(served))
        (app,) = server.apps
        ours = {
            one.transport: stack.enter_context(_fleet(one, server.url, app, most)) for one in chosen
        }
        obs = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "observation.npz"
        save_observation(observation(), obs)
        running: dict[str, others.PeerServer] = {}
        peers = {
            one.name: stack.enter_context(peer_fleet(one, plan, obs, running))
            for one in theirs
            if one.several
        }
        fleets = ours | peers
        turns: dict[str, _Turns] = {
            name: _Turns({k: [] for k in plan.clients}, []) for name in fleets
        }
        bare_rates = []
        order = list(fleets)
        for number in range(plan.rounds):
            if bare is not None:
                bare_rates.append(float(bare.request(str(plan.seconds), plan.seconds + START_S)))
            random.Random(number).shuffle(order)
            for k in plan.clients:
                for name in order:
                    turns[name].calls[k].append(fleets[name].run(0, k, plan.seconds))
                progress(f"round {number + 1} of {plan.rounds}: {k} clients of each")
            for name in order if plan.robot_seconds else ():
                among = fleets[name].run(1, most - 1, plan.robot_seconds / plan.rounds)
                turns[name].robot.extend(among[0])
    best = plan.ideal(most) if plan.ideal else statistics.median(bare_rates)
    return {
        "policy": plan.policy,
        "config": dict(plan.config),
        "batch": plan.batch,
        "clients": most,
        "ideal_actions_per_s": best,
        "ideal_is": "bare, measured in the same run" if bare_rates else "by arithmetic",
        "bare_rounds": bare_rates,
        "transports": {
            one.transport: {"way": one.name, **_row(plan, turns[one.transport], best)}
            for one in chosen
        },
        "peers": {name: _row(plan, turns[name], best) for name in peers},
        "skipped": skipped,
        "versions": versions,
    }


@dataclass(frozen=True, slots=True)
class _Turns:
    """The calls of a fleet."""

    calls: dict[int, list[list[list[Call]]]]  # calls by number of clients, round and client
    robot: list[Call]


@dataclass(frozen=True, slots=True)
class _Part:
    """Some of the clients, in one process or actor."""

    start: Callable[[dict[str, Any]], Any]
    result: Callable[[Any, float], Any]


@dataclass(frozen=True, slots=True)
class Fleet:
    """All clients of one transport or peer: one robot in the first part, and simulations in the
    other parts, if there are any.
    """

    parts: Sequence[_Part]
    turn: Callable[[], AbstractContextManager[None]] = contextlib.nullcontext

    def run(self, robots: int, simulations: int, seconds: float) -> list[list[Call]]:
        """Run clients for `seconds`, and return the calls of each client, the robot first."""
        counts = _shares(simulations, len(self.parts) - 1) if self.parts[1:] else [simulations]
        shares = [(robots, 0)] * bool(self.parts[1:]) + [(0, count) for count in counts]
        shares[0] = (robots, shares[0][1])
        with self.turn():
            begin = time.monotonic() + _WARM_S
            spec = {"begin": begin, "end": begin + seconds}
            pending = [
                (part, part.start({"robots": some, "simulations": more, **spec}))
                for part, (some, more) in zip(self.parts, shares, strict=True)
                if some + more
            ]
            return [
                calls
                for part, handle in pending
                for calls in part.result(handle, seconds + _LATE_S)
            ]


@contextlib.contextmanager
def _fleet(client: OwnClient, url: str, app: str, clients: int) -> Iterator[Fleet]:
    make = _actor if client.actor else _process
    address = f"serve://{app}" if client.actor else url
    with contextlib.ExitStack() as stack:
        yield Fleet([stack.enter_context(make(client, address, *part)) for part in _parts(clients)])


@contextlib.contextmanager
def peer_fleet(
    client: others.PeerClient,
    plan: ThroughputPlan,
    obs: Path,
    running: dict[str, others.PeerServer],
) -> Iterator[Fleet]:
    """Start a peer's clients, and its server unless `running` has one that the peer shares, within
    a context.
    """
    most = max(plan.clients)
    policy = {name: float(plan.config.get(name, 0.0)) for name in ("base_ms", "per_item_ms")} | {
        "batch": plan.batch
    }
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(others.serving(client, plan.peers_python, running, policy))
        words = [
            *client.command(plan.peers_python),
            "load",
            *server.address,
            str(obs),
            client.mode,
            json.dumps(policy),
        ]
        children = [
            stack.enter_context(
                LineProcess(f"clients of {client.name}", [*words, *map(str, part)], others.alone())
            )
            for part in ([(1, most)] if client.one_process else _parts(most))
        ]
        for child in children:
            child.read(others.READY_S, server.process)
        server.signal(signal.SIGSTOP)
        yield Fleet([_part(child) for child in children], server.turn)


def _parts(clients: int) -> list[tuple[int, int]]:
    """Return the robots and simulations of each process."""
    return [(1, 0), *((0, size) for size in _shares(clients, min(_PROCESSES, clients)))]


def _part(child: LineProcess) -> _Part:
    return _Part(lambda spec: child.send(json.dumps(spec)), lambda _, late: child.read(late))


@contextlib.contextmanager
def _process(client: OwnClient, url: str, robots: int, simulations: int) -> Iterator[_Part]:
    settings = {"url": url, "transport": client.transport, "codec": client.codec}
    command = [sys.executable, "-m", "benchmarks.own_clients"]
    command.append(json.dumps(settings | {"robots": robots, "simulations": simulations}))
    with LineProcess(f"clients by {client.name}", command, our_environment()) as child:
        child.read(START_S)
        yield _part(child)


@contextlib.contextmanager
def _actor(client: OwnClient, url: str, robots: int, simulations: int) -> Iterator[_Part]:
    import ray

    actor = ray.remote(num_cpus=0)(LoadGenerator).remote(
        url, client.transport, client.codec, robots, simulations
    )
    try:
        ray.get(actor.ready.remote(), timeout=START_S)
        yield _Part(
            lambda spec: actor.run.remote(**spec),
            lambda pending, late: ray.get(pending, timeout=late),
        )
    finally:
        # If the client never connected, `ready` has raised the reason.
        with contextlib.suppress(ray.exceptions.RayError):
            ray.get(actor.close.remote(), timeout=START_S)
        ray.kill(actor)


@contextlib.contextmanager
def _bare(plan: ThroughputPlan) -> Iterator[LineProcess]:
    settings = json.dumps({"policy": plan.policy, "config": dict(plan.config), "batch": plan.batch})
    with LineProcess(
        "the bare policy", [sys.executable, "-m", _BARE, settings], our_environment()
    ) as child:
        child.read(10 * START_S)  # the child may load weights
        yield child


def _shares(clients: int, parts: int) -> list[int]:
    """Split clients as evenly as possible; the first parts may have one client more."""
    return [clients // parts + (i < clients % parts) for i in range(parts)]


def _one_each(found: Sequence[OwnClient]) -> list[OwnClient]:
    """Choose one client for each transport: preferably not an actor, and over networks the client
    with the default codec.
    """
    first: dict[str, OwnClient] = {}
    for one in found:
        kept = first.get(one.transport)
        if kept is None or (kept.actor and not one.actor) or one.codec == "auto":
            first[one.transport] = one
    return list(first.values())


def _row(plan: ThroughputPlan, turns: _Turns, best: float) -> dict[str, Any]:
    curve = [_point(plan, k, turns.calls[k]) for k in plan.clients]
    return {
        "actions_per_s": curve[-1]["actions_per_s"],
        "rounds": curve[-1]["rounds"],
        "of_ideal": curve[-1]["actions_per_s"] / best,
        "curve": curve,
        "robot": _waiting(turns.robot),
    }


def _point(
    plan: ThroughputPlan, clients: int, rounds: Sequence[Sequence[Sequence[Call]]]
) -> dict[str, Any]:
    rates = [rate_of(calls) for calls in rounds]
    rate = statistics.mean(rates)
    flat = [call for calls in rounds for one in calls for call in one]
    return {
        "clients": clients,
        "actions_per_s": rate,
        "rounds": rates,
        "ci95": mean_interval(rates),
        "of_ideal": rate / plan.ideal(clients) if plan.ideal else None,
        # A batch counts once for each of its members; the harmonic mean corrects this.
        "mean_batch": len(flat) / sum(1 / size for *_, size in flat) if flat else None,
        "p50_ms": float(np.median([call[1] for call in flat])) if flat else None,
        "p99_ms": float(np.quantile([call[1] for call in flat], 0.99)) if flat else None,
    }


def _waiting(calls: Sequence[Call]) -> dict[str, Any] | None:
    """Return the robot's round trips, and its waiting times without the inference; None if there
    was no call.
    """
    if not calls:
        return None
    round_trip = np.array([call[1] for call in calls])
    wait = round_trip - np.array([call[2] for call in calls])
    return {
        "calls": len(calls),
        "wait_p50_ms": float(np.median(wait)),
        "wait_ci95_ms": list(median_interval(wait)),
        "wait_p99_ms": float(np.quantile(wait, 0.99)),
        "round_trip_p50_ms": float(np.median(round_trip)),
        "round_trip_p99_ms": float(np.quantile(round_trip, 0.99)),
    }


def main(
    transports: Annotated[
        str, typer.Option(help="Transports, separated by commas.")
    ] = "plasma,handle,shm,websocket",
    clients: Annotated[
        str,
        typer.Option(
            help="Numbers of clients, separated by commas; the largest is compared with the ideal."
        ),
    ] = "1,2,4,8,16,32",
    batch: Annotated[
        int, typer.Option(min=1, help="Maximum number of observations in one forward pass.")
    ] = 16,
    seconds: Seconds = 2.0,
    rounds: Rounds = 3,
    robot_seconds: Annotated[
        float,
        typer.Option(
            min=0, help="Duration of the measurement of a robot, in seconds; 0: no measurement."
        ),
    ] = 10.0,
    policy: Annotated[
        str | None, typer.Option(help="Policy; default: noop, with 20 ms + 1 ms per observation.")
    ] = None,
    settings: Set = [],  # noqa: B006
    num_gpus: Annotated[
        float, typer.Option(min=0, help="Number of GPUs that Ray assigns to the replica.")
    ] = 0.0,
    peers: others.Peers = "",
    peers_python: others.PeersPython = others.PYTHON,
    out_file: Out = None,
) -> None:
    """Measure actions per second of many clients on one replica, compared with the ideal, or with
    the bare policy.
    """
    with errors():
        origin = measured_on("python -m benchmarks.throughput")
        if settings and policy is None:
            raise ConfigError("--set: is for --policy; name one")
        chosen: dict[str, Any] = (
            {}
            if policy is None
            else {"policy": policy, "config": parse_settings(settings, "--set")}
        )
        if peers and chosen.get("policy", "noop") != "noop":
            raise ConfigError(f"--peers: they sleep as the policy noop does; got --policy {policy}")
        counts = parse_counts(clients, "--clients")
        plan = ThroughputPlan(
            **chosen,
            num_gpus=num_gpus,
            batch=batch,
            clients=counts,
            seconds=seconds,
            rounds=rounds,
            robot_seconds=robot_seconds,
            transports=parse_list(transports),
            peers=parse_list(peers),
            peers_python=peers_python,
        )
        found = measure_throughput(plan, progress)
    show_throughput(found)
    save({**origin, **found, "versions": origin["versions"] | found["versions"]}, out_file)


def show_throughput(found: Mapping[str, Any]) -> None:
    """Print a row for each number of clients, and a sentence for each transport."""
    rows = table(
        "transport or peer",
        "clients",
        "actions/s",
        "95 % interval",
        "of ideal",
        "mean batch",
        "p50 ms",
        "p99 ms",
    )
    rows.title = (
        f"{found['policy']}, ideal {found['ideal_actions_per_s']:.0f} actions/s "
        f"({found['ideal_is']})"
    )
    for name, row in (found["transports"] | found["peers"]).items():
        for point in row["curve"]:
            numbers = [point[key] for key in ("of_ideal", "mean_batch", "p50_ms", "p99_ms")]
            cells = ["" if number is None else f"{number:.3g}" for number in numbers]
            interval = "{:.1f} to {:.1f}".format(*point["ci95"]) if point["ci95"] else ""
            rows.add_row(
                name, str(point["clients"]), f"{point['actions_per_s']:.1f}", interval, *cells
            )
        rows.add_section()
    out.print(rows)
    for name, row in (found["transports"] | found["peers"]).items():
        robot = row["robot"]
        waits = (
            (
                f"; a robot among simulations waits {robot['wait_p50_ms']:.1f} ms (p99 "
                f"{robot['wait_p99_ms']:.1f})"
            )
            if robot
            else ""
        )
        out.print(
            f"{name}: {row['actions_per_s']:.1f} actions/s, {row['of_ideal']:.3f} of the "
            f"ideal{waits}"
        )
    show_skipped(found)


if __name__ == "__main__":
    typer.run(main)
