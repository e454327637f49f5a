"""LoRA adapters over OpenVLA, as PEFT trains and saves them, against each one merged into its
base by PEFT.
"""

from __future__ import annotations

import json
import shutil
import threading
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from peft import LoraConfig, PeftModel, get_peft_model

from plugins.vlagents_ray_models.tests.families.openvla.conftest import LIBRARIES, WORDS, seen
from plugins.vlagents_ray_models.tests.families.openvla.upstream import module
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.serve.weights import ModelWeights, PushOptions
from vlagents_ray_models.openvla.policy import OpenVLA

pytestmark = [pytest.mark.source("OPENVLA_SRC"), *LIBRARIES]

ATOL = 1e-4  # atol of means of actions of size 1
ROWS = 3


@pytest.fixture(scope="module")
def saved(
    checkpoint: Callable[[str], Path], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Folders of adapters by name, and of whole checkpoints by "merged/NAME"; the adapter "second"
    was trained on another dataset.
    """
    root, folders = tmp_path_factory.mktemp("adapters"), {}
    cls = module("OPENVLA_SRC", "extern.hf.modeling_prismatic").OpenVLAForActionPrediction
    for seed, (name, rank) in enumerate((("first", 4), ("second", 8))):
        torch.manual_seed(seed)
        network = cls.from_pretrained(checkpoint("openvla"))
        # As in OpenVLA's vla-scripts/finetune.py, but the initial weights are not zero.
        config = LoraConfig(
            r=rank,
            lora_alpha=min(rank, 16),
            lora_dropout=0.0,
            target_modules="all-linear",
            init_lora_weights=False,
        )
        trained = get_peft_model(network, config)
        folders[name] = root / name
        # PEFT warns that it also saves the base's last layer, since that has an adapter.
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Setting `save_embedding_layers`", UserWarning)
            trained.save_pretrained(folders[name])
        whole = folders[f"merged/{name}"] = shutil.copytree(
            checkpoint("openvla"), root / f"merged-{name}"
        )
        trained.merge_and_unload().save_pretrained(whole)
        if name == "second":
            datasets = json.loads((whole / "dataset_statistics.json").read_text())
            for folder in (folders[name], whole):
                statistics = {"own_dataset": datasets["libero_spatial_no_noops"]}
                (folder / "dataset_statistics.json").write_text(json.dumps(statistics))
    return folders


def load(folder: Path, **config: Any) -> OpenVLA:
    policy = OpenVLA.from_config({"checkpoint": str(folder), "unnorm_key": "bridge_orig"} | config)
    policy.initialize()
    return policy


def begun(policy: OpenVLA, seed: int) -> OpenVLA:
    session = AgentCopies(policy).make()
    session.reset(seen(seed), WORDS[seed % len(WORDS)], seed=seed)
    assert isinstance(session, OpenVLA)
    return session


@pytest.mark.parametrize(("name", "unnorm_key"), [("first", "bridge_orig"), ("second", None)])
def test_the_policy_acts_as_the_checkpoint_that_peft_merged(
    checkpoint: Callable[[str], Path], saved: dict[str, Path], name: str, unnorm_key: str | None
) -> None:
    policy = load(checkpoint("openvla"), adapter=str(saved[name]), unnorm_key=unnorm_key)
    merged, base = load(saved[f"merged/{name}"], unnorm_key=unnorm_key), load(checkpoint("openvla"))
    views = [seen(seed, **{SAMPLES: 2 * seed}) for seed in range(ROWS)]
    acts = policy.act_batch(views, [begun(policy, seed) for seed in range(ROWS)])
    for seed, act in enumerate(acts):
        expected = begun(merged, seed).act(views[seed])
        assert isinstance(act, Act)
        assert np.array_equal(act.action, expected.action)  # the same tokens
        if seed:
            distribution = act.info[DISTRIBUTION]
            expected_distribution = expected.info[DISTRIBUTION]
            for moment in ("mean", "std"):
                np.testing.assert_allclose(
                    distribution[moment], expected_distribution[moment], atol=ATOL
                )
            assert np.array_equal(distribution["samples"], expected_distribution["samples"])
        assert not np.array_equal(expected.action, begun(base, seed).act(views[seed]).action)


def test_a_learner_pushes_the_layers_alone_that_its_adapters_change(
    checkpoint: Callable[[str], Path], saved: dict[str, Path]
) -> None:
    policy = load(checkpoint("openvla"))
    modeling = module("OPENVLA_SRC", "extern.hf.modeling_prismatic")
    network = modeling.OpenVLAForActionPrediction.from_pretrained(checkpoint("openvla"))
    trained = PeftModel.from_pretrained(network, saved["first"])
    trained.merge_adapter()
    pushed = {}
    for peft_name, tensor in trained.state_dict().items():
        if peft_name.endswith(".base_layer.weight"):
            name = peft_name.removeprefix("base_model.model.").replace(".base_layer", "")
            pushed[name] = tensor

    weights, options = ModelWeights(policy, threading.Lock()), PushOptions(partial=True)
    weights.stage(1, pushed, options)
    weights.commit(1, options, list)
    weights.use(weights.newest)

    act = begun(policy, 1).act(seen(1, **{SAMPLES: 2}))
    expected = begun(load(saved["merged/first"]), 1).act(seen(1, **{SAMPLES: 2}))
    assert np.array_equal(act.action, expected.action)
    np.testing.assert_allclose(
        act.info[DISTRIBUTION]["mean"], expected.info[DISTRIBUTION]["mean"], atol=ATOL
    )
    assert len(pushed) < len(policy.parameters())


def test_statistics_of_the_adapter_replace_those_of_the_base(
    checkpoint: Callable[[str], Path], saved: dict[str, Path]
) -> None:
    folder = shutil.copytree(saved["first"], saved["first"].parent / "short")
    (folder / "dataset_statistics.json").write_text(
        json.dumps({"d": {"action": {"q01": [0.0], "q99": [1.0]}}})
    )
    policy = load(checkpoint("openvla"), adapter=str(folder), unnorm_key=None)
    assert begun(policy, 0).act(seen(0)).action.shape[-1] == 1
    with pytest.raises(ConfigError, match=r"unnorm_key: expected one of .*\['d'\]"):
        load(checkpoint("openvla"), adapter=str(folder))
