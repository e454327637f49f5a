"""What an act of OpenVLA and OpenVLA-OFT asks of a GPU."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from torch_calls import TorchCalls, calls_of_an_act

from plugins.vlagents_ray_models.tests.families.openvla.conftest import LIBRARIES, begun, seen
from vlagents_ray.interface import SAMPLES, WANT
from vlagents_ray.registry import policy_class

pytestmark = LIBRARIES
SIZE = 4


# Calls are of tiny networks: with a tenth more than measured, something was added.
@pytest.mark.parametrize(
    ("kind", "info", "most"),
    [
        ("openvla", {}, 1850),
        ("openvla", {SAMPLES: 2}, 1850),
        ("openvla", {WANT: ["logprob", "replay"]}, 1850),
        ("oft", {}, 850),
        ("oft-diffusion", {}, 10_000),
        ("oft-tokens", {}, 880),
        ("oft-tokens", {WANT: ["logprob", "replay"]}, 880),
    ],
    ids=lambda value: "-".join(value) if isinstance(value, dict) else str(value),
)
def test_an_act_waits_only_for_its_results(
    checkpoint: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    kind: str,
    info: dict[str, Any],
    most: int,
) -> None:
    # Which Llama turns off, and meta has none.
    monkeypatch.setattr(torch, "autocast", lambda **_: nullcontext())
    heads = {"oft": "l1", "oft-diffusion": "diffusion", "oft-tokens": "tokens"}
    settings = {"head": heads[kind]} if kind in heads else {}
    policy = policy_class("openvla_oft" if kind in heads else "openvla").from_config(
        {
            "checkpoint": str(checkpoint(kind)),
            "unnorm_key": "bridge_orig",
            "device": "meta",
            "dtype": "float32",
            "max_rows": 16,
        }
        | settings
    )
    with TorchCalls():
        policy.initialize()
    sessions = [begun(policy, i) for i in range(SIZE)]
    counted = calls_of_an_act(policy, sessions, [seen(i, **info) for i in range(SIZE)])
    assert sum(counted.waits.values()) == 1, counted.waits
    assert counted.calls <= most
