"""Ten thousand robots on 400 replicas and 50 nodes, in virtual time: what they get through a
morning, losses and a rolling update, and which limit is reached first.

`python -m benchmarks.fleet_simulation` prints it; `--json FILE` also writes it. It needs no GPU,
and takes minutes of one core. The simulation is that of `vlagents-ray plan --check`; each printed
limit names the measurement or the setting that it was computed from.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.serve.fleet import CostCurve, RobotNeed, replica_load
from vlagents_ray_fleet.simulation import Behaviour, Replica, Tally, World

MODEL = "pi0"
COSTS = CostCurve(0.0293, 0.00806)  # pi0 compiled, on an H200 (docs/measured.md)
LARGEST_BATCH = 16
TRANSPORT_S = 0.005
START_S = 50.0  # of a replica whose compiled programs are kept (docs/measured.md)
MORNING_S = 60.0  # within which all robots start
UPDATED_AT_ONCE = 0.2  # share of the replicas: Ray Serve's rolling_update_percentage
DRAIN_S = 5.0  # within which the sessions of a leaving replica have moved
RACKS = 5  # with equal numbers of nodes
IN_TIME = 0.98
NODE_LOST_S, RACK_LOST_S, REPAIRED_S, UPDATE_S = 90.0, 120.0, 150.0, 175.0

# Measured inputs of the limits, with their sources.
SERVER_MS_AN_ACT = 1.226  # WebSocket with JPEG, CPU of the replica (docs/measured.md)
PROXY_MS_A_REQUEST = 0.235  # HAProxy's CPU of a request by HTTP (docs/measured.md)
# CPU of Ray Serve's controller, and of one replica without sessions, in cores, by the number of
# replicas: 30 s each on two cores of an Intel Xeon, Ray 2.60.0, without autoscaling.
CONTROLLER_CORES = {2: 0.0420, 12: 0.0450}
REPLICA_CORES = {2: 0.0180, 12: 0.0220}
PROXY_CONNECTIONS = 16_384  # vlagents_ray.serve.launch.haproxy
CONNECTIONS_OF_AN_ADDRESS = 1_000  # the same
COMPARE_S = 3.0  # vlagents_ray.serve.scaling.rebalancer.PERIOD_S


@dataclass(frozen=True)
class Event:
    """What happened, and what the robots got from then until the next event."""

    name: str
    begun_s: float
    share: float  # of ticks in time, until the next event
    worst_share: float  # of the worst second
    recovered_s: float  # until at least 98 % of ticks are in time in each later second


@dataclass(frozen=True)
class Limit:
    """One part of the system, and how many robots it carries."""

    part: str
    used: str
    limit_robots: float
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
        """What each robot needs."""
        return RobotNeed(self.hz, self.rows)

    @property
    def robots_of_a_replica(self) -> int:
        """The mean number of robots of a replica, rounded up."""
        return -(-self.robots // self.replicas)


def run(shape: Shape, seed: int, least_loaded: bool, until_s: float) -> tuple[Tally, World]:
    """Simulate the fleet through all events before `until_s`."""
    draw = random.Random(seed)
    behaviour = Behaviour()
    world = World(seed, behaviour, TRANSPORT_S, least_loaded)
    for index in range(shape.replicas):
        world.add_replica(MODEL, COSTS, LARGEST_BATCH, node=index % shape.nodes)
    tally = Tally()
    for _ in range(shape.robots):
        world.add_stream(MODEL, shape.need, TRANSPORT_S, draw.uniform(0, MORNING_S), tally)

    world.at(0.0, world.compare, MODEL, 0)
    world.at(NODE_LOST_S, partial(_lose, world), range(1), 0)
    rack = range(1, 1 + shape.nodes // RACKS)
    world.at(RACK_LOST_S, partial(_lose, world), rack, 0)
    world.at(REPAIRED_S, partial(_repair, world), range(1 + shape.nodes // RACKS), 0)
    world.at(UPDATE_S, partial(_update, world, set()), shape, 0)
    world.run(until_s)
    world.finish()
    return tally, world


def _repair(world: World, nodes: Sequence[int], _: int) -> None:
    """Start the replicas of machines again."""
    for replica in list(world.replicas[MODEL]):
        if replica.node in nodes:
            world.add_replica(MODEL, COSTS, LARGEST_BATCH, replica.node)


def _lose(world: World, nodes: Sequence[int], _: int) -> None:
    """Lose machines: nothing ends the connections to their replicas."""
    for replica in world.replicas[MODEL]:
        if replica.node in nodes and replica.alive:
            replica.fail(world.behaviour.silent_s)


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


def events(tally: Tally, until_s: float) -> list[Event]:
    """Return what the robots got through each event."""
    in_time, starved = tally.by_second()
    begins = {
        "all robots start within a minute": 0.0,
        "all act": MORNING_S,
        "a node is lost": NODE_LOST_S,
        "a rack is lost": RACK_LOST_S,
        "the nodes are back": REPAIRED_S,
        "a rolling update": UPDATE_S,
    }
    ends = [*list(begins.values())[1:], until_s - 1]
    met = []
    for (name, begin), next_begin in zip(begins.items(), ends, strict=True):
        end = min(next_begin, until_s - 1)  # the last second may lack some ticks
        if end <= begin:
            continue
        seconds = slice(int(begin), int(end))
        ticks = np.maximum(in_time[seconds] + starved[seconds], 1)
        shares = in_time[seconds] / ticks
        shares[in_time[seconds] + starved[seconds] == 0] = 1.0
        late = np.flatnonzero(shares < IN_TIME)
        met.append(
            Event(
                name=name,
                begun_s=begin,
                share=float(in_time[seconds].sum() / ticks.sum()),
                worst_share=float(shares.min()),
                recovered_s=float(late[-1] + 1) if len(late) else 0.0,
            )
        )
    return met


def limits(shape: Shape, requests_hz: float) -> list[Limit]:
    """Return the limits by the number of robots at which they are reached, the first one first.

    Args:
        shape: The fleet.
        requests_hz: Requests a second of one robot.
    """
    of_node = shape.replicas / shape.nodes
    comparisons = shape.replicas * (shape.replicas - 1) / COMPARE_S
    of_sibling = _slope(REPLICA_CORES)
    cores = of_sibling * (shape.replicas - 1)
    controller_cores = CONTROLLER_CORES[2] + _slope(CONTROLLER_CORES) * (shape.replicas - 2)
    controlled = 2 + (1 - CONTROLLER_CORES[2]) / _slope(CONTROLLER_CORES)
    a_core = 1000 / SERVER_MS_AN_ACT
    reached = [
        Limit(
            "comparisons of sessions between replicas",
            f"{comparisons:,.0f} calls a second, {cores:.2f} of a core in each replica",
            shape.robots_of_a_replica / of_sibling,
            "each replica asks each other one every 3 s; CPU of an idle replica among 2 and 12",
        ),
        Limit(
            "thread of one replica, requests at each tick",
            f"{shape.robots_of_a_replica * shape.hz:.0f} requests a second of {a_core:.0f}",
            shape.robots * a_core / (shape.robots_of_a_replica * shape.hz),
            "CPU of an act by WebSocket with JPEG (docs/measured.md)",
        ),
        Limit(
            "thread of one replica, requests as the server states",
            f"{shape.robots_of_a_replica * requests_hz:.0f} requests a second of {a_core:.0f}",
            shape.robots * a_core / (shape.robots_of_a_replica * requests_hz),
            "the same",
        ),
        Limit(
            "connections of one proxy, all robots at one address of the server",
            f"{shape.robots} of {PROXY_CONNECTIONS}",
            PROXY_CONNECTIONS,
            "HAProxy's maxconn, which serve sets; robots at a replica's own port use none",
        ),
        Limit(
            "connections from one address, such as a site behind NAT",
            f"{shape.robots} of {CONNECTIONS_OF_AN_ADDRESS}",
            CONNECTIONS_OF_AN_ADDRESS,
            "the limit by address, which serve sets",
        ),
        Limit(
            "CPU of one proxy, requests by HTTP at each tick",
            f"{shape.robots * shape.hz * PROXY_MS_A_REQUEST / 1e3 / shape.nodes:.2f} of 2 cores",
            shape.nodes * 2 * 1e3 / PROXY_MS_A_REQUEST / shape.hz,
            "HAProxy's CPU of an act by HTTP (docs/measured.md), spread over the nodes",
        ),
        Limit(
            "controller of Ray Serve",
            f"{controller_cores:.2f} of a core",
            controlled * shape.robots_of_a_replica,
            f"its CPU with 2 and 12 replicas, {of_node:.0f} of which are on a node here",
        ),
    ]
    return sorted(reached, key=lambda limit: limit.limit_robots)


def _slope(values: dict[int, float]) -> float:
    """Return the growth of a value from the first to the last number of replicas, for each."""
    first, last = min(values), max(values)
    return (values[last] - values[first]) / (last - first)


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate, and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", type=int, default=Shape.robots)
    parser.add_argument("--replicas", type=int, default=Shape.replicas)
    parser.add_argument("--nodes", type=int, default=Shape.nodes)
    parser.add_argument("--rows", type=int, default=Shape.rows)
    parser.add_argument("--hz", type=float, default=Shape.hz)
    parser.add_argument("--seconds", type=float, default=450.0, help="of virtual time")
    parser.add_argument("--hashed", action="store_true", help="place sessions by a hash")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    shape = Shape(options.robots, options.replicas, options.nodes, options.hz, options.rows)

    began = time.process_time()
    tally, world = run(shape, options.seed, not options.hashed, options.seconds)
    requests = sum(replica.requests for replica in world.replicas[MODEL])
    busy_s = sum(replica.busy_s for replica in world.replicas[MODEL])
    requests_hz = requests / shape.robots / options.seconds
    load = replica_load(COSTS, {shape.need: shape.robots_of_a_replica}, LARGEST_BATCH, TRANSPORT_S)
    document: dict[str, Any] = {
        "shape": asdict(shape),
        "placement": "by hash" if options.hashed else "fewest sessions",
        "seconds": options.seconds,
        "load": load.load,
        "share": tally.share,
        "age_p50_ms": tally.age_s(0.5) * 1e3,
        "age_p95_ms": tally.age_s(0.95) * 1e3,
        "requests": requests,
        "requests_hz": requests_hz,
        "busy": busy_s / shape.replicas / options.seconds,
        "moves": world.moves,
        "cpu_s": time.process_time() - began,
        "events": [asdict(event) for event in events(tally, options.seconds)],
        "limits": [asdict(limit) for limit in limits(shape, requests_hz)],
    }
    show(document, print)
    if options.json is not None:
        options.json.write_text(json.dumps(document, indent=1) + "\n")


def show(document: dict[str, Any], write: Callable[[str], None]) -> None:
    """Write the results as Markdown."""
    shape = document["shape"]
    write(
        f"{shape['robots']:,} robots at {shape['hz']:g} Hz, chunks of {shape['rows']} rows, on "
        f"{shape['replicas']} replicas and {shape['nodes']} nodes, sessions at the replica "
        f"{'by hash' if document['placement'] == 'by hash' else 'with the fewest'}; load "
        f"{document['load']:.2f}. {document['seconds']:g} s, {document['requests']:,} requests, "
        f"{document['cpu_s']:.0f} s of CPU. Ticks in time {document['share']:.4f}, age p50 "
        f"{document['age_p50_ms']:.0f} ms, p95 {document['age_p95_ms']:.0f} ms, "
        f"{document['moves']:,} moves of sessions.\n"
    )
    write("| event | ticks in time | worst second | s until 98 % of all ticks are in time |")
    write("| --- | --- | --- | --- |")
    for event in document["events"]:
        write(
            f"| {event['name']} | {event['share']:.4f} | {event['worst_share']:.4f} | "
            f"{event['recovered_s']:.0f} |"
        )
    write("\n| part | use by this fleet | reached at robots | from |")
    write("| --- | --- | --- | --- |")
    for limit in document["limits"]:
        write(
            f"| {limit['part']} | {limit['used']} | {limit['limit_robots']:,.0f} | "
            f"{limit['source']} |"
        )
    write(
        "\nAssumed: lost replicas are not replaced until their nodes are back; a robot notices a "
        f"lost machine after {Behaviour.silent_s:g} s and an ended connection after "
        f"{Behaviour.broken_s:g} s; a session that moves costs {Behaviour.move_s * 1e3:g} ms; "
        f"Ray Serve replaces {UPDATED_AT_ONCE:.0%} of the replicas at once, which start in "
        f"{START_S:g} s."
    )


if __name__ == "__main__":
    main()
