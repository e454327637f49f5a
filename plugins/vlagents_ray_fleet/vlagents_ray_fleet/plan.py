"""The plan of a fleet: replicas, batch sizes and shares of GPUs with which its robots are in time.

The arithmetic of a replica is in `vlagents_ray.serve.fleet`, which the server also uses. A replica
with a share of a GPU is assumed to have that share of the speed of a whole GPU. Kernels of several
processes alternate, so this is right while all processes have work.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.fleet import USABLE, CostCurve, ReplicaLoad, RobotNeed, replica_load
from vlagents_ray_fleet.fleet_file import FleetFile, GpuPool
from vlagents_ray_fleet.packing import (
    Choice,
    Layout,
    Packing,
    Piece,
    fewest_gpus,
    layouts,
    least_load,
)

_MOST_CHOICES = 24  # maximum number of replica counts that are compared for one share of a GPU


@dataclass(frozen=True)
class Use:
    """The robots of one group that use one model."""

    group: str
    need: RobotNeed
    count: int
    share: float  # share of ticks that must have an action in time
    transport_s: float


@dataclass(frozen=True)
class Demand:
    """A model, and all robots that use it."""

    model: str
    costs: CostCurve  # durations on a whole GPU
    memory_gb: float
    max_batch_size: int
    gpu_fraction: float | None  # share of a GPU; None if the plan chooses it
    max_load: float  # maximum load of a replica
    uses: tuple[Use, ...]

    @property
    def robots(self) -> int:
        """The number of robots."""
        return sum(use.count for use in self.uses)

    @property
    def transport_s(self) -> float:
        """The longest transport time of the model's robots, s."""
        return max(use.transport_s for use in self.uses)

    def costs_on(self, fraction: float) -> CostCurve:
        """Return the duration of batches with this share of a GPU."""
        curve = self.costs
        return CostCurve(
            curve.fixed_s / fraction,
            curve.row_s / fraction,
            tuple((size, duration / fraction) for size, duration in curve.table),
        )

    def dealt(self, replicas: int) -> list[dict[RobotNeed, int]]:
        """Return the robots of each replica if they are assigned to the replicas in turn."""
        hands: list[dict[RobotNeed, int]] = [{} for _ in range(replicas)]
        first = 0
        for use in self.uses:
            every, remainder = divmod(use.count, replicas)
            for index in range(replicas):
                count = every + ((index - first) % replicas < remainder)
                if count:
                    hands[index][use.need] = hands[index].get(use.need, 0) + count
            first = (first + remainder) % replicas
        return hands

    def fullest(self, replicas: int, fraction: float) -> ReplicaLoad:
        """Return the highest load of these replicas."""
        costs = self.costs_on(fraction)
        hands = {tuple(hand.items()): hand for hand in self.dealt(replicas)}
        loads = [
            replica_load(costs, hand, self.max_batch_size, self.transport_s)
            for hand in hands.values()
        ]
        return max(loads)


@dataclass(frozen=True)
class GroupPlan:
    """The prediction for the robots of one group and one model."""

    group: str
    robots: int
    hz: float
    rows: int
    share: float  # share of ticks with an action in time
    target_share: float
    replan_ms: float  # time between two requests of a robot
    slack_ms: float  # time between the arrival of an answer and the tick that needs it
    age_p95_ms: float  # 95th percentile of the ages of executed actions
    target_age_ms: float | None


@dataclass(frozen=True)
class ModelPlan:
    """The deployment of one model."""

    model: str
    replicas: int
    gpu_fraction: float
    batch_size: int
    load: float  # load of the replica with the highest load
    latency_ms: float  # longest time from a request to its answer
    groups: tuple[GroupPlan, ...]


