"""LoRA adapters over SmolVLA, chosen by session in one batch, against each one merged into a
checkpoint of its own.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
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
from vlagents_ray.serve.models.agent_copies import AgentCopies
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


@pytest.fixture(scope="module")
def adapted(made: Made, saved: dict[str, Path]) -> LeRobot:
    adapters = {name: str(saved[name]) for name in ("expert", "all", "units")}
    policy = LeRobot.from_config({"checkpoint": str(made("smolvla")), "adapters": adapters})
    policy.initialize()
    return policy


def begun_with(policy: LeRobot, number: int, adapter: str | None = None) -> LeRobot:
    session = AgentCopies(policy).make()
    session.reset(view(number), TASKS[number % len(TASKS)], seed=number, adapter=adapter)
    assert isinstance(session, LeRobot)
    return session


@pytest.fixture(scope="module")
def alone(loaded: Load, saved: dict[str, Path]) -> Callable[[str | None], LeRobot]:
    """The base, or the whole checkpoint of an adapter."""
    policies: dict[str | None, LeRobot] = {None: loaded("smolvla")}

    def load(name: str | None) -> LeRobot:
        if name not in policies:
            policies[name] = LeRobot.from_config({"checkpoint": str(saved[f"merged/{name}"])})
            policies[name].initialize()
        return policies[name]

    return load


CHOSEN = ("all", None, "expert", "units", "all", "units")


def infos(number: int) -> dict[str, Any]:
    """Return the info of a session's observation; some request samples, or continue a plan."""
    if number == 3:
        return {LEFTOVER: np.full((6, tiny.ACTION), 0.3, np.float32), DELAY: 2}
    return {SAMPLES: 3 * (number % 2)}


def test_each_row_of_one_pass_acts_as_its_adapter_merged_alone(
    adapted: LeRobot, alone: Callable[[str | None], LeRobot]
) -> None:
    sessions = [begun_with(adapted, number, name) for number, name in enumerate(CHOSEN)]
    acts = adapted.act_batch(
        [view(number, **infos(number)) for number in range(len(CHOSEN))], sessions
    )
    for number, (name, act) in enumerate(zip(CHOSEN, acts, strict=True)):
        expected = begun(alone(name), number).act(view(number, **infos(number)))
        assert isinstance(act, Act)
        np.testing.assert_allclose(act.action, expected.action, atol=ATOL)
        if DISTRIBUTION in expected.info:
            for key in ("mean", "samples"):
                np.testing.assert_allclose(
                    act.info[DISTRIBUTION][key], expected.info[DISTRIBUTION][key], atol=ATOL
                )
        if name is not None:
            of_base = begun(alone(None), number).act(view(number, **infos(number)))
            assert np.abs(of_base.action - expected.action).max() > 100 * ATOL


def test_a_learner_pushes_one_of_several_adapters(adapted: LeRobot) -> None:
    unchanged = (None, "units")
    before = [begun_with(adapted, 0, name).act(view(0)).action for name in unchanged]
    check_pushed_weights(adapted, lambda: begun_with(adapted, 0, "all").act(view(0)).action, "all/")
    for name, action in zip(unchanged, before, strict=True):
        assert np.array_equal(begun_with(adapted, 0, name).act(view(0)).action, action)


def test_types_without_a_flow_take_no_adapters(made: Made, saved: dict[str, Path]) -> None:
    policy = LeRobot.from_config(
        {"checkpoint": str(made("act")), "adapters": {"expert": str(saved["expert"])}}
    )
    with pytest.raises(
        ConfigError, match=r"adapters: expected one of LeRobot's \['pi0'.*got 'act'"
    ):
        policy.initialize()


