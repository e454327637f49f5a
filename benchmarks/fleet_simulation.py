"""Simulates ten thousand robots on 400 replicas and 50 nodes in virtual time: their ticks in time
during a morning, losses and a rolling update, and which limit is reached first.

`python -m benchmarks.fleet_simulation` prints it; `--json FILE` also writes it. It needs no GPU,
and some minutes of one core for each scenario. The simulation is that of `vlagents-ray plan
--check`; each printed limit names the measurement or the setting that it was computed from.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import random
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.serve.fleet import CostCurve, RobotNeed, replica_load
from vlagents_ray_fleet.simulation import (
    Behaviour,
    Replica,
    Tally,
    World,
    starved_streams,
)

MODEL = "pi0"
COSTS = CostCurve(0.0293, 0.00806)  # pi0 compiled, on an H200 (docs/measured_gpu.md)
LARGEST_BATCH = 16
TRANSPORT_S = 0.005
# Start of a replica, s. With kept compiled programs it takes 50 s on an H200
# (docs/measured_gpu.md), but nothing else happens in that time.
START_S = 20.0
MORNING_S = 60.0  # time within which all robots start, s
STEADY_S = 15.0  # time of the event, s; all robots have started within 5 s
REPAIR_S = 30.0  # time after which lost machines are back, s
# Share of the replicas that are replaced at once, Ray Serve's rolling_update_percentage.
UPDATED_AT_ONCE = 0.2
DRAIN_S = 5.0  # time within which the sessions of a leaving replica have moved, s
RACKS = 5  # number of racks, with equal numbers of nodes
IN_TIME = 0.98

# Measured inputs of the limits, with their sources
SERVER_MS_AN_ACT = 1.226
PROXY_MS_A_REQUEST = 0.235  # HAProxy's CPU for a request over HTTP (docs/measured_tables.md)
# CPU of Ray Serve's controller, and of one replica without sessions, in cores, by the number of
# replicas: 30 s each on two cores of an Intel Xeon, Ray 2.60.0, without autoscaling.
CONTROLLER_CORES = {2: 0.0420, 12: 0.0450}
REPLICA_CORES = {2: 0.0180, 12: 0.0220}
PROXY_CONNECTIONS = 16_384  # set in vlagents_ray.serve.launch.haproxy
CONNECTIONS_OF_AN_ADDRESS = 1_000  # set in the same module
COMPARE_S = 3.0  # the value of vlagents_ray.serve.scaling.rebalancer.PERIOD_S
MOST_ASKED = 32  # as in vlagents_ray.serve.scaling.sibling_replicas
# Measured by `python -m benchmarks.fleet_costs`.
DECISION_MS = {400: 7.4}  # one decision of autoscaling, by the number of replicas
DECISIONS_HZ = 10.0
OPENING_MS = 0.12  # HAProxy's CPU to open a WebSocket
CHECKED_REPLICAS = 400
CHECKING_CORES = 0.076  # HAProxy's CPU for the health checks, by the number of replicas


@dataclass(frozen=True)
class Outcome:
    """The service of the robots since the event of a scenario."""

    scenario: str
    share: float  # share of ticks in time
    worst_share: float  # share of ticks in time in the worst second
    # Time after the event until, in each second, at least 98 % of ticks are in time, s.
    in_time_s: float
    all_in_time_s: float  # time until at least 98 % of the later ticks of each robot are in time, s
    late_robots: int  # number of robots with less than 98 % of all their ticks in time
    moves: int  # number of moved sessions
    most_sessions: int  # largest number of sessions of a replica at the end
    requests: int
    cpu_s: float


@dataclass(frozen=True)
class Limit:
    """One part of the system, and the number of robots that it can serve."""

    part: str
    used: str
    limit_robots: float | None  # number of robots; None if the use does not grow with the fleet
    source: str


@dataclass(frozen=True)
class Shape:
    """The size of the fleet."""

    robots: int = 10_000
    replicas: int = 400
    nodes: int = 50
    hz: float = 10.0
    rows: int = 8

    @property
    def need(self) -> RobotNeed:
        """The need of each robot."""
        return RobotNeed(self.hz, self.rows)

    @property
    def robots_of_a_replica(self) -> int:
        """The mean number of robots of a replica, rounded up."""
        return -(-self.robots // self.replicas)


@dataclass(frozen=True)
class Scenario:
    """A fleet, and an event that happens to it."""

    name: str
    until_s: float
    happens: Callable[[World, Shape], None] | None = None
    begun_s: float = STEADY_S  # time of the event, s
    begin_within_s: float = 5.0  # time within which all robots start, s
    # Whether sessions are placed at the least loaded replica; otherwise by a hash.
    least_loaded: bool = True
    replicas: float = 1.0  # share of the replicas that run at the beginning


def run(scenario: Scenario, shape: Shape, seed: int = 0) -> tuple[Tally, World]:
    """Simulate the fleet through a scenario."""
    draw = random.Random(seed)
    behaviour = Behaviour(act_cpu_s=SERVER_MS_AN_ACT / 1e3)
    world = World(seed, behaviour, TRANSPORT_S, scenario.least_loaded)
    for index in range(round(scenario.replicas * shape.replicas)):
        world.add_replica(MODEL, COSTS, LARGEST_BATCH, node=index % shape.nodes)
    tally = Tally()
    for _ in range(shape.robots):
        start_s = draw.uniform(0, scenario.begin_within_s)
        world.add_stream(MODEL, shape.need, TRANSPORT_S, start_s, tally)

    world.at(0.0, world.compare, MODEL, 0)
    if scenario.happens is not None:
        world.at(scenario.begun_s, partial(scenario.happens, world), shape, 0)
    # Garbage collection is off: there are no cycles, and a collection takes longer with more
    # robots.
    gc.disable()
    try:
        world.run(scenario.until_s)
    finally:
        gc.enable()
    world.finish()
    return tally, world


def _lose_node(world: World, _: Shape, __: int = 0) -> None:
    _lose(world, range(1))


def _lose_rack(world: World, shape: Shape, _: int = 0) -> None:
    """Lose the machines of a rack, which return after 30 s."""
    rack = range(shape.nodes // RACKS)
    _lose(world, rack)
    world.at(world.now + REPAIR_S, partial(_repair, world), rack, 0)


def _lose(world: World, nodes: Sequence[int]) -> None:
    """Lose machines; the connections to their replicas are not closed."""
    for replica in world.replicas[MODEL]:
        if replica.node in nodes and replica.alive:
            replica.fail(world.behaviour.silent_s)


def _repair(world: World, nodes: Sequence[int], _: int) -> None:
    """Start the replicas of machines again."""
    for replica in list(world.replicas[MODEL]):
        if replica.node in nodes and not replica.alive:
            world.add_replica(MODEL, COSTS, LARGEST_BATCH, replica.node)


def _add_replicas(world: World, shape: Shape, _: int = 0) -> None:
    """Start the replicas that did not run at first."""
    for index in range(len(world.replicas[MODEL]), shape.replicas):
        world.add_replica(MODEL, COSTS, LARGEST_BATCH, index % shape.nodes)


def _update_all(world: World, shape: Shape, _: int = 0) -> None:
    _update(world, set(), shape, 0)


def _update(world: World, updated: set[int], shape: Shape, _: int) -> None:
    """Begin to replace the next replicas, as many as Ray Serve replaces at once."""
    old = [
        replica
        for replica in world.replicas[MODEL]
        if replica.accepts and id(replica) not in updated
    ]
    if not old:
        return
    leaving = old[: max(1, int(UPDATED_AT_ONCE * shape.replicas))]
    for replica in leaving:
        replica.accepts = False
    world.at(world.now + DRAIN_S, partial(_replace, world, updated, shape), leaving, 0)


def _replace(
    world: World, updated: set[int], shape: Shape, leaving: Sequence[Replica], _: int
) -> None:
    """Stop the replicas that have handed over their sessions, and start others in their place."""
    for replica in leaving:
        replica.fail(world.behaviour.broken_s)

    def start(nodes: Sequence[int], _: int) -> None:
        for node in nodes:
            updated.add(id(world.add_replica(MODEL, COSTS, LARGEST_BATCH, node)))

    world.at(world.now + START_S, start, [replica.node for replica in leaving], 0)
    world.at(world.now + START_S + 0.001, partial(_update, world, updated), shape, 0)


SCENARIOS: Mapping[str, Scenario] = {
    "morning": Scenario(
        "all robots start within a minute",
        MORNING_S + STEADY_S,
        begun_s=0.0,
        begin_within_s=MORNING_S,
    ),
    "hash": Scenario(
        "the same, sessions placed by a hash",
        MORNING_S + STEADY_S,
        begun_s=0.0,
        begin_within_s=MORNING_S,
        least_loaded=False,
    ),
    "rush": Scenario("all robots start within 5 s", 45.0, begun_s=0.0),
    "growth": Scenario(
        "a quarter more replicas start, and sessions move", 45.0, _add_replicas, replicas=0.8
    ),
    "node": Scenario("a node is lost", 45.0, _lose_node),
    "rack": Scenario("a rack is lost, and is back after 30 s", 75.0, _lose_rack),
    "update": Scenario(
        "a rolling update, a fifth of the replicas at once", 130.0 + STEADY_S, _update_all
    ),
}


def outcome(scenario: Scenario, tally: Tally, world: World, cpu_s: float) -> Outcome:
    """Return the service of the robots since the event."""
    in_time, starved = tally.by_second()
    # The last second may be incomplete.
    seconds = slice(int(scenario.begun_s), int(scenario.until_s) - 1)
    ticks = in_time[seconds] + starved[seconds]
    shares = np.where(ticks > 0, in_time[seconds] / np.maximum(ticks, 1), 1.0)
    late = np.flatnonzero(shares < IN_TIME)
    all_in_time_s = max(stream.in_time_from_s(IN_TIME) for stream in world.streams)
    replicas = world.replicas[MODEL]
    return Outcome(
        scenario=scenario.name,
        share=float(in_time[seconds].sum() / max(1, ticks.sum())),
        worst_share=float(shares.min()),
        in_time_s=float(late[-1] + 1) if len(late) else 0.0,
        all_in_time_s=max(0.0, all_in_time_s - scenario.begun_s),
        late_robots=len(starved_streams(world.streams, IN_TIME)),
        moves=world.moves,
        most_sessions=max(replica.sessions for replica in replicas),
        requests=sum(replica.requests for replica in replicas),
        cpu_s=cpu_s,
    )


def limits(shape: Shape, requests_hz: float) -> list[Limit]:
    """Return the limits in the order of the number of robots at which they are reached, the
    smallest number first.

    Args:
        shape: The fleet.
        requests_hz: Requests per second of one robot.
    """
    a_core = 1000 / SERVER_MS_AN_ACT
    mean_robots = shape.robots_of_a_replica
    # A replica asks others for their numbers of sessions at each comparison, and for each client
    # that begins there.
    asked = min(MOST_ASKED, shape.replicas - 1)
    asks_hz = 1 / COMPARE_S + mean_robots / MORNING_S
    asking_cores = asks_hz * asked * _slope(REPLICA_CORES) * COMPARE_S
    controller_cores = _controller_cores(shape.replicas)
    checks_cores = CHECKING_CORES * shape.replicas / CHECKED_REPLICAS
    reached = [
        Limit(
            "the thread of one replica, requests at each tick",
            f"{mean_robots * shape.hz:.0f} requests a second of {a_core:.0f}",
            shape.robots * a_core / (mean_robots * shape.hz),
            "CPU of an act by WebSocket with JPEG (docs/measured_tables.md); robots per replica "
            "grow",
        ),
        Limit(
            "the thread of one replica, requests as the server states",
            f"{mean_robots * requests_hz:.0f} requests a second of {a_core:.0f}",
            shape.robots * a_core / (mean_robots * requests_hz),
            "the same",
        ),
        Limit(
            "connections of one proxy, all robots at one address of the server",
            f"{shape.robots:,} of {PROXY_CONNECTIONS:,}; on a morning "
            f"{shape.robots / MORNING_S * OPENING_MS / 1e3:.2f} of 2 cores open them",
            PROXY_CONNECTIONS,
            "HAProxy's maxconn, which serve sets; robots at a replica's own port use none",
        ),
        Limit(
            "connections to a proxy from one address, such as a site behind NAT",
            f"{shape.robots:,} of {CONNECTIONS_OF_AN_ADDRESS:,}",
            CONNECTIONS_OF_AN_ADDRESS,
            "the limit by address, which serve sets; robots at a replica's own port use none",
        ),
        Limit(
            "CPU of one proxy, requests by HTTP at each tick",
            f"{shape.robots * shape.hz * PROXY_MS_A_REQUEST / 1e3 / shape.nodes:.2f} of 2 cores",
            shape.nodes * 2 * 1e3 / PROXY_MS_A_REQUEST / shape.hz,
            "HAProxy's CPU of an act by HTTP (docs/measured_tables.md), spread over the nodes",
        ),
        Limit(
            "CPU of one proxy, health checks of all replicas",
            f"{checks_cores:.2f} of 2 cores",
            shape.robots * 2 / checks_cores,
            "fleet_costs; each proxy checks each replica twice a second",
        ),
        Limit(
            "Ray Serve's controller, with autoscaling",
            f"{controller_cores:.2f} of a core",
            mean_robots * _controlled_replicas(),
            "its CPU with 2 and 12 idle replicas, and ten decisions of autoscaling a second "
            "(fleet_costs)",
        ),
        Limit(
            "replicas that ask others for their sessions, on a morning",
            f"{asked} others, {asks_hz * shape.replicas * asked:,.0f} calls a second, "
            f"{asking_cores:.2f} of a core in each replica",
            None,
            "CPU of an idle replica among 2 and 12, for each replica that it asks",
        ),
    ]
    return sorted(reached, key=lambda limit: limit.limit_robots or math.inf)


def _controller_cores(replicas: int) -> float:
    """Return the CPU time of Serve's controller with autoscaling, in cores."""
    idle = CONTROLLER_CORES[2] + _slope(CONTROLLER_CORES) * (replicas - 2)
    return idle + DECISIONS_HZ * (DECISION_MS[400] / 400) * replicas / 1e3


