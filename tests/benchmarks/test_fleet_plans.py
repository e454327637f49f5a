"""Plans of fleets compared with the results of their robots, with small fleets."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from benchmarks import fleet_plans
from benchmarks.fleet_plans import (
    FLEETS,
    KINDS,
    Comparison,
    deployed,
    fleets_of,
    line_of,
    measure,
    most_robots,
    robots_of,
    simulate_loads,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.fleet import USABLE, CostCurve
from vlagents_ray.serve.fleet import most_robots as most_in_time
from vlagents_ray_fleet.fleet_file import FleetFile
from vlagents_ray_fleet.plan import plan


@pytest.mark.parametrize("name", FLEETS)
def test_each_fleet_has_a_plan_that_two_cores_can_serve(name: str) -> None:
    solved = plan(fleets_of([])[name])
    assert solved.is_complete
    assert sum(model.replicas for model in solved.models) <= 4
    applications = deployed(solved).applications
    for model, demand, application in zip(solved.models, solved.demands, applications, strict=True):
        args = ServerArgs(**application.args)
        assert application.route_prefix == f"/{model.model}"
        assert (args.replicas, args.batch.max_size) == (model.replicas, model.batch_size)
        assert args.config["base_ms"] == pytest.approx(
            1e3 * demand.costs_on(model.gpu_fraction).fixed_s
        )
        robots = robots_of(demand, "http://gpu-box:8000", "websocket")
        assert len(robots) == demand.robots
        assert {robot.rows for robot in robots} == {use.need.rows for use in demand.uses}


def test_a_table_of_costs_becomes_the_line_through_the_batches_of_the_plan() -> None:
    [model] = plan(fleets_of([])["long chunks"]).models
    sizes = ((1, 0.12), (4, 0.21), (8, 0.33))
    fixed_s, row_s = line_of(CostCurve(table=sizes), dataclasses.replace(model, batch_size=8))
    assert (fixed_s, row_s) == pytest.approx((0.09, 0.03))
    of_one = line_of(CostCurve(table=sizes), dataclasses.replace(model, batch_size=1))
    assert of_one == pytest.approx((0.12, 0.0))


def test_the_robots_of_a_load_are_those_of_the_arithmetic() -> None:
    for costs, largest_batch, need in KINDS.values():
        robots = most_robots(costs, need, largest_batch, USABLE)
        assert robots == most_in_time(costs, need, largest_batch, 0.005)
        assert most_robots(costs, need, largest_batch, 0.5) < robots


def test_a_low_load_is_in_time_and_the_table_has_each_kind(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(fleet_plans, "_SIMULATED_S", 10.0)
    monkeypatch.setattr(fleet_plans, "_SEEDS", 1)
    rows = simulate_loads(loads=(0.4,))
    assert {row["kind"] for row in rows} == set(KINDS)
    assert all(row["share"] >= 0.99 for row in rows), rows

    monkeypatch.setattr(fleet_plans, "LOADS", (0.4,))
    file = tmp_path / "loads.json"
    done = CliRunner().invoke(_app(), ["--loads", "--out", str(file)])
    assert done.exit_code == 0, done.output
    assert len(json.loads(file.read_text())["loads"]) >= len(KINDS)


def test_wrong_words_are_told_before_anything_starts(tmp_path: Path) -> None:
    assert CliRunner().invoke(_app(), ["--transport", "smoke"]).exit_code == 2
    with pytest.raises(ConfigError, match="does not exist"):
        fleets_of([str(tmp_path / "nowhere.yaml")])


@pytest.mark.server
@pytest.mark.integration
def test_a_small_fleet_gets_what_its_plan_predicts() -> None:
    values = {
        "robots": {
            "arms": {"count": 4, "hz": 5, "models": {"pi0": {"rows": 10}, "planner": {"hz": 1}}}
        },
        "models": FLEETS["two models, two kinds of robots"]["models"],
    }
    fleet = FleetFile(**values, gpus=fleet_plans.GPUS | {"finest_fraction": 1})
    results: list[Comparison] = list(measure("small", plan(fleet), warm=3.0, seconds=8.0))
    assert {result.model for result in results} == {"pi0", "planner"}
    for result in results:
        assert result.robots == 4
        assert result.points <= 3.0, result
        assert 100 * abs(result.simulated_share - result.measured_share) <= 3.0, result


def _app() -> typer.Typer:
    app = typer.Typer()
    app.command()(fleet_plans.main)
    return app
