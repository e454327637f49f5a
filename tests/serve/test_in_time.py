"""The reports of robots about their ticks, and their sums at a replica."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from in_flight import answered, submit

from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import EXECUTED_AGE, TICKS, Act, Agent, Obs
from vlagents_ray.policies.base.checkpoint import find_checkpoint
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.in_time import RobotReport, RobotTimes, tolerated_age_ms
from vlagents_ray.success import Solved, SuccessCurve, write_curves


def test_a_report_is_optional_and_checked() -> None:
    assert RobotReport.of({}) is None
    assert RobotReport.of({"captured_at": 1.0}) is None
    assert RobotReport.of({TICKS: [8, 1], EXECUTED_AGE: 120.5}) == RobotReport(8, 1, 120.5)
    assert RobotReport.of({TICKS: (8, 8)}) == RobotReport(8, 8, None)
    assert RobotReport.of({EXECUTED_AGE: 0}) == RobotReport(0, 0, 0.0)


@pytest.mark.parametrize(
    "info",
    [
        {TICKS: 8},
        {TICKS: [8]},
        {TICKS: [8, 9]},
        {TICKS: [8, -1]},
        {TICKS: [8.0, 1.0]},
        {TICKS: [True, False]},
        {TICKS: [2**40, 0]},
        {TICKS: "88"},
        {TICKS: np.array([8, 1])},
        {EXECUTED_AGE: -1.0},
        {EXECUTED_AGE: math.inf},
        {EXECUTED_AGE: math.nan},
        {EXECUTED_AGE: True},
        {EXECUTED_AGE: "1"},
        {EXECUTED_AGE: 2**40},
    ],
)
def test_wrong_reports_are_refused(info: dict[str, Any]) -> None:
    with pytest.raises(InvalidInput, match="expected"):
        RobotReport.of(info)


def test_the_share_and_the_ages_are_of_the_last_ten_seconds() -> None:
    robot = RobotTimes()
    robot.add(RobotReport(100, 50, 500.0), 100.0)
    for second in range(105, 125):
        robot.add(RobotReport(10, 0, float(second)), second + 0.5)
    lately = robot.lately(125.0)
    assert (lately.ticks, lately.starved, lately.share) == (90, 0, 1.0)
    assert (lately.age_p50_ms, lately.age_p99_ms) == (119.0, 124.0)
    assert robot.lately(1000.0) == (0, 0, None, None, None)


def curve(delay: int, env: str = "e", mode: str = "async", **settings: Any) -> SuccessCurve:
    """Return a curve with this tolerated delay, at 20 Hz."""
    solved = {rows: Solved(500 if rows <= delay else 0, 500, 20.0) for rows in range(delay + 2)}
    measured = SuccessCurve(env, 20.0, mode, settings, solved)
    assert measured.tolerated == delay
    return measured


def test_the_tolerated_age_is_that_of_the_last_row_at_the_tolerated_delay() -> None:
    """A row of 50 ms has this age until the next tick."""
    assert tolerated_age_ms([curve(0, execute=4)]) == 4 * 50
    assert tolerated_age_ms([curve(3, execute=4)]) == 7 * 50
    # The next request waits for the answer, so that more rows are executed than 2.
    assert tolerated_age_ms([curve(3, execute=2)]) == 7 * 50
    assert tolerated_age_ms([curve(3)]) == 7 * 50
    assert tolerated_age_ms([curve(8, mode="open_loop", execute=4)]) == 12 * 50
    assert tolerated_age_ms([curve(8, mode="open_loop")]) is None


def test_the_tolerated_age_is_that_of_the_hardest_environment_and_the_best_settings() -> None:
    curves = [curve(5, execute=4), curve(2, "hard", execute=4), curve(1, "hard", execute=8)]
    assert tolerated_age_ms(curves[:2]) == tolerated_age_ms(curves[1::-1]) == 6 * 50
    assert tolerated_age_ms(curves) == 9 * 50
    # Robots that wait for each answer tolerate any delay, and robots do not wait by default.
    waits = curve(8, mode="open_loop", execute=4)
    assert tolerated_age_ms([*curves, waits]) == tolerated_age_ms([waits, *curves]) == 9 * 50


def test_ages_of_another_policy_or_of_none_are_in_no_share() -> None:
    robot = RobotTimes()
    assert robot.within_tolerance(0.0) is None
    robot.add(RobotReport(10, 0, 100.0), 1.0)
    robot.add(RobotReport(10, 10, None).compared(50.0), 1.0)
    assert robot.within_tolerance(2.0) is None
    for age_ms in (49.0, 50.0, 51.0):
        robot.add(RobotReport(10, 0, age_ms).compared(50.0), 1.5)
    assert robot.within_tolerance(2.0) == pytest.approx(2 / 3)
    assert robot.within_tolerance(100.0) is None


def test_a_robot_that_reports_often_takes_no_more_memory() -> None:
    robot = RobotTimes()
    for request in range(100_000):
        robot.add(RobotReport(1, 0, 1.0), request / 1000)
    assert len(robot._seconds) <= 11
    assert len(robot._ages) <= 128
    assert robot.lately(100.0).ticks == 9000


def test_an_engine_adds_up_what_its_sessions_report() -> None:
    engine = Engine(Noop.from_config({}))
    engine.start()
    engine.stats.enable()
    try:
        answered(engine, "arm", Request("reset", obs=Obs()))
        answered(engine, "arm", Request("act", obs=Obs()))
        session = engine.sessions.get("arm")
        assert session.times is None  # nothing is stored without a report

        for _ in range(2):
            obs = Obs(info={TICKS: [10, 1], EXECUTED_AGE: 80.0})
            answered(engine, "arm", Request("act", obs=obs))
        assert session.times.lately(engine.clock()).share == 0.9

        wrong = Request("act", obs=Obs(info={TICKS: [10, 11]}))
        with pytest.raises(InvalidInput):
            submit(engine, "arm", wrong, print)
        assert session.times.lately(engine.clock()).ticks == 20

        collected = engine.stats.collect()
        assert (collected.ticks, collected.starved) == ({"robot": 20}, {"robot": 2})
        assert collected.ages_ms["robot"].values == [80.0, 80.0]
    finally:
        engine.close()


class Measured(Agent):
    """A policy whose checkpoint is this file."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def initialize(self) -> None:
        find_checkpoint(str(self.file))

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(2, np.float32))


