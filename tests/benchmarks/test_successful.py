"""Successful robots and tasks per GPU-hour, from the service to each robot."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.robot_process import Figures
from benchmarks.successful import FleetSuccess, ServedRobot, curve_of
from vlagents_ray.chunking.fallback import LATE, WAITING
from vlagents_ray.interface import AGE_MS, CAUSE, CHUNK, IN_TIME, ROW, SAFE
from vlagents_ray.success import Solved, SuccessCurve, write_curves

EPISODES = 500
CURVE = SuccessCurve(
    "tabletop",
    20.0,
    "async",
    {"execute": 4},
    {
        0: Solved(495, EPISODES, 25.0),
        1: Solved(492, EPISODES, 30.0),
        3: Solved(488, EPISODES, 40.0),
        5: Solved(300, EPISODES, 50.0),
    },
)

DELAYS = st.one_of(st.integers(0, 12), st.just(math.inf), st.just(math.nan))
COUNTS = st.floats(0, 1000, allow_nan=False) | st.just(math.nan)
ROBOTS = st.builds(
    ServedRobot,
    hz=st.sampled_from([5.0, 10.0, 20.0]),
    ticks=COUNTS,
    starved=COUNTS,
    waits=st.lists(st.floats(0, 50) | st.just(math.nan), max_size=20),
    delays=st.lists(DELAYS, max_size=60),
)
CURVES = st.builds(
    lambda solved, longest, ticks: SuccessCurve(
        "e",
        10.0,
        "async",
        {},
        {0: Solved(EPISODES, EPISODES, 20.0), longest: Solved(solved, EPISODES, ticks)},
    ),
    st.integers(0, EPISODES),
    st.integers(1, 8),
    st.floats(1, 1000),
)


def test_the_tolerated_delay_of_the_tests() -> None:
    assert CURVE.tolerated == 3


@given(ROBOTS, CURVES)
def test_a_robot_without_an_answer_within_the_tolerated_delay_is_not_successful(
    robot: ServedRobot, curve: SuccessCurve
) -> None:
    if not any(delay <= curve.tolerated for delay in robot.delays):
        assert not robot.is_successful(curve.tolerated)


@given(ROBOTS, CURVES)
def test_a_successful_robot_has_98_of_100_answers_and_ticks(
    robot: ServedRobot, curve: SuccessCurve
) -> None:
    tolerated = curve.tolerated
    late = [delay for delay in robot.delays if not delay <= tolerated]
    starved = robot.starved + sum(max(wait - tolerated, 0.0) for wait in robot.waits)
    if robot.is_successful(curve.tolerated):
        assert len(late) <= 0.02 * len(robot.delays) + 1e-9
        assert starved <= 0.02 * robot.ticks * (1 + 1e-9)


@given(ROBOTS, CURVES)
def test_shares_and_tasks_are_numbers_for_any_figures(
    robot: ServedRobot, curve: SuccessCurve
) -> None:
    for share in (robot.moving(), robot.in_time(curve.tolerated), robot.within(curve.tolerated)):
        assert 0 <= share <= 1
    tasks = robot.tasks_per_hour(curve)
    # No robot solves more than one that always moves, with the best delay.
    best = max(curve.tasks_per_hour(rows) for rows in curve.solved) * robot.hz / curve.hz
    assert 0 <= tasks <= best * (1 + 1e-9)


@given(ROBOTS, CURVES, st.integers(0, 19))
def test_a_later_answer_makes_no_robot_successful(
    robot: ServedRobot, curve: SuccessCurve, index: int
) -> None:
    if index < len(robot.delays):
        delays = list(robot.delays)
        delays[index] += 1
        later = ServedRobot(robot.hz, robot.ticks, robot.starved, robot.waits, delays)
        assert robot.is_successful(curve.tolerated) or not later.is_successful(curve.tolerated)


def robot(*delays: float, starved: float = 0, waits: tuple[float, ...] = ()) -> ServedRobot:
    return ServedRobot(10.0, 100 + sum(waits), starved, waits, delays)


def test_the_curve_of_a_loop_is_that_of_its_best_settings_in_the_hardest_environment(
    tmp_path: Path,
) -> None:
    assert curve_of(tmp_path) is None
    hard = replace(CURVE, env="hard", solved={0: CURVE.solved[0], 1: CURVE.solved[1]})
    waiting = replace(CURVE, mode="open_loop")
    worse = replace(CURVE, settings={"execute": 8}, solved={0: CURVE.solved[0]})
    for curves in ([worse, CURVE, hard, waiting], [hard, waiting, CURVE, worse]):
        write_curves(tmp_path, curves)
        assert curve_of(tmp_path) == hard
        assert curve_of(tmp_path, "waiting") == waiting
    write_curves(tmp_path, [waiting])
    assert curve_of(tmp_path) is None
    write_curves(tmp_path, [CURVE])
    assert curve_of(tmp_path, "waiting") == CURVE, "without a delay, all modes are the same"


def test_a_chosen_wait_is_in_time_for_as_long_as_the_tolerated_delay() -> None:
    waiting = robot(0, waits=(3.0,) * 30)
    assert waiting.in_time(3) == 1
    assert waiting.is_successful(CURVE.tolerated)
    assert waiting.moving() == pytest.approx(100 / 190)

    longer = robot(0, waits=(3.1,) * 30)
    assert longer.in_time(3) == pytest.approx(1 - 3 / 193)
    assert longer.is_successful(CURVE.tolerated)
    assert not robot(0, waits=(4.0,) * 30).is_successful(CURVE.tolerated)


def test_ticks_without_an_action_are_not_chosen_waits() -> None:
    assert robot(0, starved=2).is_successful(CURVE.tolerated)
    assert not robot(0, starved=3).is_successful(CURVE.tolerated)


def test_an_answer_with_the_tolerated_delay_is_within_it() -> None:
    assert robot(3, 3).is_successful(CURVE.tolerated)
    assert not robot(3, 4).is_successful(CURVE.tolerated)


def test_a_wait_of_unknown_duration_is_not_in_time() -> None:
    assert robot(0).in_time(3) == 1
    unknown = ServedRobot(10.0, 100, 0, (math.nan,), (0,))
    assert (unknown.in_time(3), unknown.moving()) == (0, 0)


def test_a_robot_that_was_not_served_is_not_successful() -> None:
    for unserved in (robot(), ServedRobot(10.0, 0, 0, (), (0,)), robot(math.inf, math.inf)):
        assert not unserved.is_successful(CURVE.tolerated)
        assert FleetSuccess.from_robots([unserved], CURVE).successful == 0
    assert robot().tasks_per_hour(CURVE) == 0


def test_tasks_per_gpu_hour_are_those_of_the_curve_at_the_rate_of_the_robots() -> None:
    alone = robot(0, 0)
    solved_a_tick = 495 / EPISODES / 25
    assert alone.tasks_per_hour(CURVE) == pytest.approx(solved_a_tick * 36_000)
    late = robot(3, 3, starved=25)
    assert late.tasks_per_hour(CURVE) == pytest.approx(0.75 * 488 / EPISODES / 40 * 36_000)
    assert robot(8).tasks_per_hour(CURVE) == 0, "nothing is known beyond the longest delay"
    fleet = FleetSuccess.from_robots([alone, late], CURVE)
    assert fleet.successful == 1
    assert fleet.tasks_per_gpu_hour == pytest.approx(
        alone.tasks_per_hour(CURVE) + late.tasks_per_hour(CURVE)
    )


def row(chunk: int, row: int) -> dict[str, object]:
    return {CHUNK: chunk, ROW: row, AGE_MS: 100.0, IN_TIME: True}


def test_the_delay_of_an_answer_is_the_row_with_which_it_begins() -> None:
    figures = Figures()
    late = {SAFE: "late", CAUSE: LATE.cause, IN_TIME: False}
    ticks = [row(0, 0), row(0, 1), row(1, 2), row(1, 3), late, row(4, 1), row(4, 2)]
    for info in ticks:
        figures.count(info, is_counted=True)
    assert (figures.ticks, figures.late) == (7, 1)
    # Of the chunks 2 and 3, no row was left.
    assert figures.delays == [0, 2, math.inf, math.inf, 1]
    assert len(figures.ages) == 6


def test_answers_before_the_measurement_are_not_counted() -> None:
    figures = Figures()
    for number, info in enumerate([row(0, 3), row(1, 3), row(1, 4), row(2, 1)]):
        figures.count(info, is_counted=number >= 2)
    assert (figures.ticks, figures.delays) == (2, [1])


@pytest.mark.parametrize("in_time", [{IN_TIME: True}, {}])
def test_a_tick_that_is_in_time_without_a_row_is_a_chosen_wait(in_time: dict[str, bool]) -> None:
    figures = Figures()
    chosen = {SAFE: "careful", CAUSE: WAITING.cause, **in_time}
    for info in [row(0, 0), chosen, chosen, row(1, 0), chosen, {**chosen, IN_TIME: False}]:
        figures.count(info, is_counted=True)
    assert (figures.ticks, figures.late, figures.waits) == (6, 1, [2, 1])