@dataclass(frozen=True)
class FleetPlan:
    """The plan of a fleet, or of the largest part of it that the GPUs can serve."""

    models: tuple[ModelPlan, ...]
    gpus: tuple[tuple[Layout, int], ...]  # each layout, and the number of GPUs with it
    parts: int  # the number of equal parts of a GPU in which layouts count
    gpus_at_hand: int
    gpus_needed: int  # number of GPUs that the whole fleet needs
    robots: Mapping[str, int]  # number of served robots in each group
    robots_wanted: Mapping[str, int]
    demands: tuple[Demand, ...]  # demands of the served robots

    @property
    def is_complete(self) -> bool:
        """Whether all robots are served."""
        return self.robots == self.robots_wanted

    @property
    def gpus_used(self) -> int:
        """The number of GPUs."""
        return sum(count for _, count in self.gpus)

    def document(self) -> dict[str, Any]:
        """Return the plan as values of JSON."""
        return {
            "models": [asdict(model) for model in self.models],
            "gpus": [
                {"gpus": count, "replicas": self._replicas_on(layout)}
                for layout, count in self.gpus
            ],
            "gpus_used": self.gpus_used,
            "gpus_at_hand": self.gpus_at_hand,
            "gpus_needed": self.gpus_needed,
            "gpus_missing": max(0, self.gpus_needed - self.gpus_at_hand),
            "robots": dict(self.robots),
            "robots_wanted": dict(self.robots_wanted),
            "complete": self.is_complete,
        }

    def _replicas_on(self, layout: Layout) -> list[dict[str, Any]]:
        """Return the replicas on a GPU with this layout as values of JSON."""
        return [
            {
                "model": piece.model,
                "replicas": replicas,
                "gpu_fraction": round(piece.parts / self.parts, 4),
            }
            for piece, replicas in layout.pieces
        ]


def plan(fleet: FleetFile) -> FleetPlan:
    """Compute the plan of a fleet.

    If the GPUs are too few, the plan is for the largest fleet that they can serve, whose groups
    have the same proportions.

    Raises:
        ConfigError: A robot cannot be in time even alone on a GPU, or no robot can be served.
    """
    robots_wanted = {name: robots.count for name, robots in fleet.robots.items()}
    curves = {name: model.costs.curve() for name, model in fleet.models.items()}
    whole = _demands(fleet, robots_wanted, curves)
    needed = _fewest(whole, fleet.gpus)
    if needed.gpus <= fleet.gpus.count:
        return _with_slack(whole, fleet.gpus, needed, needed.gpus, robots_wanted, robots_wanted)

    total = sum(robots_wanted.values())
    most, too_many = 0, total
    best: tuple[list[Demand], Packing, dict[str, int]] | None = None
    while too_many - most > 1:
        robots = (most + too_many) // 2
        counts = _in_proportion(robots_wanted, robots)
        demands = _demands(fleet, counts, curves)
        packing = _fewest(demands, fleet.gpus)
        if packing.gpus <= fleet.gpus.count:
            most = robots
            best = (demands, packing, counts)
        else:
            too_many = robots
    if best is None:
        raise ConfigError(
            f"gpus: expected at least {needed.gpus} GPUs for these robots, got "
            f"{fleet.gpus.count}, which serve none of the robots in time"
        )
    demands, packing, counts = best
    return _with_slack(demands, fleet.gpus, packing, needed.gpus, counts, robots_wanted)


def _demands(
    fleet: FleetFile, counts: Mapping[str, int], curves: Mapping[str, CostCurve]
) -> list[Demand]:
    """Return the demand of each model that some robots use."""
    demands = []
    for name, model in fleet.models.items():
        uses = []
        for group, robots in fleet.robots.items():
            use = robots.models.get(name)
            if use is None or not counts[group]:
                continue
            age_ms = use.age_ms or robots.age_ms
            need = RobotNeed(
                use.hz or robots.hz, use.rows, None if age_ms is None else age_ms / 1e3
            )
            uses.append(Use(group, need, counts[group], robots.share, robots.transport_ms / 1e3))
        if uses:
            demands.append(
                Demand(
                    name,
                    curves[name],
                    model.memory_gb,
                    model.max_batch_size,
                    model.gpu_fraction,
                    model.max_load,
                    tuple(uses),
                )
            )
    return demands


