"""LoRA adapters over LeRobot's policies, each against the checkpoint into which it was merged."""

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
from lerobot.policies.factory import make_pre_post_processors
from pushed_weights import check_pushed_weights

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from plugins.vlagents_ray_models.tests.families.lerobot.conftest import (
    FILTERS,
    TASKS,
    Load,
    Made,
    begun,
    view,
)
from vlagents_ray import Obs
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.dataset_contract import DatasetContract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DELAY, DISTRIBUTION, LEFTOVER, SAMPLES, Act
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray_models.lerobot import LeRobot

pytestmark = FILTERS

# Of actions of size 1, which four steps of a flow and the merged sums round differently.
ATOL = 1e-4
# LeRobot's own targets for SmolVLA, then some of the language model and the cameras' encoder
TARGETS = r"model\.vlm_with_expert\.lm_expert\..*\.(q|v)_proj|model\.(state_proj|action_(in|out)_proj|action_time_mlp_\w+)"
SEEING = r"model\.vlm_with_expert\.vlm\.model\.(text_model|vision_model)\..*\.(q_proj|o_proj|out_proj|down_proj|fc1)"


def layers(network: Any, pattern: str) -> list[str]:
    """Return the names of the linear layers that a pattern matches."""
    names = []
    for name, module in network.named_modules():
        if type(module) is torch.nn.Linear and re.fullmatch(pattern, name):
            names.append(name)
    assert len(names) > 3
    return names


