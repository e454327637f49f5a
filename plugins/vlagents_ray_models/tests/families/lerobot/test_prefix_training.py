"""A SmolVLA whose training is continued with given rows by `examples/learn/prefixes.py`, on a
dataset of an evaluation, and is then served.
"""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import typer
from in_process_evaluation import flat_config, play
from lerobot.configs.policies import PreTrainedConfig
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.datasets.utils import dataset_to_policy_features
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from wrist_roll_env import ROLLER, Roller, Turner

from plugins.vlagents_ray_models.tests.families.lerobot import tiny
from vlagents_ray.dataset_contract import INFO
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import DELAY, GIVEN, LEFTOVER, Act, Obs
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray_models.lerobot import LeRobot
from vlagents_ray_results.lerobot import to_lerobot

LONGEST = 3
EXAMPLE = SimpleNamespace(
    **runpy.run_path(str(Path(__file__).parents[5] / "examples/learn/prefixes.py"))
)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recorded")
    run = flat_config(envs=[ROLLER], episodes=2, record="all", video="none", out=folder / "out")
    chosen: dict[str, Any] = {"cameras": ["base"], "state": ["xyzrpy", "gripper", "joints"]}
    to_lerobot(play(run, Turner), folder / "roller", **chosen)
    return folder / "roller"


@pytest.fixture(scope="module")
def first(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny SmolVLA with the features and the statistics of the dataset."""
    folder = tmp_path_factory.mktemp("smolvla")
    meta = LeRobotDataset("local/data", root=dataset).meta
    features = dataset_to_policy_features(meta.features)
    inputs = {
        key: feature
        for key, feature in features.items()
        if key == "observation.state" or key.startswith("observation.images.")
    }
    config = tiny.smolvla(
        folder, input_features=inputs, output_features={"action": features["action"]}
    )
    torch.manual_seed(0)
    policy = get_policy_class("smolvla")(config)
    policy.save_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=meta.stats):
        pipeline.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def trained(first: Path, dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("trained") / "smolvla"
    EXAMPLE.main(first, dataset, out, longest=LONGEST, steps=3, batch_size=4)
    return out


def served(checkpoint: Path, **settings: Any) -> LeRobot:
    config = {"checkpoint": str(checkpoint), "device": "cpu", "execute": tiny.CHUNK, **settings}
    policy = LeRobot.from_config(config)
    policy.initialize()
    return policy


def act(policy: LeRobot, obs: Obs, **info: Any) -> Act:
    session = AgentCopies(policy).make()
    session.reset(obs, "turn", seed=0)
    return session.act(Obs(obs.cameras, obs.gripper, obs.state, info=info))


def test_chunks_of_the_served_policy_begin_with_the_given_rows(trained: Path, first: Path) -> None:
    policy = served(trained, longest_prefix=LONGEST)
    assert policy.longest_prefix == LONGEST
    obs, _ = Roller().reset(seed=0)
    plan = np.random.default_rng(0).uniform(-1, 1, (6, 2)).astype(np.float32)
    plan[:, 1] = 1.0  # the gripper of all demonstrations
    free = act(policy, obs).action
    for delay, count in ((2, 2), (5, LONGEST)):
        answer = act(policy, obs, **{LEFTOVER: plan, DELAY: delay})
        assert answer.info[GIVEN] == count
        np.testing.assert_allclose(answer.action[:count], plan[:count], atol=1e-5)
        assert not np.allclose(answer.action[count:], free[count:], atol=1e-6)

    without = act(policy, obs, **{LEFTOVER: plan, DELAY: 0})
    assert GIVEN not in without.info
    np.testing.assert_array_equal(without.action, free)
    # The training has changed the weights.
    assert not np.allclose(act(served(first), obs).action, free, atol=1e-6)


def test_only_rows_that_are_neither_given_nor_padding_are_learned(
    first: Path, dataset: Path
) -> None:
    settings = PreTrainedConfig.from_pretrained(first)
    policy = get_policy_class("smolvla").from_pretrained(first, config=settings)
    EXAMPLE.accept_times_of_rows(policy.model)
    preprocess, _ = make_pre_post_processors(settings, pretrained_path=str(first))
    chunks = EXAMPLE.chunks_of(dataset, tiny.CHUNK)
    batch = preprocess(next(EXAMPLE.batches(chunks, 4, seed=0)))

    def loss(*given_rows: int, padding: tuple[int, ...] = ()) -> float:
        is_given = torch.zeros(4, tiny.CHUNK, 1, dtype=torch.bool)
        is_given[:, list(given_rows)] = True
        is_pad = torch.zeros(4, tiny.CHUNK, dtype=torch.bool)
        is_pad[:, list(padding)] = True
        torch.manual_seed(0)
        with torch.no_grad():
            return float(EXAMPLE.loss_of(policy, {**batch, "action_is_pad": is_pad}, is_given))

    # Without given rows, it is LeRobot's loss.
    torch.manual_seed(0)
    with torch.no_grad():
        tokens = [batch[f"observation.language.{name}"] for name in ("tokens", "attention_mask")]
        images = policy.prepare_images(batch)
        state, actions = policy.prepare_state(batch), policy.prepare_action(batch)
        theirs = policy.model.forward(*images, *tokens, state, actions)[..., :2]
    np.testing.assert_allclose(loss(), theirs.mean(), rtol=1e-5)
    np.testing.assert_allclose(loss(padding=(6, 7)), theirs[:, :6].mean(), rtol=1e-5)
    # Given rows are inputs, which change the velocity of the other rows.
    assert loss(0, 1) != pytest.approx(float(theirs[:, 2:].mean()), rel=1e-5)
    assert loss(*range(tiny.CHUNK)) == 0


@pytest.mark.parametrize("kind", ["act", "diffusion"])
def test_other_types_read_no_given_rows(kind: str, made: Any) -> None:
    with pytest.raises(ConfigError, match="longest_prefix: expected LeRobot's 'smolvla'"):
        served(made(kind), longest_prefix=LONGEST)


def test_a_dataset_without_a_contract_is_rejected(dataset: Path, tmp_path: Path) -> None:
    meta = LeRobotDataset("local/data", root=dataset).meta
    info = {key: value for key, value in meta.info.items() if key != INFO}
    features = {"action": {"shape": (2,)}}
    unknown = SimpleNamespace(root=tmp_path, meta=SimpleNamespace(info=info, features=features))
    with pytest.raises(typer.BadParameter, match="which columns of its actions are relative"):
        EXAMPLE.columns_of(unknown)
