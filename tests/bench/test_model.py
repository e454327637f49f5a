"""The policy with a transformer's cost, in its smallest size."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vlagents_ray.bench.clients import observation
from vlagents_ray.bench.model import SizedConfig, SizedPolicy, build
from vlagents_ray.errors import ConfigError
from vlagents_ray.testing import check_agent

pytestmark = pytest.mark.torch


@pytest.fixture(name="policy", scope="module")
def tiny_policy() -> SizedPolicy:
    policy = SizedPolicy.from_config({"chunk": 4, "action_dim": 3})
    policy.initialize()
    return policy


def test_keeps_the_contract() -> None:
    check_agent(SizedPolicy.from_config({"size": "tiny"}))


def test_a_batch_gives_what_each_would_alone(policy: SizedPolicy) -> None:
    dark = replace(observation(), cameras={name: image // 2 for name, image in observation().cameras.items()})
    together = policy.act_batch([observation(), dark], [policy, policy])
    assert [act.action.shape for act in together] == [(4, 3), (4, 3)]
    for obs, act in zip([observation(), dark], together, strict=True):
        np.testing.assert_allclose(policy.act(obs).action, act.action, atol=1e-5)
    assert np.abs(together[0].action - together[1].action).max() > 1e-4  # it looks at the pixels


@pytest.mark.parametrize(("size", "billions"), [("pi0", 3.3), ("openvla", 7.0)])
def test_presets_are_as_large_as_what_they_are_named_for(size: str, billions: float) -> None:
    model = build(SizedConfig.model_validate({"size": size}), "meta")
    parameters = list(model.parameters())
    assert sum(one.numel() for one in parameters) == pytest.approx(billions * 1e9, rel=0.05)
    assert {str(one.dtype) for one in parameters} == {"torch.bfloat16"}


def test_a_wrong_setting_is_refused() -> None:
    with pytest.raises(ConfigError, match="size"):
        SizedPolicy.from_config({"size": "huge"})
