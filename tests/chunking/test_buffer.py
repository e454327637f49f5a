"""Overlapping chunks and the next executed row, and the age of observations, independent of the
wall clock.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from eval_fakes import SimulatedTime

from vlagents_ray import ConfigError, InvalidObservation, Obs, PolicyFailed
from vlagents_ray.chunking.buffer import CaptureClock, Chunk, ChunkBuffer, DelayEstimate
from vlagents_ray.interface import GIVEN


def chunk(number: int, step: int, values: list[float], *, done: bool = False) -> Chunk:
    return Chunk(number, step, np.array(values, np.float32)[:, np.newaxis], done)


def values(plan: ChunkBuffer, steps: int) -> list[float | None]:
    """Return the executed values of the next `steps` steps, and advance the plan by these steps."""
    done: list[float | None] = []
    for _ in range(steps):
        done.append(None if plan.next is None else round(float(plan.next.action[0]), 6))
        plan.advance()
    return done


def advanced(steps: int) -> ChunkBuffer:
    plan = ChunkBuffer()
    for _ in range(steps):
        plan.advance()
    return plan


def test_rows_that_others_were_executed_in_place_of_are_left_out() -> None:
    plan = advanced(12)
    assert plan.add(chunk(0, 10, [0, 1, 2, 3]))
    assert values(plan, 4) == [2, 3, None, None]


def test_while_the_robot_holds_no_row_is_left_out_however_long_that_takes() -> None:
    plan = ChunkBuffer()
    plan.add(chunk(0, 0, [0, 1, 2]))
    assert values(plan, 2) == [0, 1]
    for _ in range(1000):
        assert plan.next is not None  # the plan is not advanced
    assert plan.add(chunk(1, 1, [10, 20, 30]))  # from an observation before the second row
    assert values(plan, 3) == [20, 30, None]


def test_an_answer_that_came_too_late_altogether_changes_nothing() -> None:
    plan = advanced(30)
    assert not plan.add(chunk(0, 0, [0, 1, 2]))
    assert plan.next is None


def test_an_answer_is_dropped_after_more_steps_than_it_was_given_rows() -> None:
    for steps, taken in ((2, True), (3, False)):
        plan = ChunkBuffer()
        plan.add(chunk(0, 0, [0, 1, 2, 3, 4]))
        values(plan, steps)
        assert plan.add(chunk(1, 0, [0, 1, 20, 30, 40])._replace(info={GIVEN: 2})) == taken
        assert values(plan, 1) == [20 if taken else 3]


def test_an_answer_one_step_too_late_is_good_for_its_last_row_if_there_is_no_other() -> None:
    plan = advanced(1)
    assert plan.add(chunk(0, 0, [7]))
    assert values(plan, 2) == [7, None]
    plan = advanced(1)
    plan.add(chunk(0, 0, [0, 1]))
    assert not plan.add(chunk(1, 0, [7]))
    assert values(plan, 2) == [1, None]


@pytest.mark.parametrize(
    ("merge", "expected"),
    [
        ("newest", [1, 20, 30]),
        ("average", [1, 11, 30]),
        ("weighted_average", [1, 0.3 * 2 + 0.7 * 20, 30]),
        ("conservative", [1, 0.7 * 2 + 0.3 * 20, 30]),
        (np.maximum, [1, 20, 30]),
    ],
)
def test_a_tick_that_two_chunks_have_a_row_for_is_merged_as_chosen(
    merge: object, expected: list[float]
) -> None:
    plan = ChunkBuffer(merge)
    plan.add(chunk(0, 0, [1, 2]))
    plan.add(chunk(1, 1, [20, 30]))
    assert values(plan, 3) == pytest.approx(expected)
    with pytest.raises(ConfigError, match="expected one of"):
        ChunkBuffer("median")


def test_the_ensemble_weighs_as_act_does_oldest_first() -> None:
    plan = ChunkBuffer("ensemble", ensemble_m=0.5)
    for step in range(3):
        plan.add(chunk(step, step, [float(step)] * 5))
    weights = np.exp(-0.5 * np.arange(3))
    assert values(plan, 3)[2:] == pytest.approx([weights @ [0, 1, 2] / weights.sum()])


def test_what_is_left_of_the_plan_is_what_would_be_done() -> None:
    plan = ChunkBuffer("average")
    plan.add(chunk(0, 0, [0, 2, 4]))
    plan.add(chunk(1, 1, [4, 6, 8]))
    plan.advance()
    left = plan.leftover()
    assert left is not None
    assert left[:, 0].tolist() == [3, 5, 8]
    plan.drop()
    assert plan.leftover() is None


def test_a_policy_that_chunks_in_real_time_is_told_of_no_more_rows_than_are_left() -> None:
    plan = ChunkBuffer()
    assert plan.continuation(3) == {}
    plan.add(chunk(0, 0, [0, 1, 2]))
    # After a stall, all remaining rows will be executed.
    for delay, told in ((0, 0), (2, 2), (150, 3)):
        assert plan.continuation(delay)["delay_ticks"] == told


@pytest.mark.parametrize(
    ("delays", "expected"),
    [
        ([], 0),
        ([150], 150),  # the cold start is the only known delay
        ([150, 3], 3),
        ([150, 140, 3], 3),  # two calls included compilation
        ([150, 140, 3, 90, 2], 3),  # one stall
        ([3, 3, *[2] * 5, *[6] * 5], 6),  # a slower network
        ([3, 3, *[6] * 10, *[2] * 9], 2),  # a faster network
    ],
)
def test_the_expected_delay_leaves_out_a_cold_start_and_a_stall(
    delays: list[int], expected: int
) -> None:
    estimate = DelayEstimate()
    for delay in delays:
        estimate.add(delay)
    assert estimate.ticks == expected


def test_what_was_planned_from_an_old_observation_is_forgotten() -> None:
    plan = ChunkBuffer()
    for seen_at in (1.0, 2.0):
        plan.add(Chunk(0, 0, np.full((2, 1), seen_at, np.float32), seen_at=seen_at))
    assert not plan.drop(before=1.0)
    assert plan.drop(before=1.5)
    assert values(plan, 1) == [2]
    assert plan.drop()
    assert plan.next is None


def test_rows_are_handed_out_one_by_one_and_replaced_at_once() -> None:
    plan = ChunkBuffer()
    plan.replace(np.array([[1.0], [2.0], [3.0]], np.float32))
    assert [plan.take().action[0] for _ in range(2)] == [1, 2]
    plan.replace(np.array([[4.0], [5.0]], np.float32))
    assert [plan.take().action[0] for _ in range(2)] == [4, 5]
    assert plan.executed == 4
    with pytest.raises(PolicyFailed, match="no row is left for step 4"):
        plan.take()
    # Its first two rows belong to steps that have already been executed.
    plan.replace(np.array([[6.0], [7.0], [8.0]], np.float32), step=2)
    assert plan.take().row == 2
    assert plan.next is None


class Clocks(SimulatedTime):
    """The machine's clocks, and the age of an observation captured at a given wall time."""

    def __init__(self) -> None:
        self.now, self.wall_s = 100.0, 1.8e9
        self.capture = CaptureClock()

    def time(self) -> float:
        return self.wall_s

    def go_on(self, seconds: float) -> None:
        self.wall_s += seconds
        self.now += seconds

    def age(self, stamp: float | None) -> float:
        return self.now - self.capture(Obs(info={} if stamp is None else {"captured_at": stamp}))


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    clocks = Clocks()
    monkeypatch.setattr("vlagents_ray.chunking.buffer.time", clocks)
    return clocks


