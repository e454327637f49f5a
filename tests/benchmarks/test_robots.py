"""The robots' ticks in time: the capacity of a policy, the figures, and a few robots with a
server.
"""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import robot_process
from benchmarks.robot_process import OPENPI, OURS, RAY_SERVE, Robot, RunningRobot
from benchmarks.robots import RobotsPlan, measure_robots, show_robots, summary
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs

# The few robots need a tenth of the policy's time, but the machine of the tests may be busy.
IN_TIME = 0.7
FEW = RobotsPlan(loads=(0.1,), warm=2.0, seconds=3.0, python=Path("/opt/peers/bin/python"))


def test_the_capacity_is_that_of_the_best_batches() -> None:
    """A robot with 8 rows at 10 Hz requests a chunk every 0.8 s less two batches: 52 robots, with
    batches of 12 or 13 rows; those with longer chunks need fewer requests.
    """
    plan = RobotsPlan()
    assert 52 < plan.capacity("8") < 53
    assert 94 < plan.capacity("mixed") < 95
    assert 473 < plan.capacity("50") < 474


def test_a_policy_that_takes_longer_than_a_chunk_serves_no_robot() -> None:
    assert RobotsPlan(base_ms=500.0).capacity("8") == 0
    assert RobotsPlan(base_ms=500.0).capacity("50") > 1


class Late(Agent):
    """A policy whose answers arrive after the end of a measurement."""

    contract = Contract(action=ActionSpec(dim=7, delta=True), chunk=8)

    def act(self, obs: Obs) -> Act:
        time.sleep(0.6)
        return Act(np.zeros((8, 7), np.float32))


def test_a_robot_that_waits_for_its_first_answer_is_late(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_process, "connect", lambda _: Late())
    with contextlib.closing(RunningRobot(Robot("", OURS, 10.0, 8, 8))) as robot:
        begin = time.monotonic()
        figures = robot.run(begin, begin + 0.1, begin + 0.5)
    assert (figures["ticks"], figures["late"]) == (4, 4)
    assert summary([figures])["in_time"] == 0


def figures_of(ticks: int, late: int, missed: int = 0) -> dict[str, Any]:
    return {"ticks": ticks, "late": late, "missed": missed, "ages": [100.0, 300.0], "failed": ""}


def test_a_robot_is_in_time_if_at_least_98_of_100_ticks_are() -> None:
    found = summary([figures_of(100, 2), figures_of(100, 3), figures_of(200, 195, 5)])
    assert found["in_time"] == 1
    assert found["share"] == pytest.approx(0.5)
    assert found["least_share"] == pytest.approx(5 / 200)
    assert found["missed"] == pytest.approx(5 / 400)
    assert found["age_p50_ms"] == 200


def test_systems_that_are_not_installed_are_skipped_by_name() -> None:
    found = measure_robots(RobotsPlan(systems=(RAY_SERVE, OPENPI), python=FEW.python))
    assert found["points"] == []
    assert set(found["skipped"]) == {RAY_SERVE, OPENPI}


@pytest.mark.server
@pytest.mark.integration
@pytest.mark.parametrize("fleet", ["8", "mixed"])
def test_a_few_robots_are_in_time(fleet: str, capsys: pytest.CaptureFixture[str]) -> None:
    found = measure_robots(RobotsPlan((OURS,), (fleet,), FEW.loads, warm=2.0, seconds=3.0))
    [point] = found["points"]
    assert point["robots"] == {"8": 5, "mixed": 9}[fleet]
    assert point["failed"] == []
    assert point["share"] >= IN_TIME, point
    show_robots(found)
    assert f"{point['share']:.1%}" in capsys.readouterr().out
