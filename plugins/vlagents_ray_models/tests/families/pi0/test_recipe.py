"""`python -m benchmarks.checkpoints pi0` writes what the policy loads and acts with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.checkpoints import pi0 as recipe
from benchmarks.checkpoints import weights
from benchmarks.checkpoints.recipe import Recipe
from benchmarks.checkpoints.recipes import write_checkpoint
from vlagents_ray.testing import random_observation
from vlagents_ray_models.pi0 import Pi0


@pytest.mark.parametrize("shard_bytes", [weights.SHARD_BYTES, 200_000])
def test_it_loads_and_acts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shard_bytes: int
) -> None:
    size = recipe.Pi0Size(width=64, expert_width=32, layers=2, vision_layers=1, patch=56)
    monkeypatch.setattr(recipe, "SMALL", size)
    monkeypatch.setattr(
        recipe,
        "write_weights",
        lambda *args: weights.write_weights(*args, shard_bytes=shard_bytes),
    )
    written = write_checkpoint("pi0", tmp_path / "made", "small", "float32")
    assert (tmp_path / "made" / "model.safetensors").is_file() == (
        shard_bytes == weights.SHARD_BYTES
    )
    policy = Pi0.from_config(written.config)
    policy.initialize()
    assert policy.model is not None
    parameters = policy.model.network.parameters()
    assert written.parameters == sum(parameter.numel() for parameter in parameters)

    acts = [chunk_of(policy, seed) for seed in (0, 1)]
    assert acts[0].shape == (50, recipe.ACTION_DIM)
    assert np.isfinite(acts).all()
    assert acts[0].std() > 0
    assert not np.allclose(*acts)


@pytest.mark.verifies("size")
def test_the_full_size_is_the_published_one(tmp_path: Path) -> None:
    model, _ = recipe.make_model(Recipe("pi0", tmp_path, "full", "bfloat16"))
    parameters = dict(model.named_parameters())
    assert all(parameter.is_meta for parameter in parameters.values())

    # 3.3 billion (arXiv 2410.24164), which counts the embeddings of words once: the expert of
    # transformers has a second, unused table of them.
    used = 0
    for name, parameter in parameters.items():
        if not ("dit" in name and "embed_tokens" in name):
            used += parameter.numel()
    assert 3.2e9 < used < 3.4e9
    assert (
        model.config.dit_config.num_hidden_layers
        == model.config.vlm_config.text_config.num_hidden_layers
        == 18
    )


def chunk_of(policy: Pi0, seed: int) -> np.ndarray:
    obs = random_observation(policy.contract, seed, image_size=224)
    policy.reset(obs, "pick up the cube", seed=0)
    return np.asarray(policy.act(obs).action)