def _in_proportion(robots_wanted: Mapping[str, int], robots: int) -> dict[str, int]:
    """Return the numbers of robots by group, `robots` in total, in about the proportions of the
    wanted robots.
    """
    total = sum(robots_wanted.values())
    exact = {group: count * robots / total for group, count in robots_wanted.items()}
    counts = {group: math.floor(value) for group, value in exact.items()}
    by_rest = sorted(exact, key=lambda group: counts[group] - exact[group])
    for group in by_rest[: robots - sum(counts.values())]:
        counts[group] += 1
    return counts


def _parts(pool: GpuPool, demands: Sequence[Demand]) -> int:
    """Return the number of equal parts of a GPU, of which each fraction is a multiple."""
    parts = max(1, math.floor(1 / pool.finest_fraction + 1e-9))
    if any(demand.gpu_fraction is not None for demand in demands):
        return math.lcm(parts, 20) if parts > 1 else 20
    return parts


def _pieces(demand: Demand, pool: GpuPool, parts: int) -> Iterator[Piece]:
    """Yield the shares of a GPU that a replica of a model may have."""
    fixed = demand.gpu_fraction
    if fixed is not None:
        exact = fixed * parts
        if abs(exact - round(exact)) > 1e-6:
            raise ConfigError(
                f"models.{demand.model}.gpu_fraction: expected a multiple of {1 / parts:g}, got "
                f"{fixed:g}"
            )
        yield Piece(demand.model, round(exact))
        return
    smallest = max(1, math.ceil(pool.finest_fraction * parts - 1e-9))
    for share in range(smallest, parts + 1, smallest):
        # A replica can share a GPU only if its memory fits on one.
        if share == parts or demand.memory_gb <= pool.memory_gb:
            yield Piece(demand.model, share)


def _fewest_replicas(demand: Demand, fraction: float) -> int | None:
    """Return the smallest number of replicas with which all robots are in time, or None."""
    most = demand.robots
    if demand.fullest(most, fraction).load > demand.max_load:
        return None
    too_few = 0
    while most - too_few > 1:
        replicas = (most + too_few) // 2
        if demand.fullest(replicas, fraction).load <= demand.max_load:
            most = replicas
        else:
            too_few = replicas
    return most


def _choices(demand: Demand, pool: GpuPool, parts: int) -> list[Choice]:
    """Return, for each possible share of a GPU, the choice that serves a model with the fewest
    replicas.
    """
    choices = []
    for piece in _pieces(demand, pool, parts):
        fraction = piece.parts / parts
        replicas = _fewest_replicas(demand, fraction)
        if replicas is not None:
            load = demand.fullest(replicas, fraction).load
            choices.append(Choice(piece, replicas, load))
    if not choices:
        raise ConfigError(_too_slow(demand))
    return choices


def _too_slow(demand: Demand) -> str:
    """Return the reason why no replica can serve the robots of a model in time, with a cure."""
    fraction = demand.gpu_fraction or 1.0
    costs = demand.costs_on(fraction)
    for use in demand.uses:
        load = replica_load(costs, {use.need: 1}, 1, demand.transport_s)
        if load.load > demand.max_load:
            answer_ms = (costs.cost_s(1) + demand.transport_s) * 1e3
            have_ms = use.need.rows / use.need.hz * 1e3
            age = "" if use.need.age_s is None else f" and an age of {use.need.age_s * 1e3:g} ms"
            return (
                f"robots.{use.group}: expected a model that keeps one robot in time, whose "
                f"{use.need.rows} rows last {have_ms:.0f} ms{age}; got {demand.model!r}, whose "
                f"answer takes {answer_ms:.0f} ms with {fraction:g} of a GPU for a lone robot; "
                "lower hz, execute more rows, or allow an older action"
            )
    return (
        f"models.{demand.model}: expected a number of replicas that serves its robots in time, got "
        "none; raise gpu_fraction"
    )


def _fewest(demands: Sequence[Demand], pool: GpuPool) -> Packing:
    """Return the packing of these robots on the fewest GPUs, however many are available."""
    parts = _parts(pool, demands)
    choices: list[Choice] = []
    for demand in demands:
        choices += _choices(demand, pool, parts)
    return fewest_gpus(choices, _layouts(choices, demands, pool, parts))


