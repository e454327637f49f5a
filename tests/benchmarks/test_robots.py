"""The robots' ticks in time and their success: the capacity of a policy, the figures, and a few
robots with a server.
"""

from __future__ import annotations

import contextlib
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import robot_process
from benchmarks.robot_process import OPENPI, OURS, RAY_SERVE, VLAGENTS, Loop, Robot, RunningRobot
from benchmarks.robots import LOOPS, RobotsPlan, measure_robots, show_robots, summary
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.success import Solved, SuccessCurve, write_curves

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
    assert summary([figures], 10.0, CURVE)["in_time"] == 0


class Slow(Agent):
    """A policy whose answers take 0.25 s."""

    contract = Contract(action=ActionSpec(dim=7, delta=True), chunk=8)

    def act(self, obs: Obs) -> Act:
        time.sleep(0.25)
        return Act(np.zeros((8, 7), np.float32))


def test_a_waiting_loop_counts_the_ticks_of_each_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    """At 20 Hz, an answer takes five ticks. The robot executes half of its rows."""
    monkeypatch.setattr(robot_process, "connect", lambda _: Slow())
    with contextlib.closing(RunningRobot(Robot("", OPENPI, 20.0, 8, 8, "waiting"))) as robot:
        begin = time.monotonic()
        figures = robot.run(begin, begin + 0.3, begin + 2.0)
    assert figures["late"] == 0
    assert set(figures["delays"]) == {0}
    # A busy machine may make a wait longer, and never shorter.
    assert len(figures["waits"]) >= 2
    assert min(figures["waits"]) >= 4.99
    # Each wait is followed by the rows of its chunk.
    assert figures["ticks"] >= sum(figures["waits"]) + 4 * (len(figures["waits"]) - 1)


def test_a_player_reports_the_delay_of_each_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robot_process, "connect", lambda _: Slow())
    with contextlib.closing(RunningRobot(Robot("", OURS, 20.0, 8, 8))) as robot:
        begin = time.monotonic()
        figures = robot.run(begin, begin + 0.6, begin + 2.5)
    assert figures["waits"] == []
    # An answer takes five ticks or more. If the rows end before it arrives, fewer are executed.
    assert max(figures["delays"]) >= 5
    assert min(figures["delays"]) < 5
    assert figures["late"] > 0


class Grasping(Agent):
    """A policy whose answers take 0.15 s, and open or close the gripper in turn at row 5."""

    contract = Contract(
        action=ActionSpec(dim=7, delta=True, gripper_open=1.0, gripper_closed=0.0), chunk=8
    )

    def __init__(self) -> None:
        self.answers = 0

    def act(self, obs: Obs) -> Act:
        time.sleep(0.15)
        self.answers += 1
        rows = np.zeros((8, 7), np.float32)
        rows[:5, -1] = self.answers % 2
        rows[5:, -1] = (self.answers + 1) % 2
        return Act(rows)


def test_a_robot_that_stands_before_it_moves_a_gripper_waits_by_choice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """At 20 Hz, an answer takes three ticks, so that the observation of each grip is too old."""
    monkeypatch.setattr(robot_process, "connect", lambda _: Grasping())
    with contextlib.closing(RunningRobot(Robot("", OURS, 20.0, 8, 8))) as robot:
        begin = time.monotonic()
        figures = robot.run(begin, begin + 0.5, begin + 3.0)
    assert figures["waits"], figures
    assert figures["ticks"] == pytest.approx(
        len(figures["ages"]) + figures["late"] + sum(figures["waits"])
    )


@pytest.mark.parametrize("loop", LOOPS)
def test_the_figures_of_a_robot_survive_their_way_between_processes(
    monkeypatch: pytest.MonkeyPatch, loop: Loop
) -> None:
    monkeypatch.setattr(robot_process, "connect", lambda _: Late())
    with contextlib.closing(RunningRobot(Robot("", OURS, 20.0, 8, 4, loop))) as robot:
        begin = time.monotonic()
        figures = json.loads(json.dumps(robot.run(begin, begin, begin + 1.5)))
    assert summary([figures], 20.0, CURVE)["successful"] == 0


CURVE = SuccessCurve(
    "tabletop", 20.0, "async", {}, {0: Solved(500, 500, 25.0), 3: Solved(490, 500, 30.0)}
)


def figures_of(ticks: int, late: int, missed: int = 0, *delays: float) -> dict[str, Any]:
    return {
        "ticks": ticks,
        "late": late,
        "missed": missed,
        "waits": [],
        "delays": list(delays),
        "ages": [100.0, 300.0],
        "failed": "",
    }


def test_a_robot_is_in_time_if_at_least_98_of_100_ticks_are() -> None:
    robots = [figures_of(100, 2), figures_of(100, 3), figures_of(200, 195, 5)]
    found = summary(robots, 10.0, CURVE)
    assert found["in_time"] == 1
    assert found["share"] == pytest.approx(0.5)
    assert found["least_share"] == pytest.approx(5 / 200)
    assert found["missed"] == pytest.approx(5 / 400)
    assert found["age_p50_ms"] == 100
    assert found["age_p99_ms"] == 300
    # They have no answer.
    assert found["successful"] == 0
    assert found["within_tolerance"] is None


def test_the_success_of_robots_follows_from_the_delays_of_their_answers() -> None:
    robots = [figures_of(100, 0, 0, 1, 3), figures_of(100, 0, 0, 3, 4, math.inf)]
    found = summary(robots, 10.0, CURVE)
    assert (found["in_time"], found["successful"]) == (2, 1)
    assert found["within_tolerance"] == pytest.approx(3 / 5)
    assert (found["delay_p50_rows"], found["delay_p99_rows"]) == (3, None)
    # Saved as JSON, without infinities.
    json.dumps(found, allow_nan=False)


def test_without_a_curve_the_success_of_robots_is_not_known() -> None:
    found = summary([figures_of(100, 0, 0, 1)], 10.0, None)
    assert found["in_time"] == 1
    names = ("successful", "tasks_per_gpu_hour", "within_tolerance")
    assert [found[name] for name in names] == [None, None, None]


def test_systems_that_are_not_installed_are_skipped_by_name() -> None:
    others = (RAY_SERVE, OPENPI, VLAGENTS)
    found = measure_robots(RobotsPlan(systems=others, python=FEW.python))
    assert found["points"] == []
    assert set(found["skipped"]) == set(others)


@pytest.mark.server
@pytest.mark.integration
@pytest.mark.parametrize(("fleet", "loop"), [("8", "player"), ("mixed", "waiting")])
def test_a_few_robots_are_in_time(
    fleet: str, loop: Loop, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_curves(tmp_path, [CURVE, replace(CURVE, mode="open_loop")])
    plan = replace(FEW, systems=(OURS,), loops=(loop,), fleets=(fleet,), checkpoint=tmp_path)
    found = measure_robots(plan)
    [point] = found["points"]
    assert point["robots"] == {"8": 5, "mixed": 9}[fleet]
    assert point["failed"] == []
    assert point["share"] >= IN_TIME, point
    assert point["tasks_per_gpu_hour"] > 0
    show_robots(found)
    assert f"{point['share']:.1%}" in capsys.readouterr().out
