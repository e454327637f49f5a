"""What an act of Diffusion Policy asks of a GPU."""

from __future__ import annotations

import pytest
from torch_calls import TorchCalls

from tests.families.diffusion_policy.conftest import LIBRARIES, Checkpoint, begun, made, seen

pytestmark = LIBRARIES
SIZE = 4


# Calls are of tiny networks: with a tenth more than measured, something was added.
@pytest.mark.parametrize(("kind", "most"), [("unet", 660), ("hybrid", 760)])
def test_an_act_waits_only_for_its_results(checkpoint: Checkpoint, kind: str, most: int) -> None:
    policy = made(checkpoint(kind), device="meta", max_rows=SIZE)
    with TorchCalls():
        policy.initialize()
    sessions, views = [begun(policy, i) for i in range(SIZE)], [seen(i) for i in range(SIZE)]
    for session, obs in zip(sessions, views, strict=True):
        obs.prepared = session.prepare(obs)
    with TorchCalls() as counted:
        acts = policy.act_batch(views, sessions)
    assert not [act for act in acts if isinstance(act, Exception)]
    print(f"{kind}: {counted.calls} calls, {counted.uploads} copies, waits: {dict(counted.waits)}")
    assert sum(counted.waits.values()) == 1, counted.waits
    assert counted.calls <= most