def test_processors_of_another_kind_are_refused(
    made: Made, saved: dict[str, Path], tmp_path: Path
) -> None:
    folder = shutil.copytree(saved["expert"], tmp_path / "expert")
    file = shutil.copy(made("smolvla") / "policy_preprocessor.json", folder)
    config = {"checkpoint": str(made("smolvla")), "adapters": {"expert": str(folder)}}
    with pytest.raises(
        ConfigError,
        match=r"adapter 'expert': .*expected both .*got no .*'policy_postprocessor.json'",
    ):
        LeRobot.from_config(config).initialize()

    for file_of_base in made("smolvla").glob("policy_*"):
        shutil.copy(file_of_base, folder)
    pipeline = json.loads(Path(file).read_text())
    pipeline["steps"] = [
        step for step in pipeline["steps"] if step["registry_name"] != "to_batch_processor"
    ]
    Path(file).write_text(json.dumps(pipeline))
    with pytest.raises(
        ConfigError, match=r"adapter 'expert': .*expected the base's processors.*got other steps"
    ):
        LeRobot.from_config(config).initialize()


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

    "ten", "again" and "whole" have the contract of one dataset, "twenty" of another.
    """
    root = tmp_path_factory.mktemp("contracts")
    settings = loaded("smolvla").model.sampler.policy.config
    folders = {}
    for name in ("ten", "twenty", "again"):
        folders[name] = shutil.copytree(saved["units"], root / name)
    folders["whole"] = shutil.copytree(saved["merged/units"], root / "whole")
    write_processors(
        settings, arm(10.0).to_statistics(9), folders["ten"], folders["again"], folders["whole"]
    )
    write_processors(settings, arm(20.0).to_statistics(9), folders["twenty"])
    return folders


def served(base: Path, adapters: dict[str, Path], **config: Any) -> LeRobot:
    folders = {name: str(folder) for name, folder in adapters.items()}
    policy = LeRobot.from_config({"checkpoint": str(base), "adapters": folders, **config})
    policy.initialize()
    return policy


def test_a_base_without_a_dataset_gets_the_contract_of_its_adapters(
    made: Made, saved: dict[str, Path], with_contracts: dict[str, Path]
) -> None:
    adapters = {
        "expert": saved["expert"],
        "ten": with_contracts["ten"],
        "again": with_contracts["again"],
    }
    policy, alone = served(made("smolvla"), adapters), served(with_contracts["whole"], {})
    assert alone.contract is not None
    assert alone.contract.gripper
    assert policy.contract == alone.contract

    # The first joint is wrapped to 3.18.
    joints = np.linspace(-3.1, 3.1, tiny.STATE - 1).astype(np.float32)
    obs = Obs({"front": view(0).cameras["top"]}, 0.5, {"joints": joints})
    actions = []
    for agent, name in ((policy, "ten"), (alone, None)):
        session = AgentCopies(agent).make()
        session.reset(obs, TASKS[0], seed=1, adapter=name)
        actions.append(session.act(obs).action)
    np.testing.assert_allclose(*actions, atol=ATOL)


def test_adapters_of_different_contracts_are_refused(
    made: Made, with_contracts: dict[str, Path]
) -> None:
    with pytest.raises(
        ConfigError, match=r"adapter 'twenty': .*expected the contract and the names of cameras"
    ):
        served(made("smolvla"), {"ten": with_contracts["ten"], "twenty": with_contracts["twenty"]})
    with pytest.raises(
        ConfigError, match=r"adapter 'twenty': .*expected the contract and the names of cameras"
    ):
        served(with_contracts["whole"], {"twenty": with_contracts["twenty"]})


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
    served(base, {"units": folder})
    (folder / "config.json").write_text(json.dumps(config | change))
    with pytest.raises(ConfigError, match=f"adapter 'units': .*{says}"):
        served(base, {"units": folder})


def test_an_adapter_whose_instructions_were_other_tokens_is_refused(
    made: Made, saved: dict[str, Path], tmp_path: Path
) -> None:
    folder = shutil.copytree(saved["units"], tmp_path / "units")
    file = folder / "policy_preprocessor.json"
    pipeline = json.loads(file.read_text())
    steps = {step["registry_name"]: step for step in pipeline["steps"]}
    steps["tokenizer_processor"]["config"]["max_length"] += 1
    file.write_text(json.dumps(pipeline))
    with pytest.raises(
        ConfigError, match=r"adapter 'units': .*other settings of \['tokenizer_processor'\]"
    ):
        served(made("smolvla"), {"units": folder})
