"""Compares plans of fleets with measurements: the share of ticks in time that `vlagents-ray plan`
predicts, the share in its simulation, and the share of robots at real servers.

`python -m benchmarks.fleet_plans` measures ten fleets: each model is served with the replicas,
batches and shares of a GPU of the plan, by a policy that takes the time of the cost curve without
computing, and each robot has two cameras and runs in other processes, as in `benchmarks.fleet`.
`--files` measures files of fleets instead. `--loads` measures nothing. It simulates one replica
with as many robots as different loads allow; the default of `max_load` was chosen from its results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

import numpy as np
import typer

from benchmarks.console import Out, Seconds, save
from benchmarks.figures import measured_on
from benchmarks.fleet_robots import Robot
from benchmarks.fleet_runs import run_robots, summary
from vlagents_ray.cli.console import errors, out, progress, table
from vlagents_ray.cli.options import parse_list
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.fleet import CostCurve, RobotNeed, replica_load
from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH, Deployment
from vlagents_ray.serve.launch.server import running_server
from vlagents_ray_fleet.check import check
from vlagents_ray_fleet.fleet_file import FleetFile, read_fleet
from vlagents_ray_fleet.plan import Demand, FleetPlan, ModelPlan, plan
from vlagents_ray_fleet.simulation import Tally, World, starved_streams

PI0 = {"costs": {"fixed_ms": 29.3, "row_ms": 8.06}, "memory_gb": 9}  # measured on an H200, compiled
# Measured on an H200, CUDA graphs.
GRAPHS = {"costs": {"fixed_ms": 41.5, "row_ms": 10.5}, "memory_gb": 8}
SMALL = {"costs": {"fixed_ms": 5, "row_ms": 0.5}, "memory_gb": 2, "max_batch_size": 32}
PLANNER = {"costs": {"fixed_ms": 90, "row_ms": 30}, "memory_gb": 18, "max_batch_size": 8}
# A replica has at least half of a GPU, so that few processes share the CPUs of this machine.
GPUS = {"count": 2, "memory_gb": 80, "finest_fraction": 0.5}


def _robots(count: int, hz: float, rows: int, model: str = "pi0", **more: Any) -> dict[str, Any]:
    return {"count": count, "hz": hz, "models": {model: {"rows": rows}}, **more}


FLEETS: Mapping[str, Mapping[str, Any]] = {
    "short chunks": {"robots": {"arms": _robots(20, 10, 8)}, "models": {"pi0": PI0}},
    "long chunks": {"robots": {"arms": _robots(64, 10, 50)}, "models": {"pi0": PI0}},
    "fresh actions": {
        "robots": {"arms": _robots(24, 10, 16, age_ms=1200)},
        "models": {"pi0": GRAPHS},
    },
    "single actions": {
        "robots": {"arms": _robots(16, 5, 1, "small")},
        "models": {"small": SMALL},
    },
    "two models, two kinds of robots": {
        "robots": {
            "arms": {"count": 12, "hz": 10, "models": {"pi0": {"rows": 25}, "planner": {"hz": 1}}},
            "mobile": _robots(12, 5, 15),
        },
        "models": {"pi0": PI0, "planner": PLANNER},
    },
    # Replicas with loads of 0.6 to 0.8: few robots that send frequent requests, or whose model is
    # slow.
    "short chunks, full": {"robots": {"arms": _robots(40, 10, 8)}, "models": {"pi0": PI0}},
    "fresh actions, full": {
        "robots": {"arms": _robots(31, 10, 16, age_ms=900)},
        "models": {"pi0": GRAPHS},
    },
    "answers of a planner, full": {
        "robots": {"arms": _robots(18, 1, 1, "planner")},
        "models": {"planner": PLANNER},
    },
    "chunks of a slow model, full": {
        "robots": {"arms": _robots(70, 5, 25, "planner")},
        "models": {"planner": PLANNER},
    },
    "long and short chunks, full": {
        "robots": {"arms": _robots(32, 10, 50), "hands": _robots(32, 10, 8)},
        "models": {"pi0": PI0},
    },
}

# For `--loads`: the robots of one kind, and the costs of their model.
KINDS: Mapping[str, tuple[CostCurve, int, RobotNeed]] = {
    "pi0, 50 rows at 10 Hz": (CostCurve(0.0293, 0.00806), 16, RobotNeed(10.0, 50)),
    "pi0, 25 rows at 5 Hz": (CostCurve(0.0293, 0.00806), 16, RobotNeed(5.0, 25)),
    "pi0, 8 rows at 10 Hz": (CostCurve(0.0293, 0.00806), 16, RobotNeed(10.0, 8)),
    "graphs, 16 rows at 10 Hz, 900 ms": (
        CostCurve(0.0415, 0.0105),
        16,
        RobotNeed(10.0, 16, age_s=0.9),
    ),
    "small, single actions at 10 Hz": (CostCurve(0.005, 0.0005), 32, RobotNeed(10.0, 1)),
    "planner, single answers at 1 Hz": (CostCurve(0.09, 0.03), 8, RobotNeed(1.0, 1)),
}
LOADS = (0.6, 0.7, 0.75, 0.8, 0.85, 0.9, 1.0)
_SEEDS = 3
# Time within which all robots start, s, and the simulated time after it, s.
_START_S, _SIMULATED_S = 3.0, 60.0
_TRANSPORT_S = 0.005


@dataclass(frozen=True, slots=True)
class Comparison:
    """The predicted, simulated and measured figures of the robots of one group and one model."""

    fleet: str
    model: str
    group: str
    robots: int
    replicas: int
    load: float
    predicted_share: float
    simulated_share: float
    measured_share: float
    predicted_age_p95_ms: float
    measured_age_p95_ms: float

    @property
    def points(self) -> float:
        """The error of the predicted share, in percentage points."""
        return 100 * abs(self.predicted_share - self.measured_share)


def fleets_of(files: Sequence[str]) -> dict[str, FleetFile]:
    """Return the fleets of files by their names, or the built-in ones if there are no files.

    Raises:
        ConfigError: A file cannot be read.
    """
    if files:
        return {file: read_fleet(file) for file in files}
    return {
        name: FleetFile.model_validate({**values, "gpus": GPUS}) for name, values in FLEETS.items()
    }


def measure(
    name: str, solved: FleetPlan, warm: float, seconds: float, transport: str = "websocket"
) -> Iterator[Comparison]:
    """Serve a plan, run its robots, and yield a comparison for each group and model."""
    simulated = {(group.model, group.group): group for group in check(solved).groups}
    with running_server(deployed(solved)) as server:
        fleet: list[Robot] = []
        for demand in solved.demands:
            fleet += robots_of(demand, server.apps[demand.model], transport)
        figures = list(run_robots(fleet, warm, seconds).figures)

    for model, demand in zip(solved.models, solved.demands, strict=True):
        for group, use in zip(model.groups, demand.uses, strict=True):
            of_group, figures = figures[: use.count], figures[use.count :]
            measured = summary(of_group)
            yield Comparison(
                fleet=name,
                model=model.model,
                group=group.group,
                robots=use.count,
                replicas=model.replicas,
                load=model.load,
                predicted_share=group.share,
                simulated_share=simulated[model.model, group.group].share,
                measured_share=measured["share"],
                predicted_age_p95_ms=group.age_p95_ms,
                measured_age_p95_ms=measured["age_p95_ms"],
            )


def deployed(solved: FleetPlan) -> Deployment:
    """Return a plan as a deployment of policies that take the time of their models."""
    applications = []
    for model, demand in zip(solved.models, solved.demands, strict=True):
        fixed_s, row_s = line_of(demand.costs_on(model.gpu_fraction), model)
        applications.append(
            {
                "name": model.model,
                "route_prefix": f"/{model.model}",
                "import_path": IMPORT_PATH,
                "args": {
                    "policy": "noop",
                    "config": {
                        "base_ms": 1e3 * fixed_s,
                        "per_item_ms": 1e3 * row_s,
                        "chunk": _chunk(demand),
                        "delta": True,
                    },
                    "replicas": model.replicas,
                    "batch": {"max_size": model.batch_size},
                    "sessions": {"limit": 2 * demand.robots},
                    "resources": {"num_cpus": 0},  # these policies only sleep
                },
            }
        )
    return Deployment.model_validate({"applications": applications})


def line_of(costs: CostCurve, model: ModelPlan) -> tuple[float, float]:
    """Fit a line to a curve up to the batch size of a plan; return the fixed duration of a batch
    and the duration of a row, s.
    """
    if not costs.table:
        return costs.fixed_s, costs.row_s
    sizes = np.arange(1, model.batch_size + 1)
    durations_s = [costs.cost_s(int(size)) for size in sizes]
    if len(sizes) == 1:
        return durations_s[0], 0.0
    row_s, fixed_s = np.polyfit(sizes, durations_s, 1)
    return max(0.0, float(fixed_s)), max(0.0, float(row_s))


def _chunk(demand: Demand) -> int:
    return max(use.need.rows for use in demand.uses)


def robots_of(demand: Demand, url: str, transport: str) -> list[Robot]:
    """Return the robots that use a model, group by group; a robot with two models counts as two, as
    it has two sessions with separate rates.
    """
    robots = []
    for use in demand.uses:
        age_s = use.need.age_s
        robot = Robot(
            url,
            use.need.hz,
            _chunk(demand),
            rows=use.need.rows,
            way=transport,
            age_ms=None if age_s is None else 1e3 * age_s,
            share=use.share,
        )
        robots += [robot] * use.count
    return robots


def most_robots(costs: CostCurve, need: RobotNeed, largest_batch: int, load: float) -> int:
    """Return the largest number of equal robots with which the load of a replica is at most
    `load`.
    """

    def fits(robots: int) -> bool:
        return replica_load(costs, {need: robots}, largest_batch, _TRANSPORT_S).load <= load

    most, too_many = 0, 1
    while fits(too_many):
        most, too_many = too_many, 2 * too_many
    while too_many - most > 1:
        robots = (most + too_many) // 2
        most, too_many = (robots, too_many) if fits(robots) else (most, robots)
    return most


def simulate(
    costs: CostCurve, largest_batch: int, need: RobotNeed, robots: int, seed: int
) -> dict[str, float]:
    """Simulate one replica with equal robots; return the share of all ticks in time, and the share
    of robots that had at least 98 % of their ticks in time.
    """
    world = World(seed)
    world.add_replica("model", costs, largest_batch)
    tally = Tally()
    streams = [
        world.add_stream("model", need, _TRANSPORT_S, _START_S * index / robots, tally)
        for index in range(robots)
    ]
    world.run(_START_S + _SIMULATED_S)
    world.finish()
    served = 1 - len(starved_streams(streams, 0.98)) / robots
    return {"share": tally.share, "served": served, "age_p95_ms": 1e3 * tally.age_s(0.95)}


def simulate_loads(
    loads: Sequence[float] = LOADS, progress: Callable[[str], None] = lambda _: None
) -> list[dict[str, Any]]:
    """Simulate a replica at different loads with each kind of robots, and return the worst result
    of some seeds.
    """
    rows = []
    for kind, (costs, largest_batch, need) in KINDS.items():
        for load in loads:
            robots = most_robots(costs, need, largest_batch, load)
            if not robots:
                continue
            runs = [simulate(costs, largest_batch, need, robots, seed) for seed in range(_SEEDS)]
            rows.append({"kind": kind, "load": load, "robots": robots, **_worst(runs)})
            progress(f"{kind}, load {load:g}: {rows[-1]['share']:.4f} of the ticks in time")
    return rows


def _worst(runs: Sequence[Mapping[str, float]]) -> dict[str, float]:
    return {
        "share": min(run["share"] for run in runs),
        "served": min(run["served"] for run in runs),
        "age_p95_ms": max(run["age_p95_ms"] for run in runs),
    }


def show(comparisons: Sequence[Comparison]) -> None:
    """Print a row for each group and model, and the largest error."""
    rows = table(
        "fleet",
        "model",
        "robots",
        "replicas",
        "load",
        "predicted",
        "simulated",
        "measured",
        "points apart",
        "age p95 ms",
        "predicted",
    )
    for comparison in comparisons:
        rows.add_row(
            comparison.fleet,
            comparison.model,
            f"{comparison.robots} {comparison.group}",
            str(comparison.replicas),
            f"{comparison.load:.2f}",
            f"{comparison.predicted_share:.4f}",
            f"{comparison.simulated_share:.4f}",
            f"{comparison.measured_share:.4f}",
            f"{comparison.points:.2f}",
            f"{comparison.measured_age_p95_ms:.0f}",
            f"{comparison.predicted_age_p95_ms:.0f}",
        )
    out.print(rows)
    out.print(f"at most {max(comparison.points for comparison in comparisons):.2f} points apart")


def show_loads(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print a row for each kind of robots and load."""
    shown = table("robots", "load", "of a replica", "ticks in time", "robots in time", "age p95 ms")
    for row in rows:
        shown.add_row(
            row["kind"],
            f"{row['load']:g}",
            str(row["robots"]),
            f"{row['share']:.4f}",
            f"{row['served']:.1%}",
            f"{row['age_p95_ms']:.0f}",
        )
    out.print(shown)


