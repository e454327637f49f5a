"""Runs a plan in the simulation, and compares what it predicted."""

from __future__ import annotations

import random
from dataclasses import dataclass

from vlagents_ray_fleet.plan import FleetPlan
from vlagents_ray_fleet.simulation import USUAL, Behaviour, Stream, Tally, World

_WARM_UP_S = 5.0  # time within which all robots start, s


@dataclass(frozen=True)
class GroupCheck:
    """The result of the simulation for the robots of one group and one model."""

    model: str
    group: str
    share: float  # share of ticks with an action in time
    predicted_share: float
    age_p95_ms: float
    predicted_age_p95_ms: float
    robots_in_time: int  # number of robots whose share is at least their target
    robots: int

    @property
    def points(self) -> float:
        """The error of the predicted share, in percentage points."""
        return 100 * abs(self.share - self.predicted_share)


@dataclass(frozen=True)
class Check:
    """The results of a simulation."""

    groups: tuple[GroupCheck, ...]
    simulated_s: float
    requests: int


def check(
    plan: FleetPlan,
    seconds: float = 60.0,
    seed: int = 0,
    behaviour: Behaviour = USUAL,
) -> Check:
    """Simulate the plan until `seconds` after all robots have started."""
    draw = random.Random(seed)
    groups = []
    requests = 0
    for demand, model in zip(plan.demands, plan.models, strict=True):
        world = World(draw.randrange(2**32), behaviour, demand.transport_s)
        costs = demand.costs_on(model.gpu_fraction)
        for _ in range(model.replicas):
            world.add_replica(demand.model, costs, model.batch_size)
        tallies = [Tally() for _ in demand.uses]
        streams: list[list[Stream]] = []
        for use, tally in zip(demand.uses, tallies, strict=True):
            of_use = []
            for _ in range(use.count):
                begins_s = draw.uniform(0, _WARM_UP_S)
                of_use.append(
                    world.add_stream(demand.model, use.need, use.transport_s, begins_s, tally)
                )
            streams.append(of_use)
        world.run(_WARM_UP_S + seconds)
        world.finish()

        requests += sum(replica.requests for replica in world.replicas[demand.model])
        for use, tally, group_streams, predicted in zip(
            demand.uses, tallies, streams, model.groups, strict=True
        ):
            in_time = sum(
                stream.ticks > 0 and 1 - stream.starved / stream.ticks >= use.share
                for stream in group_streams
            )
            groups.append(
                GroupCheck(
                    model=demand.model,
                    group=use.group,
                    share=tally.share,
                    predicted_share=predicted.share,
                    age_p95_ms=tally.age_s(0.95) * 1e3,
                    predicted_age_p95_ms=predicted.age_p95_ms,
                    robots_in_time=in_time,
                    robots=use.count,
                )
            )
    return Check(tuple(groups), seconds, requests)