@pytest.mark.parametrize("is_measured", [True, False])
def test_an_engine_counts_the_ages_that_its_loaded_checkpoint_tolerates(
    tmp_path: Path, is_measured: bool
) -> None:
    (tmp_path / "weights.pt").write_bytes(b"1")
    if is_measured:
        write_curves(tmp_path, [curve(1, execute=2)])  # 150 ms
    engine = Engine(Measured(tmp_path / "weights.pt"))
    engine.start()
    engine.stats.enable()
    try:
        answered(engine, "arm", Request("reset", obs=Obs()))
        for age_ms in (149.0, 151.0, 150.0):
            obs = Obs(info={TICKS: [10, 0], EXECUTED_AGE: age_ms})
            answered(engine, "arm", Request("act", obs=obs))
        session = engine.sessions.get("arm")
        share = session.times.within_tolerance(engine.clock())
        collected = engine.stats.collect()
        assert share == (pytest.approx(2 / 3) if is_measured else None)
        counts = {"robot": 3}, {"robot": 2}
        assert (collected.compared, collected.tolerated) == (counts if is_measured else ({}, {}))

        # Nothing was measured with the weights of a learner.
        session.weights.number = 1
        obs = Obs(info={TICKS: [10, 0], EXECUTED_AGE: 1.0})
        answered(engine, "arm", Request("act", obs=obs))
        assert session.times.within_tolerance(engine.clock()) == share
        assert not engine.stats.collect().compared
    finally:
        engine.close()
