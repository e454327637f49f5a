"""Real-time chunking, shown on a flow whose answer is known: its velocity points straight at a target."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.policies.base.model_inputs import Row
from vlagents_ray.policies.flow import Guide

HORIZON, DIM, STEPS = 8, 3, 10
TARGET = 2.0  # of the model, for each number of each row


def row(leftover: np.ndarray | None = None, delay: int = 0) -> Row:
    return Row((), "", np.random.default_rng(0), leftover, delay)


def flow(*rows: Row, steps: int = STEPS, limit: float = 5.0) -> np.ndarray:
    """(B, H, D) actions, as a policy makes them."""
    noise = np.random.default_rng(0).standard_normal((len(rows), HORIZON, DIM)).astype(np.float32)
    guide = Guide.of(rows, HORIZON, DIM)
    actions = noise
    for step in range(steps):
        time = 1.0 - step / steps
        velocity = (actions - TARGET) / time
        if guide is not None:
            velocity = guide.steer(velocity, actions, noise, time, steps=steps, limit=limit)
        actions = actions - velocity / steps
    return actions


def plan(length: int = 6) -> np.ndarray:
    return np.linspace(-1, 1, length * DIM, dtype=np.float32).reshape(length, DIM)


def test_without_a_plan_there_is_nothing_to_follow() -> None:
    assert Guide.of([row(), row()], HORIZON, DIM) is None


@pytest.mark.parametrize("delay", [1, 3, 6])
def test_rows_within_the_delay_are_the_plan(delay: int) -> None:
    np.testing.assert_allclose(flow(row(plan(), delay))[0, :delay], plan()[:delay], atol=1e-6)


def test_later_rows_follow_less_and_less_and_not_at_all_after_the_plan() -> None:
    left = np.zeros((6, DIM), np.float32)
    distance = np.abs(flow(row(left, 2))[0]).mean(1)  # to the plan; without one it is TARGET
    assert (np.diff(distance[1:7]) > 0).all()
    np.testing.assert_allclose(distance[6:], TARGET, rtol=1e-5)


def test_a_row_without_a_plan_is_as_if_it_were_alone() -> None:
    np.testing.assert_array_equal(flow(row(), row(plan(), 2))[0], flow(row())[0])


@pytest.mark.parametrize("steps", [1, 2, 10])
def test_few_steps_do_not_overshoot(steps: int) -> None:
    left = np.zeros((HORIZON, DIM), np.float32)
    actions = flow(row(left, 1), steps=steps, limit=100.0)[0]
    assert (actions >= -1e-5).all()
    assert (actions <= TARGET + 1e-5).all()


def test_a_delay_beyond_the_plan_and_a_plan_beyond_the_horizon_are_cut_to_it() -> None:
    np.testing.assert_allclose(flow(row(plan(2), 5))[0, :2], plan(2), atol=1e-6)
    np.testing.assert_allclose(flow(row(plan(20), 20))[0], plan(20)[:HORIZON], atol=1e-6)
