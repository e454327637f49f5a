"""What an act of LeRobot's policies asks of a GPU."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from torch_calls import META, TorchCalls, calls_of_an_act

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import FILTERS, Made, begun, view
from vlagents_ray.interface import DELAY, LEFTOVER, WANT
from vlagents_ray_models.lerobot import LeRobot

pytestmark = FILTERS

SIZE = 4


def on_meta(policy: LeRobot) -> LeRobot:
    """Move a loaded policy to the device meta."""
    sampler, processors = policy.model.sampler, policy.model.processors
    sampler.policy.to(META)
    sampler.config.device, sampler.staging.device = "meta", META
    for step in [*processors._before.steps, *processors._after.steps]:
        if hasattr(step, "norm_map"):
            step.to(device=META)
        elif getattr(step, "tensor_device", None) is not None and step in processors._before.steps:
            step.device, step.tensor_device = "meta", META
    processors._keep_tokens()
    return policy


def counted(policy: LeRobot, **info: Any) -> TorchCalls:
    """Count the second act, as the first one may keep constants on the device."""
    sessions = [begun(policy, i) for i in range(SIZE)]
    for _ in range(2):
        calls = calls_of_an_act(policy, sessions, [view(i, **info) for i in range(SIZE)])
    return calls


# The waits beside that for the actions are LeRobot's: ACT makes its latent on the CPU, DDPM draws
# the noise of each step but the last there, SmolVLA's processor copies three tensors of tokens.
# Calls are of tiny networks: with a tenth more than measured, something was added.
@pytest.mark.skipif(bool(tiny.NEW), reason="the counts are those of LeRobot 0.4")
@pytest.mark.parametrize(
    ("kind", "info", "waits", "most"),
    [
        ("act", {}, 2, 320),
        ("diffusion", {}, 3, 500),
        ("smolvla", {}, 4, 1150),
        ("smolvla", {WANT: ["logprob", "replay"]}, 5, 1250),
        # With a plan, each step is also differentiated.
        ("smolvla", {LEFTOVER: np.ones((6, tiny.ACTION), np.float32), DELAY: 2}, 4, 1950),
    ],
    ids=["ACT", "Diffusion", "SmolVLA", "SmolVLA, log-probabilities", "SmolVLA, a plan"],
)
def test_an_act_waits_for_its_results_and_where_lerobot_does(
    made: Made, kind: str, info: dict[str, Any], waits: int, most: int
) -> None:
    settings: dict[str, Any] = {"noise_level": 0.5} if WANT in info else {}
    policy = LeRobot.from_config({"checkpoint": str(made(kind)), "actions": "chunk", **settings})
    policy.initialize()
    calls = counted(on_meta(policy), **info)
    assert sum(calls.waits.values()) == waits, calls.waits
    assert calls.calls <= most
