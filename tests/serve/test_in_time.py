"""The reports of robots about their ticks, and their sums at a replica."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from in_flight import answered, submit

from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import EXECUTED_AGE, TICKS, Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.in_time import RobotReport, RobotTimes


def test_a_report_is_optional_and_checked() -> None:
    assert RobotReport.of({}) is None
    assert RobotReport.of({"captured_at": 1.0}) is None
    assert RobotReport.of({TICKS: [8, 1], EXECUTED_AGE: 120.5}) == (8, 1, 120.5)
    assert RobotReport.of({TICKS: (8, 8)}) == (8, 8, None)
    assert RobotReport.of({EXECUTED_AGE: 0}) == (0, 0, 0.0)


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