@pytest.fixture(scope="module")
def saved(made: Made, loaded: Load, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Folders of adapters by name, and of whole checkpoints by "merged/NAME"; the adapter "units"
    was trained with other statistics.
    """
    root, folders = tmp_path_factory.mktemp("adapters"), {}
    network = loaded("smolvla").model.sampler.policy
    adapters = [("expert", TARGETS, 4), ("all", f"{TARGETS}|{SEEING}", 2), ("units", TARGETS, 8)]
    for seed, (name, pattern, rank) in enumerate(adapters):
        random_values = pairs(network, layers(network, pattern), rank, seed)
        values = {key: 0.3 * value for key, value in random_values.items()}
        folders[name] = save(root / name, values)
        whole = shutil.copytree(made("smolvla"), root / f"merged-{name}")
        merged = LeRobot.from_config({"checkpoint": str(whole)})
        merged.initialize()
        policy = merged.model.sampler.policy
        merge(policy, values)
        policy.save_pretrained(whole)
        if name == "units":
            write_processors(policy.config, {}, whole, folders[name])
        folders[f"merged/{name}"] = whole
    return folders


def write_processors(settings: Any, further: dict[str, Any], *folders: Path) -> None:
    """Write the processors of a training on another dataset than the base's.

    Its statistics are those of its features, and `further` ones.
    """
    dataset = {}
    for key, statistics in tiny.statistics().items():
        dataset[key] = {name: 2 * value + 0.5 for name, value in statistics.items()}
    for pipeline in make_pre_post_processors(settings, dataset_stats=dataset | further):
        for folder in folders:
            pipeline.save_pretrained(folder)


def with_adapter(base: Path, adapter: Path | None, **config: Any) -> LeRobot:
    settings = {} if adapter is None else {"adapter": str(adapter)}
    policy = LeRobot.from_config({"checkpoint": str(base), **settings, **config})
    policy.initialize()
    return policy


ROWS = 4


def infos(number: int) -> dict[str, Any]:
    """Return the info of a session's observation; some request samples, or continue a plan."""
    if number == 3:
        return {LEFTOVER: np.full((6, tiny.ACTION), 0.3, np.float32), DELAY: 2}
    return {SAMPLES: 3 * (number % 2)}


@pytest.mark.parametrize("name", ["expert", "all", "units"])
def test_the_policy_acts_as_the_merged_checkpoint(
    made: Made, loaded: Load, saved: dict[str, Path], name: str
) -> None:
    policy = with_adapter(made("smolvla"), saved[name])
    merged = with_adapter(saved[f"merged/{name}"], None)
    sessions = [begun(policy, number) for number in range(ROWS)]
    acts = policy.act_batch([view(number, **infos(number)) for number in range(ROWS)], sessions)
    for number, act in enumerate(acts):
        expected = begun(merged, number).act(view(number, **infos(number)))
        assert isinstance(act, Act)
        np.testing.assert_allclose(act.action, expected.action, atol=ATOL)
        if DISTRIBUTION in expected.info:
            for key in ("mean", "samples"):
                np.testing.assert_allclose(
                    act.info[DISTRIBUTION][key], expected.info[DISTRIBUTION][key], atol=ATOL
                )
        of_base = begun(loaded("smolvla"), number).act(view(number, **infos(number)))
        assert np.abs(of_base.action - expected.action).max() > 100 * ATOL


def test_a_learner_pushes_whole_layers(made: Made, saved: dict[str, Path]) -> None:
    policy = with_adapter(made("smolvla"), saved["all"])
    check_pushed_weights(policy, lambda: begun(policy, 0).act(view(0)).action)


def test_types_without_a_flow_also_accept_an_adapter(
    made: Made, loaded: Load, tmp_path: Path
) -> None:
    network = loaded("act").model.sampler.policy
    values = pairs(network, layers(network, r"model\..*\.linear\d"), 4)
    policy = with_adapter(made("act"), save(tmp_path / "act", values))
    merged = with_adapter(made("act"), None)
    merge(merged.model.sampler.policy, values)
    got, expected, of_base = (
        begun(agent, 0).act(view(0)).action for agent in (policy, merged, loaded("act"))
    )
    np.testing.assert_allclose(got, expected, atol=ATOL)
    assert np.abs(of_base - expected).max() > 100 * ATOL


def test_one_processor_alone_is_rejected(
    made: Made, saved: dict[str, Path], tmp_path: Path
) -> None:
    folder = shutil.copytree(saved["expert"], tmp_path / "expert")
    shutil.copy(made("smolvla") / "policy_preprocessor.json", folder)
    with pytest.raises(ConfigError, match=r"expected both .*got no .*'policy_postprocessor.json'"):
        with_adapter(made("smolvla"), folder)


def arm(control_hz: float) -> DatasetContract:
    """Return the contract of a dataset whose first joint is near a half turn."""
    contract = Contract(
        state={"joints": StateSpec(tiny.STATE - 1)},
        gripper=True,
        action=ActionSpec(dim=tiny.ACTION, space="joints", delta=False),
        control_hz=control_hz,
    )
    return DatasetContract(
        contract, ("joints", "gripper"), {"observation.images.top": "front"}, {0: 3.0}
    )


@pytest.fixture(scope="module")
def with_contracts(
    saved: dict[str, Path], loaded: Load, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Folders of the adapter "units" with the contract of a dataset, and of "whole", the adapter
    merged into its base.

    "ten" and "whole" have the contract of one dataset, "twenty" of another.
    """
    root = tmp_path_factory.mktemp("contracts")
    settings = loaded("smolvla").model.sampler.policy.config
    folders = {}
    for name in ("ten", "twenty"):
        folders[name] = shutil.copytree(saved["units"], root / name)
    folders["whole"] = shutil.copytree(saved["merged/units"], root / "whole")
    write_processors(settings, arm(10.0).to_statistics(9), folders["ten"], folders["whole"])
    write_processors(settings, arm(20.0).to_statistics(9), folders["twenty"])
    return folders


def test_the_contract_is_that_of_the_adapters_dataset(
    made: Made, with_contracts: dict[str, Path]
) -> None:
    policy = with_adapter(made("smolvla"), with_contracts["ten"])
    merged = with_adapter(with_contracts["whole"], None)
    assert merged.contract is not None
    assert merged.contract.gripper
    assert policy.contract == merged.contract

    # The first joint is wrapped to 3.18.
    joints = np.linspace(-3.1, 3.1, tiny.STATE - 1).astype(np.float32)
    obs = Obs({"front": view(0).cameras["top"]}, 0.5, {"joints": joints})
    actions = []
    for agent in (policy, merged):
        session = AgentCopies(agent).make()
        session.reset(obs, TASKS[0], seed=1)
        actions.append(session.act(obs).action)
    np.testing.assert_allclose(*actions, atol=ATOL)

    other = with_adapter(with_contracts["whole"], with_contracts["twenty"])
    assert other.contract is not None
    assert other.contract.control_hz == 20.0


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            {"chunk_size": 7},
            r"expected an adapter trained with {'chunk_size': 8}, as the base, got {'chunk_size': 7}",
        ),
        (
            {
                "input_features": {
                    "observation.images.side": {"type": "VISUAL", "shape": [3, 64, 64]}
                }
            },
            "cameras.*side",
        ),
        ({"input_features": [3]}, "is no config of a LeRobot policy"),
    ],
)
def test_an_adapter_that_was_trained_with_another_network_is_refused(
    made: Made, saved: dict[str, Path], tmp_path: Path, change: dict[str, Any], says: str
) -> None:
    base = made("smolvla")
    folder = shutil.copytree(saved["units"], tmp_path / "units")
    config = json.loads((base / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps(config))
    with_adapter(base, folder)
    (folder / "config.json").write_text(json.dumps(config | change))
    with pytest.raises(ConfigError, match=says):
        with_adapter(base, folder)