def main(
    files: Annotated[str, typer.Option(help="Files of fleets, separated by commas.")] = "",
    seconds: Seconds = 20.0,
    warm: Annotated[
        float,
        typer.Option(min=0, help="Seconds before each measurement, as all robots start at once."),
    ] = 10.0,
    transport: Annotated[str, typer.Option(help="websocket, http or shm.")] = "websocket",
    loads: Annotated[
        bool, typer.Option("--loads", help="Simulate one replica at different loads instead.")
    ] = False,
    out_file: Out = None,
) -> None:
    """Compare the plans of fleets with measurements of their robots."""
    with errors():
        if transport not in ("websocket", "http", "shm"):
            raise ConfigError(f"--transport: expected websocket, http or shm, got {transport!r}")
        origin = measured_on("python -m benchmarks.fleet_plans")
        if loads:
            rows = simulate_loads(LOADS, progress)
            show_loads(rows)
            save({**origin, "loads": rows}, out_file)
            return

        comparisons: list[Comparison] = []
        for name, fleet in fleets_of(parse_list(files) if files else []).items():
            solved = plan(fleet)
            for comparison in measure(name, solved, warm, seconds, transport):
                comparisons.append(comparison)
                progress(f"{name}, {comparison.group}: {comparison.points:.2f} points apart")
        show(comparisons)
        rows = [{**asdict(comparison), "points": comparison.points} for comparison in comparisons]
        save({**origin, "seconds": seconds, "warm": warm, "plans": rows}, out_file)


if __name__ == "__main__":
    typer.run(main)
