"""`python -m benchmarks.checkpoints` writes LeRobot checkpoints that the policy loads and acts
with.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from benchmarks.checkpoints import lerobot as recipe
from benchmarks.checkpoints.recipe import Recipe
from benchmarks.checkpoints.recipes import write_checkpoint
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import FILTERS
from vlagents_ray.errors import ConfigError
from vlagents_ray.testing import random_observation
from vlagents_ray_models.lerobot import LeRobot

pytestmark = FILTERS


@pytest.mark.parametrize("dtype", ["float32", "bfloat16"])
def test_smolvla_loads_and_acts(tmp_path: Path, dtype: str) -> None:
    written = write_checkpoint("smolvla", tmp_path / "made", "small", dtype)
    policy = acts(written.config)
    network = policy.model.sampler.policy
    vlm, expert = network.model.vlm_with_expert.vlm, network.model.vlm_with_expert.lm_expert
    assert {parameter.dtype for parameter in vlm.parameters()} == {getattr(torch, dtype)}
    assert {parameter.dtype for parameter in expert.parameters()} == {torch.float32}
    assert written.parameters == sum(parameter.numel() for parameter in network.parameters())


@pytest.mark.parametrize("family", ["act", "diffusion"])
def test_others_load_and_act(tmp_path: Path, family: str) -> None:
    acts(write_checkpoint(family, tmp_path / "made", "small").config)


@pytest.mark.verifies("size")
@pytest.mark.parametrize(
    ("family", "millions"),
    [
        ("smolvla", 450),  # arXiv 2506.01844
        ("act", 52),  # LeRobot's with ResNet-18 and its own settings
    ],
)
def test_the_full_size_is_the_published_one(tmp_path: Path, family: str, millions: float) -> None:
    policy, _ = recipe.make_policy(Recipe(family, tmp_path, "full", "bfloat16"))
    parameters = sum(parameter.numel() for parameter in policy.parameters())
    assert parameters == pytest.approx(millions * 1e6, rel=0.03)


def test_a_pi05_of_another_size_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="pi0"):
        write_checkpoint("pi05", tmp_path / "made", "small")


def test_a_pi05_needs_the_transformers_that_serves_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "transformers.models.siglip.check", None)
    # LeRobot 0.6 does without.
    monkeypatch.setattr("vlagents_ray_models.lerobot.checkpoint.is_new", lambda: False)
    with pytest.raises(ConfigError, match="openpi's changes"):
        write_checkpoint("pi05", tmp_path / "made")
    assert list(tmp_path.iterdir()) == []


def acts(config: dict[str, Any]) -> LeRobot:
    """Load a policy, and require that its actions depend on the observations."""
    policy = LeRobot.from_config(config)
    policy.initialize()
    chunks = []
    for seed in (0, 1):
        obs = random_observation(policy.contract, seed, image_size=256)
        policy.reset(obs, "pick up the cube", seed=0)
        chunks.append(np.asarray(policy.act(obs).action))
    assert np.isfinite(chunks).all()
    assert chunks[0].shape[-1] == recipe.JOINTS
    assert chunks[0].std() > 0
    assert not np.allclose(*chunks)
    return policy
