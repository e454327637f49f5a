"""openpi's PyTorch port, where transformers is patched as openpi wants it; without that it is refused."""

from __future__ import annotations

import copy
import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from tests.families.openpi.marks import MARKS
from tests.families.openpi.test_openpi import BATCHED, WORDS, begun, seen, theirs
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DELAY, LEFTOVER
from vlagents_ray.policies.openpi import OpenPi

pytestmark = MARKS
PATCHED = all(importlib.util.find_spec(name) for name in ("transformers", "transformers.models.siglip.check"))
patched = pytest.mark.skipif(
    not PATCHED, reason="transformers is not patched by openpi's models_pytorch/transformers_replace"
)


@pytest.fixture(scope="module")
def port(tiny: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A checkpoint of the port, small by the same means as the JAX one."""
    return tiny.save_torch(tmp_path_factory.mktemp("torch"))


def made(folder: Path, **settings: Any) -> OpenPi:
    config = {"checkpoint": str(folder), "config": "tests.families.openpi.tiny:PI0", "steps": 3, **settings}
    policy = OpenPi.from_config(config)
    policy.initialize()
    return policy


@patched
def test_actions_are_those_of_openpis_own_policy_alone_and_in_company(port: Path, tiny: ModuleType) -> None:
    import torch
    from openpi.policies.policy import Policy

    policy = made(port)
    transforms = policy.model.transforms
    upstream = Policy(
        policy.model.model._network,
        transforms=transforms.inputs.transforms,
        output_transforms=transforms.outputs.transforms,
        sample_kwargs={"num_steps": 3},
        is_pytorch=True,
    )
    acts = policy.act_batch([seen("pi0", i) for i in range(3)], [begun(policy, "pi0", i) for i in range(3)])
    for i, act in enumerate(acts):
        noise = np.random.default_rng([0, i]).standard_normal((8, 32), dtype=np.float32)
        with torch.inference_mode():
            want = upstream.infer({**theirs("pi0", i), "prompt": WORDS[i]}, noise=noise)["actions"]
        np.testing.assert_allclose(act.action, want, atol=10 * BATCHED)


@patched
def test_frozen_rows_come_back_as_planned(port: Path) -> None:
    policy = made(port)
    plan = begun(policy, "pi0", 1).act(seen("pi0", 1)).action[1:]
    guided = begun(policy, "pi0", 0).act(seen("pi0", 0, **{LEFTOVER: plan, DELAY: 2})).action
    np.testing.assert_allclose(guided[:2], plan[:2], atol=1e-4)
    again = copy.copy(policy)  # what guided one call is gone with it
    again.reset(seen("pi0", 0), WORDS[0], seed=0)
    assert np.abs(again.act(seen("pi0", 0)).action[:2] - plan[:2]).max() > 0.01


@patched
def test_a_lost_tensor_is_an_error(port: Path, tmp_path: Path, tiny: ModuleType) -> None:
    from safetensors.torch import load_file, save_file

    tensors = load_file(port / "model.safetensors")
    del tensors["action_out_proj.bias"]
    save_file(tensors, tmp_path / "model.safetensors")
    tiny.save_statistics(tmp_path, "pi0")
    with pytest.raises(ConfigError, match=r"action_out_proj\.bias"):
        made(tmp_path)


@pytest.mark.skipif(PATCHED, reason="transformers is patched here")
def test_transformers_as_it_is_is_refused_with_the_cure(tmp_path: Path, tiny: ModuleType) -> None:
    tiny.save_statistics(tmp_path, "pi0")
    (tmp_path / "model.safetensors").touch()
    with pytest.raises(ConfigError, match="transformers_replace"):
        made(tmp_path)