@pytest.mark.parametrize("jump_s", [-3600.0, -0.05, 0.0, 3600.0])
def test_one_that_is_handed_in_again_grows_old_whatever_the_clock_does(
    clocks: Clocks, jump_s: float
) -> None:
    stamp = clocks.wall_s - 0.3
    clocks.age(stamp)
    clocks.wall_s += jump_s
    clocks.go_on(1.0)
    assert clocks.age(stamp) == pytest.approx(1.3)


@pytest.mark.parametrize("jump_s", [-3600.0, 3600.0])
def test_a_jump_costs_the_observation_that_it_fell_into_and_no_other(
    clocks: Clocks, jump_s: float
) -> None:
    before = clocks.wall_s
    clocks.go_on(0.01)
    clocks.wall_s += jump_s
    assert clocks.age(before) > 3000
    clocks.go_on(0.02)
    assert clocks.age(clocks.wall_s - 0.01) == pytest.approx(0.01)


def test_an_observation_is_as_old_as_it_says_and_a_clock_only_a_little_ahead_is_borne(
    clocks: Clocks,
) -> None:
    assert clocks.age(clocks.wall_s - 0.3) == pytest.approx(0.3)
    assert clocks.age(None) == 0
    assert clocks.age(clocks.wall_s + 0.05) == 0
    assert clocks.age(clocks.wall_s + 5) == math.inf


@pytest.mark.parametrize("wrong", ["now", math.nan, math.inf])
def test_a_time_that_is_none_is_refused(wrong: object) -> None:
    with pytest.raises(InvalidObservation, match="captured_at"):
        CaptureClock()(Obs(info={"captured_at": wrong}))
