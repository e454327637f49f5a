"""Policies that continue the rows of their last chunk, in an episode with late answers."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.interface import GIVEN, LEFTOVER

ROWS, EXECUTE, DIM, HZ = 8, 4, 3, 20.0


@pytest.mark.parametrize("is_relative", [True, False])
@pytest.mark.parametrize("delay", [1, 3, 4])
def test_a_policy_that_amplifies_the_rows_that_it_continues_stays_within_the_limits(
    delay: int, is_relative: bool
) -> None:
    spec = ActionSpec(dim=DIM, space="ee_position", delta=is_relative, low=-1.0, high=1.0)
    clock = ClockConfig(
        latency=delay / HZ, mode="async", real_time_chunking=True, neutral=[0.0] * DIM
    )
    executor = ChunkExecutor(EXECUTE, clock, Contract(action=spec, control_hz=HZ))
    for _ in range(100):
        plan = executor.request_info().get(LEFTOVER)
        rows, info = np.full((ROWS, DIM), 0.5, np.float32), {}
        if plan is not None:
            assert np.abs(plan).max() <= 1.0
            rows[: len(plan)], rows[len(plan) :] = 1.1 * plan, 1.1 * plan[-1]
            info = {GIVEN: min(delay, len(plan))}
        for tick in executor.ticks(rows, delay / HZ, info):
            assert np.abs(tick.action).max() <= 1.0 + 0.1 + 1e-6
