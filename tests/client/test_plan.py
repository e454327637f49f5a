"""Chunks that overlap, and what is done at which tick."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray import ConfigError
from vlagents_ray.client.plan import Chunk, Plan


def chunk(number: int, tick: int, values: list[float], *, done: bool = False) -> Chunk:
    return Chunk(number, tick, np.array(values, np.float32)[:, np.newaxis], done, {})


def values(plan: Plan, ticks: range) -> list[float | None]:
    steps = [plan.at(tick) for tick in ticks]
    return [None if step is None else round(float(step.action[0]), 6) for step in steps]


def test_a_row_belongs_to_its_tick_however_late_it_comes() -> None:
    plan = Plan()
    assert plan.add(chunk(0, 10, [0, 1, 2, 3]), now=12) == 2
    assert values(plan, range(12, 16)) == [2, 3, None, None]


def test_an_answer_that_came_too_late_altogether_changes_nothing() -> None:
    plan = Plan()
    assert plan.add(chunk(0, 0, [0, 1, 2]), now=30) == 3
    assert values(plan, range(30, 33)) == [None] * 3


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
def test_a_tick_that_two_chunks_have_a_row_for_is_merged_as_chosen(merge: object, expected: list[float]) -> None:
    plan = Plan(merge)
    plan.add(chunk(0, 0, [1, 2]), now=0)
    plan.add(chunk(1, 1, [20, 30]), now=1)
    assert values(plan, range(3)) == pytest.approx(expected)


def test_the_ensemble_weighs_as_act_does_oldest_first() -> None:
    plan = Plan("ensemble", ensemble_m=0.5)
    for tick in range(3):
        plan.add(chunk(tick, tick, [float(tick)] * 5), now=tick)
    weights = np.exp(-0.5 * np.arange(3))
    assert values(plan, range(2, 3)) == pytest.approx([weights @ [0, 1, 2] / weights.sum()])


def test_what_is_left_of_the_plan_is_what_would_be_done() -> None:
    plan = Plan("average")
    plan.add(chunk(0, 0, [0, 2, 4]), now=0)
    plan.add(chunk(1, 1, [4, 6, 8]), now=1)
    left = plan.leftover(1)
    assert left is not None
    assert left[:, 0].tolist() == [3, 5, 8]
    assert plan.leftover(9) is None


def test_an_unknown_merge_is_refused_with_what_there_is() -> None:
    with pytest.raises(ConfigError, match="want one of"):
        Plan("median")
