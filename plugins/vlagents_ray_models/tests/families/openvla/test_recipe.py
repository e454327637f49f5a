"""`python -m benchmarks.checkpoints openvla` writes what the policy loads and acts with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.checkpoints import openvla as recipe
from benchmarks.checkpoints.recipe import Recipe
from benchmarks.checkpoints.recipes import write_checkpoint
from plugins.vlagents_ray_models.tests.families.openvla.conftest import LIBRARIES
from vlagents_ray.errors import ConfigError
from vlagents_ray.testing import random_observation
from vlagents_ray_models.openvla.policy import OpenVLA
from vlagents_ray_models.openvla.prismatic import find_source

pytestmark = [pytest.mark.source("OPENVLA_SRC"), *LIBRARIES]


def test_it_loads_and_acts_with_every_dimension_inside_its_range(tmp_path: Path) -> None:
    written = write_checkpoint("openvla", tmp_path / "made", "small", "float32")
    policy = OpenVLA.from_config(written.config)
    policy.initialize()
    parameters = policy.model.base.network.parameters()
    assert written.parameters == sum(parameter.numel() for parameter in parameters)

    actions = []
    for seed in range(4):
        obs = random_observation(policy.contract, seed, image_size=224)
        policy.reset(obs, "pick up the cube", seed=0)
        actions.append(np.asarray(policy.act(obs).action))
    values = np.array(actions)
    assert values.shape == (4, 1, recipe.ACTION_DIM)

    scale = policy.model.base.statistics.scale("bridge_orig")
    inside = (values > scale.low + 1e-6) & (values < scale.high - 1e-6)
    # The values of other tokens than actions would all be at an end of the range.
    assert inside[..., scale.mask].mean() > 0.5
    assert len(np.unique(values, axis=0)) > 1


@pytest.mark.verifies("size")
def test_the_full_size_is_the_published_one(tmp_path: Path) -> None:
    model, _ = recipe.make_model(Recipe("openvla", tmp_path, "full", "bfloat16"), find_source(None))
    # Its files have 15.1 GB.
    parameters = sum(parameter.numel() for parameter in model.parameters())
    assert parameters == pytest.approx(7.54e9, rel=0.01)


def test_the_models_code_must_be_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("OPENVLA_SRC", "OPENVLA_OFT_SRC"):
        monkeypatch.delenv(variable, raising=False)
    with pytest.raises(ConfigError, match="OPENVLA_SRC"):
        write_checkpoint("openvla", tmp_path / "made", "small")
    assert list(tmp_path.iterdir()) == []
