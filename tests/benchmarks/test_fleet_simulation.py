"""The simulation of a large fleet, tested with a small one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.fleet_simulation import (
    IN_TIME,
    SCENARIOS,
    Outcome,
    Shape,
    limits,
    main,
    outcome,
    run,
)

SMALL = Shape(robots=100, replicas=10, nodes=5)


def result_of(name: str, shape: Shape = SMALL) -> Outcome:
    """Return the outcome of a scenario for a small fleet."""
    scenario = SCENARIOS[name]
    tally, world = run(scenario, shape, seed=1)
    assert sum(replica.sessions for replica in world.replicas["pi0"]) == shape.robots
    return outcome(scenario, tally, world, cpu_s=0.0)


@pytest.mark.slow
def test_all_robots_that_start_at_once_are_in_time() -> None:
    for name in ("morning", "rush"):
        result = result_of(name)
        assert result.worst_share >= IN_TIME
        assert result.late_robots == 0
        assert result.most_sessions <= 13, "a quarter more than the mean must be tolerated"


@pytest.mark.slow
def test_a_hash_places_sessions_less_evenly() -> None:
    assert result_of("hash").most_sessions >= result_of("morning").most_sessions


@pytest.mark.slow
def test_robots_are_in_time_again_after_losses() -> None:
    for name in ("node", "rack"):
        result = result_of(name)
        assert result.worst_share < 1
        assert 0 < result.in_time_s < 8
        assert 0 < result.all_in_time_s < 15


@pytest.mark.slow
def test_robots_move_to_new_replicas_without_a_late_tick() -> None:
    result = result_of("growth")
    assert result.moves > 0
    assert result.share == pytest.approx(1.0, abs=1e-3)


@pytest.mark.slow
def test_a_rolling_update_replaces_all_replicas() -> None:
    scenario = SCENARIOS["update"]
    tally, world = run(scenario, SMALL, seed=1)
    alive = [replica for replica in world.replicas["pi0"] if replica.alive]
    assert len(alive) == SMALL.replicas
    assert len(world.replicas["pi0"]) == 2 * SMALL.replicas
    assert outcome(scenario, tally, world, 0.0).share > 0.99


@pytest.mark.slow
def test_a_fleet_that_is_too_large_has_robots_that_are_late() -> None:
    result = result_of("morning", replace(SMALL, robots=600))
    assert result.late_robots > 50


def test_the_first_limit_is_named_first() -> None:
    reached = limits(Shape(), requests_hz=2.0)
    robots = [limit.limit_robots for limit in reached if limit.limit_robots is not None]
    assert robots == sorted(robots)
    assert reached[-1].limit_robots is None
    assert any("controller" in limit.part for limit in reached)
    assert all(limit.source for limit in reached)


def test_the_results_are_printed_and_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--robots", "40", "--replicas", "5", "--nodes", "5"]
    words += ["--scenario", "hash", "--scenario", "node"]
    main([*words, "--json", str(tmp_path / "results.json")])
    printed = capsys.readouterr().out
    assert "40 robots at 10 Hz" in printed
    assert "| a node is lost | " in printed
    assert "Assumed: " in printed
    document = json.loads((tmp_path / "results.json").read_text())
    assert [result["scenario"] for result in document["outcomes"]][1] == "a node is lost"
    assert document["outcomes"][0]["share"] > 0.9
