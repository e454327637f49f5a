"""A LoRA adapter over transformers' π0 that is merged when the policy loads."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from adapted_network import merge, pairs, save
from pushed_weights import check_pushed_weights

from plugins.vlagents_ray_models.tests.families.pi0.conftest import WORDS, made, seen
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.loading import LoadingReport
from vlagents_ray_models.pi0 import Pi0

ATOL = 1e-4  # of actions of size 1, which ten steps of a flow and the merged sums round differently
TARGETS = (
    r".*\.(q_proj|v_proj|down_proj|fc1|fc2|patch_embedding|linear)|action_.*|embed_action_time\..*"
)
ROWS = 3


@pytest.fixture(scope="module")
def saved(
    folder: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, dict[str, np.ndarray]]:
    """The folder and the values of an adapter."""
    network = made(folder).model.network
    adaptable = (torch.nn.Linear, torch.nn.Conv2d)
    layers = {}
    for name, module in network.named_modules():
        if type(module) in adaptable and re.fullmatch(TARGETS, name):
            layers[name] = module
    assert {type(module) for module in layers.values()} == set(adaptable)

    values = {key: 0.3 * value for key, value in pairs(network, list(layers), 4).items()}
    return save(tmp_path_factory.mktemp("adapters") / "own", values), values


def begun(policy: Pi0, seed: int) -> Pi0:
    session = AgentCopies(policy).make()
    session.reset(seen(seed), WORDS[seed % len(WORDS)], seed=seed)
    assert isinstance(session, Pi0)
    return session


def acts_of(policy: Pi0) -> list[Act]:
    """Return the first answers of several sessions in one batch, one of them with samples."""
    views = [seen(seed, **{SAMPLES: 3 * (seed % 2)}) for seed in range(ROWS)]
    acts = []
    for act in policy.act_batch(views, [begun(policy, seed) for seed in range(ROWS)]):
        assert isinstance(act, Act)
        acts.append(act)
    return acts


@pytest.mark.parametrize("config", [{}, {"compile": True, "batch_sizes": [1, 6]}])
def test_the_policy_acts_as_its_base_with_merged_weights(
    folder: Path, saved: tuple[Path, dict[str, np.ndarray]], config: dict[str, Any]
) -> None:
    adapter, values = saved
    base, merged = made(folder), made(folder)
    merge(merged.model.network, values)
    for act, expected, of_base in zip(
        acts_of(made(folder, adapter=str(adapter), **config)),
        acts_of(merged),
        acts_of(base),
        strict=True,
    ):
        np.testing.assert_allclose(act.action, expected.action, atol=ATOL)
        if DISTRIBUTION in expected.info:
            np.testing.assert_allclose(
                act.info[DISTRIBUTION]["samples"], expected.info[DISTRIBUTION]["samples"], atol=ATOL
            )
        assert np.abs(expected.action - of_base.action).max() > 100 * ATOL


def test_products_of_a_network_with_an_adapter_are_merged_on_a_gpu(
    folder: Path,
    saved: tuple[Path, dict[str, np.ndarray]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    expected = [act.action for act in acts_of(made(folder, adapter=str(saved[0])))]
    monkeypatch.setattr(LoadingReport, "accelerated", True)
    monkeypatch.setattr(Pi0, "_warm_up", lambda _, **__: None)
    policy = made(folder, adapter=str(saved[0]))
    attention = policy.loaded().network.model.vlm.language_model.layers[0].self_attn
    memory = attention.q_proj.weight.untyped_storage()
    assert memory.data_ptr() == attention.k_proj.weight.untyped_storage().data_ptr()
    actions = [act.action for act in acts_of(policy)]
    np.testing.assert_allclose(actions, expected, atol=ATOL)


def test_a_learner_pushes_whole_layers(
    folder: Path, saved: tuple[Path, dict[str, np.ndarray]]
) -> None:
    policy = made(folder, adapter=str(saved[0]))
    check_pushed_weights(policy, lambda: begun(policy, 0).act(seen(0)).action)


def test_statistics_of_the_adapter_replace_those_of_the_base(
    folder: Path, saved: tuple[Path, dict[str, np.ndarray]], tmp_path: Path
) -> None:
    adapter = shutil.copytree(saved[0], tmp_path / "own")
    of_base = begun(made(folder, adapter=str(adapter)), 0).act(seen(0)).action

    processor = json.loads((folder / "processor_config.json").read_text())
    mean = [value + 1 for value in processor["actions_mean"]]
    file = adapter / "processor_config.json"
    file.write_text(json.dumps({"actions_mean": mean, "state_mean": None}))
    shifted = begun(made(folder, adapter=str(adapter)), 0).act(seen(0)).action
    np.testing.assert_allclose(shifted, of_base + 1, atol=ATOL)

    whole = shutil.copytree(folder, tmp_path / "whole")
    processor["state_mean"][0] += 1
    for path in (file, whole / "processor_config.json"):
        path.write_text(json.dumps(processor))
    got = begun(made(folder, adapter=str(adapter)), 0).act(seen(0)).action
    merged = made(whole)
    merge(merged.model.network, saved[1])
    np.testing.assert_allclose(got, begun(merged, 0).act(seen(0)).action, atol=ATOL)

    file.write_text("[3]")
    with pytest.raises(ConfigError, match="is no processor's config"):
        made(folder, adapter=str(adapter))
