"""Tests of the plan of a fleet: it has no more GPUs than needed, its robots are in time in the
simulation, and its file can be served.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.fleet import USABLE, RobotNeed, most_robots
from vlagents_ray_fleet.check import check
from vlagents_ray_fleet.fleet_file import MOST_LOAD, FleetFile, read_fleet
from vlagents_ray_fleet.plan import FleetPlan, plan

ROOT = Path(__file__).parents[3]
PI0 = {"costs": {"fixed_ms": 29.3, "row_ms": 8.06}, "memory_gb": 9}
GRAPHS = {"costs": {"table": {1: 55.3, 4: 88.4, 16: 222}}, "memory_gb": 8}
SMALL = {"costs": {"fixed_ms": 4, "row_ms": 0.5}, "memory_gb": 2, "max_batch_size": 32}
PLANNER = {"costs": {"table": {1: 120, 4: 210, 8: 330}}, "memory_gb": 18, "max_batch_size": 8}
GPUS = {"count": 8, "memory_gb": 80}


def robots(count: int, hz: float, rows: int, model: str = "pi0", **more: Any) -> dict[str, Any]:
    """Return a group of robots that use one model."""
    return {"count": count, "hz": hz, "models": {model: {"rows": rows}}, **more}


FLEETS: dict[str, dict[str, Any]] = {
    "one arm": {"robots": {"arm": robots(1, 10, 50)}, "models": {"pi0": PI0}},
    "sixty-four arms": {"robots": {"arms": robots(64, 10, 50)}, "models": {"pi0": PI0}},
    "short chunks, fresh actions": {
        "robots": {"arms": robots(24, 10, 16, age_ms=900)},
        "models": {"pi0": GRAPHS},
    },
    "single actions of a small model": {
        "robots": {"arms": robots(40, 10, 1)},
        "models": {"pi0": SMALL},
    },
    "a planner and a policy, two kinds of robots": {
        "robots": {
            "arms": {
                "count": 12,
                "hz": 10,
                "models": {"pi0": {"rows": 50}, "planner": {"hz": 1}},
            },
            "mobile": robots(20, 5, 25, age_ms=4000),
        },
        "models": {"pi0": PI0, "planner": PLANNER},
    },
}


def fleet(gpus: int = 8, **values: Any) -> FleetFile:
    return FleetFile(**values, gpus=GPUS | {"count": gpus})


def shares_of_gpus(solved: FleetPlan) -> list[float]:
    """Return the share of each used GPU that replicas have."""
    shares: list[float] = []
    for layout, count in solved.gpus:
        used_parts = sum(piece.parts * replicas for piece, replicas in layout.pieces)
        shares += [used_parts / solved.parts] * count
    return shares


@pytest.mark.parametrize("name", FLEETS)
def test_the_simulation_gives_a_fleet_what_the_plan_predicts(name: str) -> None:
    solved = plan(fleet(**FLEETS[name]))
    assert solved.is_complete
    results = check(solved, seconds=40.0)
    assert len(results.groups) == sum(len(model.groups) for model in solved.models)
    for group in results.groups:
        assert group.points <= 3.0, group
        assert group.share >= 0.98, group
        assert group.age_p95_ms <= 1.25 * group.predicted_age_p95_ms + 100, group


@pytest.mark.parametrize("name", FLEETS)
def test_no_gpu_holds_more_than_it_has_and_each_replica_has_a_place(name: str) -> None:
    values = FLEETS[name]
    solved = plan(fleet(**values))
    assert all(0 < share <= 1 + 1e-9 for share in shares_of_gpus(solved))

    placed: dict[str, int] = {}
    for layout, count in solved.gpus:
        memory_gb = 0.0
        for piece, replicas in layout.pieces:
            placed[piece.model] = placed.get(piece.model, 0) + replicas * count
            memory_gb += replicas * values["models"][piece.model]["memory_gb"]
        assert memory_gb <= GPUS["memory_gb"]
    assert placed == {model.model: model.replicas for model in solved.models}
    assert all(model.load <= MOST_LOAD for model in solved.models)


def test_the_fewest_gpus_are_those_of_the_arithmetic() -> None:
    values = {"robots": {"arms": robots(1000, 10, 50)}, "models": {"pi0": PI0}}
    solved = plan(fleet(gpus=100, **values))
    model = fleet(**values).models["pi0"]
    of_one = most_robots(model.costs.curve(), RobotNeed(10.0, 50), 16, 0.005) * MOST_LOAD / USABLE
    assert solved.gpus_used == math.ceil(1000 / math.floor(of_one))


def test_two_models_share_a_gpu_where_both_fit() -> None:
    solved = plan(fleet(**FLEETS["a planner and a policy, two kinds of robots"]))
    assert solved.gpus_used < sum(model.replicas for model in solved.models)


def test_models_whose_memory_does_not_fit_beside_each_other_do_not_share_a_gpu() -> None:
    values = FLEETS["a planner and a policy, two kinds of robots"]
    large = {name: model | {"memory_gb": 50} for name, model in values["models"].items()}
    solved = plan(fleet(robots=values["robots"], models=large))
    assert solved.gpus_used == sum(model.replicas for model in solved.models)


def test_a_fraction_that_the_file_sets_is_kept() -> None:
    small = SMALL | {"gpu_fraction": 0.25}
    solved = plan(fleet(robots={"arms": robots(8, 10, 10)}, models={"pi0": small}))
    [model] = solved.models
    assert model.gpu_fraction == 0.25
    with pytest.raises(ConfigError, match=r"gpu_fraction: expected a multiple of 0\.05, got 0\.33"):
        plan(
            fleet(
                robots={"arms": robots(8, 10, 10)}, models={"pi0": SMALL | {"gpu_fraction": 0.33}}
            )
        )


def test_gpus_that_may_not_be_shared_hold_one_replica_each() -> None:
    values = FLEETS["a planner and a policy, two kinds of robots"]
    solved = plan(FleetFile(**values, gpus=GPUS | {"finest_fraction": 1}))
    assert all(model.gpu_fraction == 1 for model in solved.models)
    assert solved.gpus_used == sum(model.replicas for model in solved.models)


def test_more_replicas_than_needed_use_what_the_gpus_have_left() -> None:
    solved = plan(fleet(robots={"arms": robots(12, 10, 50)}, models={"pi0": PI0}))
    [model] = solved.models
    assert (solved.gpus_used, model.gpu_fraction * model.replicas) == (1, pytest.approx(1))


def test_too_few_gpus_serve_as_many_robots_as_they_can() -> None:
    values = {
        "robots": {"arms": robots(900, 10, 50), "mobile": robots(300, 5, 25)},
        "models": {"pi0": PI0},
    }
    solved = plan(fleet(gpus=1, **values))
    assert not solved.is_complete
    assert solved.gpus_used == 1
    assert solved.gpus_needed == plan(fleet(gpus=100, **values)).gpus_used

    served = sum(solved.robots.values())
    assert solved.robots["arms"] == pytest.approx(3 * solved.robots["mobile"], abs=2)
    arms = -(-900 * (served + 1) // 1200)
    one_more = {
        "robots": {"arms": robots(arms, 10, 50), "mobile": robots(served + 1 - arms, 5, 25)},
        "models": {"pi0": PI0},
    }
    assert plan(fleet(gpus=100, **one_more)).gpus_used == 2

    document = solved.document()
    assert document["gpus_missing"] == solved.gpus_needed - 1
    assert all(group.share >= 0.98 for group in check(solved, seconds=30.0).groups)


def test_a_model_that_is_too_slow_for_one_robot_is_an_error_with_the_figures() -> None:
    values = {"robots": {"arms": robots(1, 30, 1)}, "models": {"pi0": PI0}}
    with pytest.raises(
        ConfigError, match=r"robots\.arms: expected .* last 33 ms; got 'pi0', .* takes 42 ms"
    ):
        plan(fleet(**values))


def test_the_same_seed_gives_the_same_simulation() -> None:
    solved = plan(fleet(**FLEETS["short chunks, fresh actions"]))
    assert check(solved, 10.0, seed=3) == check(solved, 10.0, seed=3)
    assert check(solved, 10.0, seed=3) != check(solved, 10.0, seed=4)


def test_the_file_of_the_examples_is_served_by_its_gpus() -> None:
    assert plan(read_fleet(ROOT / "examples" / "fleet.yaml")).is_complete
