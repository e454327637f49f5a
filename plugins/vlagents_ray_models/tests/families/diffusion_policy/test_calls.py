"""What an act of Diffusion Policy asks of a GPU."""

from __future__ import annotations

import pytest
from torch_calls import TorchCalls, calls_of_an_act

from plugins.vlagents_ray_models.tests.families.diffusion_policy.conftest import (
    LIBRARIES,
    Checkpoint,
    begun,
    made,
    seen,
)

pytestmark = LIBRARIES
SIZE = 4


# Calls are of tiny networks: with a tenth more than measured, something was added.
@pytest.mark.parametrize(("kind", "most"), [("unet", 660), ("hybrid", 760)])
def test_an_act_waits_only_for_its_results(checkpoint: Checkpoint, kind: str, most: int) -> None:
    policy = made(checkpoint(kind), device="meta", max_rows=SIZE)
    with TorchCalls():
        policy.initialize()
    sessions = [begun(policy, i) for i in range(SIZE)]
    counted = calls_of_an_act(policy, sessions, [seen(i) for i in range(SIZE)])
    assert sum(counted.waits.values()) == 1, counted.waits
    assert counted.calls <= most
