"""Real-time chunking, tested on a flow with a known result: its velocity points straight at a
target.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from vlagents_ray.policies.base.model_inputs import Row
from vlagents_ray.policies.compilation import Compilation
from vlagents_ray.policies.flow import FlowPasses, Guide

HORIZON, DIM, STEPS = 8, 3, 10
TARGET = 2.0  # the model's target for each number of each row


def row(leftover: np.ndarray | None = None, delay: int = 0) -> Row:
    return Row((), "", np.random.default_rng(0), leftover, delay)


def flow(*rows: Row, steps: int = STEPS, limit: float = 5.0) -> np.ndarray:
    """Return (B, H, D) actions, computed like a policy."""
    noise = np.random.default_rng(0).standard_normal((len(rows), HORIZON, DIM)).astype(np.float32)
    guide = Guide.for_rows(rows, HORIZON, DIM)
    actions = noise
    for step in range(steps):
        time = 1.0 - step / steps
        velocity = (actions - TARGET) / time
        if guide is not None:
            velocity = guide.steer(velocity, actions, time, noise=noise, steps=steps, limit=limit)
        actions = actions - velocity / steps
    return actions


def plan(length: int = 6) -> np.ndarray:
    return np.linspace(-1, 1, length * DIM, dtype=np.float32).reshape(length, DIM)


def test_without_a_plan_there_is_nothing_to_follow() -> None:
    assert Guide.for_rows([row(), row()], HORIZON, DIM) is None


@pytest.mark.parametrize("delay", [1, 3, 6])
def test_rows_within_the_delay_are_the_plan(delay: int) -> None:
    np.testing.assert_allclose(flow(row(plan(), delay))[0, :delay], plan()[:delay], atol=1e-6)


def test_later_rows_follow_less_and_less_and_not_at_all_after_the_plan() -> None:
    left = np.zeros((6, DIM), np.float32)
    # distance to the plan; without a plan it would be TARGET
    distance = np.abs(flow(row(left, 2))[0]).mean(1)
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


STEP = 0.25  # increment between the rows of the policy below


class Prefixed(FlowPasses):
    """A policy that was trained with prefixes. Its rows continue from the last row at time 0, by
    STEP each.
    """

    def encode(
        self, tokens: Any, mask: Any, cameras: Any, state: Any, *images: Any
    ) -> tuple[Any, Any]:
        return state, mask

    def velocity(self, constants: Sequence[Any], actions: Any, times: Any) -> Any:
        import torch

        given = times == 0
        last = given.sum(1) - 1
        start = actions[torch.arange(len(actions)), last.clamp(min=0)] * (last >= 0)[:, None]
        behind = torch.arange(HORIZON)[None, :, None] - last[:, None, None]
        wanted = (actions - start[:, None] - STEP * behind) / times.clamp(min=1e-6)[..., None]
        # The velocity of given rows was never trained.
        return torch.where(given[..., None], 100.0, wanted)


def prefixed(*rows: Row) -> np.ndarray:
    """Return (B, H, D) actions of `Prefixed`."""
    import torch

    passes = Prefixed(torch.nn.Identity(), Compilation(False))
    passes.by_row = True
    guide = Guide.for_rows(rows, HORIZON, DIM)
    assert guide is not None
    guide = guide.to(torch.from_numpy)
    noise = torch.from_numpy(np.stack([one.noise(HORIZON, DIM) for one in rows]))
    there = torch.ones(len(rows), 1, dtype=torch.bool)
    found = passes.sample(
        [torch.zeros(len(rows), 3, 8, 8)],
        [there[:, 0]],
        torch.zeros(len(rows), 1, dtype=torch.long),
        there,
        noise=guide.insert_frozen(noise),
        owners=range(len(rows)),
        steps=STEPS,
        changes=[guide.keep],
        frozen=guide.frozen,
    )
    return np.asarray(found)


@pytest.mark.torch
@pytest.mark.parametrize("delay", [1, 3, 6])
def test_a_given_prefix_comes_back_unchanged_and_the_rest_continues_it(delay: int) -> None:
    actions = prefixed(row(plan(), delay))[0]
    np.testing.assert_array_equal(actions[:delay], plan()[:delay])
    np.testing.assert_allclose(np.diff(actions[delay - 1 :], axis=0), STEP, atol=1e-5)


@pytest.mark.torch
def test_prefixes_of_other_lengths_in_a_batch_do_not_matter() -> None:
    rows = [row(plan(), 2), row(), row(plan(3), 5)]
    both = prefixed(*rows)
    np.testing.assert_allclose(np.diff(both[1], axis=0), STEP, atol=1e-5)  # the row without a plan
    for one, delay in ((0, 2), (2, 3)):
        np.testing.assert_allclose(
            both[one], prefixed([row(plan(), 2), row(), row(plan(3), 5)][one])[0], atol=1e-6
        )
        np.testing.assert_array_equal(both[one][:delay], plan(6 if one == 0 else 3)[:delay])