def _controlled_replicas() -> int:
    """Return the number of replicas at which Serve's controller uses a core."""
    replicas = 2
    while _controller_cores(replicas + 1) < 1:
        replicas += 1
    return replicas


def _slope(values: dict[int, float]) -> float:
    """Return the growth of a value per replica, from the first to the last number of replicas."""
    first, last = min(values), max(values)
    return (values[last] - values[first]) / (last - first)


def _write(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=Shape.robots)
    parser.add_argument("--replicas", type=int, default=Shape.replicas)
    parser.add_argument("--nodes", type=int, default=Shape.nodes)
    parser.add_argument("--rows", type=int, default=Shape.rows)
    parser.add_argument("--hz", type=float, default=Shape.hz)
    parser.add_argument("--scenario", choices=SCENARIOS, action="append", help="default: all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    shape = Shape(options.robots, options.replicas, options.nodes, options.hz, options.rows)

    load = replica_load(COSTS, {shape.need: shape.robots_of_a_replica}, LARGEST_BATCH, TRANSPORT_S)
    _write(
        f"{shape.robots:,} robots at {shape.hz:g} Hz, chunks of {shape.rows} rows, on "
        f"{shape.replicas} replicas and {shape.nodes} nodes; load {load.load:.2f}.\n"
    )
    _write(
        "| event | ticks in time | worst second | s until 98 % of all ticks are | s until 98 % of "
        "each robot's are | robots below 98 % | moves | most sessions | requests | CPU s |"
    )
    _write("|" + " --- |" * 10)

    outcomes = []
    requests_hz = 0.0
    for name in options.scenario or SCENARIOS:
        scenario = SCENARIOS[name]
        began = time.process_time()
        tally, world = run(scenario, shape, options.seed)
        result = outcome(scenario, tally, world, time.process_time() - began)
        outcomes.append(result)
        requests_hz = max(requests_hz, result.requests / shape.robots / scenario.until_s)
        _write(
            f"| {result.scenario} | {result.share:.4f} | {result.worst_share:.4f} | "
            f"{result.in_time_s:.0f} | {result.all_in_time_s:.1f} | {result.late_robots} | "
            f"{result.moves:,} | {result.most_sessions} | {result.requests:,} | "
            f"{result.cpu_s:.0f} |",
        )

    found = limits(shape, requests_hz)
    _write("\n| part | use by this fleet | reached at robots | from |")
    _write("| --- | --- | --- | --- |")
    for limit in found:
        reached = "none" if limit.limit_robots is None else f"{limit.limit_robots:,.0f}"
        _write(f"| {limit.part} | {limit.used} | {reached} | {limit.source} |")
    _write(
        "\nAssumed: lost replicas are not replaced until their nodes are back; a robot notices a "
        f"lost machine after {Behaviour.silent_s:g} s and an ended connection after "
        f"{Behaviour.broken_s:g} s; a session that moves costs {Behaviour.move_s * 1e3:g} ms; "
        f"Ray Serve replaces {UPDATED_AT_ONCE:.0%} of the replicas at once, which start in "
        f"{START_S:g} s."
    )
    if options.json is not None:
        document: dict[str, Any] = {
            "shape": asdict(shape),
            "load": load.load,
            "outcomes": [asdict(result) for result in outcomes],
            "limits": [asdict(limit) for limit in found],
        }
        options.json.write_text(json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