def _layouts(
    choices: Sequence[Choice], demands: Sequence[Demand], pool: GpuPool, parts: int
) -> list[Layout]:
    memory_gb = {demand.model: demand.memory_gb for demand in demands}
    pieces = list(dict.fromkeys(choice.piece for choice in choices))
    return layouts(pieces, parts, memory_gb, pool.memory_gb)


def _with_slack(
    demands: Sequence[Demand],
    pool: GpuPool,
    fewest: Packing,
    gpus_needed: int,
    counts: Mapping[str, int],
    robots_wanted: Mapping[str, int],
) -> FleetPlan:
    """Return the plan with the smallest load on as many GPUs as the packing has."""
    parts = _parts(pool, demands)
    choices = []
    for demand in demands:
        for choice in _choices(demand, pool, parts):
            fraction = choice.piece.parts / parts
            most = min(
                demand.robots, (parts // choice.piece.parts) * fewest.gpus, choice.replicas * 4
            )
            step = max(1, (most - choice.replicas) // _MOST_CHOICES)
            choices.append(choice)
            for replicas in range(choice.replicas + 1, most + 1, step):
                load = demand.fullest(replicas, fraction)
                choices.append(replace(choice, replicas=replicas, load=load.load))

    packing = least_load(choices, _layouts(choices, demands, pool, parts), fewest.gpus)
    models = tuple(_model_plan(demand, packing.choices[demand.model], parts) for demand in demands)
    return FleetPlan(
        models=models,
        gpus=tuple(packing.layouts),
        parts=parts,
        gpus_at_hand=pool.count,
        gpus_needed=gpus_needed,
        robots=counts,
        robots_wanted=robots_wanted,
        demands=tuple(demands),
    )


def _model_plan(demand: Demand, choice: Choice, parts: int) -> ModelPlan:
    fraction = choice.piece.parts / parts
    fullest = demand.fullest(choice.replicas, fraction)
    costs = demand.costs_on(fraction)
    groups = tuple(predicted(use, fullest, costs) for use in demand.uses)
    return ModelPlan(
        model=demand.model,
        replicas=choice.replicas,
        gpu_fraction=round(fraction, 4),
        batch_size=fullest.batch_size,
        load=fullest.load,
        latency_ms=fullest.latency_s * 1e3,
        groups=groups,
    )


def predicted(use: Use, fullest: ReplicaLoad, costs: CostCurve) -> GroupPlan:
    """Predict the service of robots by a replica.

    A robot sends its next request after the share of its plan that the server declares, at the next
    tick, and not before the last answer has arrived. An overloaded replica answers only a part of
    the requests that the robots need.
    """
    need = use.need
    period_s = 1 / need.hz
    usual_s = costs.cost_s(fullest.batch_size) * (1 + min(1.0, fullest.load) / 2) + use.transport_s
    replan_s = max(fullest.replan_s(need), usual_s, period_s)
    replan_s = math.ceil(replan_s / period_s - 1e-6) * period_s
    interval_s = need.interval_s(fullest.latency_s)
    share = 1.0 if fullest.in_time else min(1.0, USABLE / fullest.load)
    if need.rows == 1:
        # The action is executed at the first tick after its answer.
        age_s = math.ceil(usual_s / period_s - 1e-6) * period_s
        slack_s = period_s - fullest.latency_s
    else:
        # Between two answers, the age of the executed actions grows from the duration of an answer
        # to this duration plus the time between two requests.
        age_s = usual_s + 0.95 * replan_s
        slack_s = interval_s - replan_s
    return GroupPlan(
        group=use.group,
        robots=use.count,
        hz=need.hz,
        rows=need.rows,
        share=share,
        target_share=use.share,
        replan_ms=replan_s * 1e3,
        slack_ms=max(0.0, slack_s) * 1e3,
        age_p95_ms=age_s * 1e3,
        target_age_ms=None if need.age_s is None else need.age_s * 1e3,
    )
