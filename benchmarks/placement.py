"""Simulates robots of two kinds on several replicas in virtual time.

Their sessions are placed and moved according to the needs of the robots, or according to the number
of sessions. Robots with long chunks need a tenth of the capacity of robots with short chunks. If
robots come in random order, replicas with equal numbers of sessions have unequal loads.
"""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import typer

from benchmarks.console import Out, save
from vlagents_ray.cli.console import errors, out, table
from vlagents_ray.serve.fleet import CostCurve, RobotNeed
from vlagents_ray_fleet.simulation import Behaviour, Tally, World, starved_streams

MODEL = "pi0"
PI0 = CostCurve(0.0293, 0.00806)  # costs of pi0 on an H200, compiled, s
LARGEST_BATCH = 16
TRANSPORT_S = 0.005
LONG, SHORT = RobotNeed(hz=10.0, rows=50), RobotNeed(hz=10.0, rows=8)
IN_TIME = 0.98


@dataclass(frozen=True, slots=True)
class PlacementPlan:
    """The robots and the replicas."""

    replicas: int = 8
    robots: int = 36  # number of robots of each kind per replica, which is a load of 0.86
    begin_within_s: float = 60.0
    seconds: float = 120.0


@dataclass(frozen=True, slots=True)
class Placement:
    """The results of the robots."""

    share: float  # share of the robots' ticks in time
    robots_in_time: int  # number of robots with at least 98 % of their ticks in time
    robots: int
    largest_load: float  # largest load of a replica at the end, as a multiple of the mean load
    moves: int


def place(plan: PlacementPlan, seed: int, *, weighs_robots: bool) -> Placement:
    """Simulate the fleet.

    Args:
        plan: The robots and the replicas.
        seed: The seed of all random numbers.
        weighs_robots: Whether replicas compare the needs of their robots; otherwise they compare
            their numbers of sessions.
    """
    draw = random.Random(seed)
    world = World(seed, Behaviour(weighs_robots=weighs_robots), TRANSPORT_S)
    for _ in range(plan.replicas):
        world.add_replica(MODEL, PI0, LARGEST_BATCH)

    tally = Tally()
    needs = [LONG, SHORT] * (plan.replicas * plan.robots)
    draw.shuffle(needs)
    for need in needs:
        world.add_stream(MODEL, need, TRANSPORT_S, draw.uniform(0, plan.begin_within_s), tally)
    world.at(0.0, world.compare, MODEL, 0)
    world.run(plan.seconds)
    world.finish()

    loads = [replica.needed_load() for replica in world.replicas[MODEL]]
    return Placement(
        share=tally.share,
        robots_in_time=len(needs) - len(starved_streams(world.streams, IN_TIME)),
        robots=len(needs),
        largest_load=max(loads) * len(loads) / sum(loads),
        moves=world.moves,
    )


def mean_placement(placements: Sequence[Placement]) -> dict[str, float]:
    """Return the means of several runs."""
    runs = len(placements)
    return {
        "share": sum(run.share for run in placements) / runs,
        "robots_in_time": sum(run.robots_in_time for run in placements) / runs,
        "robots": placements[0].robots,
        "largest_load": sum(run.largest_load for run in placements) / runs,
        "moves": sum(run.moves for run in placements) / runs,
    }


def main(
    replicas: Annotated[int, typer.Option(min=2)] = 8,
    robots: Annotated[
        int, typer.Option(min=1, help="Number of robots of each kind for each replica.")
    ] = 36,
    seeds: Annotated[int, typer.Option(min=1)] = 3,
    out_file: Out = None,
) -> None:
    """Print the results if sessions are placed according to the robots' needs, and according to the
    number of sessions.
    """
    with errors():
        plan = PlacementPlan(replicas, robots)
        rows = table("placed by", "ticks in time", "robots with 98 %", "largest load", "moves")
        results = {}
        for name, weighs_robots in (("number of sessions", False), ("needs of robots", True)):
            runs = [place(plan, seed, weighs_robots=weighs_robots) for seed in range(seeds)]
            mean = results[name] = mean_placement(runs)
            rows.add_row(
                name,
                f"{mean['share']:.4f}",
                f"{mean['robots_in_time']:.0f} of {mean['robots']}",
                f"{mean['largest_load']:.2f}",
                f"{mean['moves']:.0f}",
            )
        out.print(rows)
        save(results, out_file)


if __name__ == "__main__":
    typer.run(main)
