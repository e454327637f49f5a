"""From an evaluation's recordings to a served policy, with LeRobot's own command between them."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from in_process_evaluation import flat_config, play
from recorded_sessions import recorded
from safetensors.torch import load_file, save_file
from typer.testing import CliRunner
from wrist_roll_env import ROLLER, Roller, Turner

from vlagents_ray.cli.main import app
from vlagents_ray.contract import Contract, StateSpec, require_match
from vlagents_ray.dataset_contract import BYTES, STATISTICS, DatasetContract
from vlagents_ray.envs import make_env
from vlagents_ray.interface import Act, Obs
from vlagents_ray.overrides import parse_settings
from vlagents_ray.policies.agent_copies import AgentCopies
from vlagents_ray.policies.scripted import Scripted
from vlagents_ray.robot.record import Recorder
from vlagents_ray_models.lerobot import LeRobot
from vlagents_ray_results.lerobot import to_lerobot

STEPS = 10
IMAGES, STATE_ALONE = 0, 1  # in the order of the page
TINY = [
    "dim_model=32",
    "n_heads=2",
    "dim_feedforward=64",
    "n_encoder_layers=1",
    "chunk_size=8",
    "n_action_steps=4",
]


def documented(command: str) -> list[list[str]]:
    """The words of each such command in the tutorial about training, then in the example, without
    the command itself.
    """
    root = Path(__file__).parents[5]
    text = "".join(
        (root / name).read_text()
        for name in ("docs/tutorials/fine_tune.md", "examples/train_and_watch.sh")
    )
    found = re.findall(rf"^{re.escape(command)} ((?:.*\\\n)*.*)$", text, re.MULTILINE)
    return [shlex.split(re.sub(r" >.*", "", words.replace("\\\n", " "))) for words in found]


def train(dataset: Path, out: Path, route: int = IMAGES) -> Path:
    """The documented training, but ten steps of a tiny ACT; returns the folder of the
    checkpoint.
    """
    own = [
        f"--dataset.root={dataset}",
        f"--output_dir={out}",
        f"--steps={STEPS}",
        f"--save_freq={STEPS}",
    ]
    small = [
        *(f"--policy.{word}" for word in TINY),
        "--policy.device=cpu",
        "--batch_size=2",
        "--num_workers=1",
    ]
    changed = {word.partition("=")[0] for word in [*own, *small]}
    kept = [
        word
        for word in documented(".venv-lerobot/bin/lerobot-train")[route]
        if word.partition("=")[0] not in changed
    ]
    done = subprocess.run(
        [str(Path(sys.executable).parent / "lerobot-train"), *kept, *own, *small],
        env={**os.environ, "HF_HUB_OFFLINE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return out / f"checkpoints/{STEPS:06d}/pretrained_model"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of an env with 32 x 48 pixels, and a roll that jumps from pi to -pi."""
    folder = tmp_path_factory.mktemp("recorded")
    results = play(
        flat_config(envs=[ROLLER], episodes=4, record="all", video="none", out=folder / "out"),
        Turner,
    )
    chosen: dict[str, Any] = {"cameras": ["base"], "state": ["xyzrpy", "gripper", "joints"]}
    assert to_lerobot(results, folder / "roller", **chosen, successes=True, cut_idle=True) == 2
    return folder / "roller"


@pytest.fixture(scope="module")
def checkpoint(dataset: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Ten steps, after which the dataset is gone: what a robot's machine has."""
    made = train(dataset, tmp_path_factory.mktemp("trained") / "act")
    shutil.rmtree(dataset)
    return made


@pytest.fixture(scope="module")
def policy(checkpoint: Path) -> LeRobot:
    return served(checkpoint)


def served(checkpoint: Path, **settings: Any) -> LeRobot:
    policy = LeRobot.from_config({"checkpoint": str(checkpoint), "device": "cpu", **settings})
    policy.initialize()
    return policy


def test_a_policy_of_lerobots_own_command_is_served_without_settings(policy: LeRobot) -> None:
    env = Roller()
    obs, _ = env.reset(seed=0)
    session = AgentCopies(policy).make()
    session.reset(obs, env.instruction, seed=0)
    action = session.act(obs).action
    assert action.shape[-1] == 2
    assert np.isfinite(action).all()


@pytest.mark.parametrize("route", [IMAGES, STATE_ALONE])
def test_the_documented_commands_lead_from_recordings_to_a_policy_that_acts(
    route: int, tmp_path: Path
) -> None:
    record, *evaluations = documented("vlagents-ray eval")
    watched = [words for words in evaluations if "--watch" in words]
    task, options = record[0], settings_of(record, "--env-set")
    run = flat_config(
        envs=[task],
        env_options=options,
        episodes=2,
        record="all",
        video="none",
        out=tmp_path / "run",
    )
    play(run, Scripted)
    _, _, _, *chosen = documented("vlagents-ray export")[route]
    exported = CliRunner().invoke(
        app, ["export", str(tmp_path / "run"), "--out", str(tmp_path / "dataset"), *chosen]
    )
    assert exported.exit_code == 0, exported.output
    policy = served(train(tmp_path / "dataset", tmp_path / "act", route))
    assert watched[route][0] == task
    env = make_env(task, **settings_of(watched[route], "--env-set"))
    assert policy.contract is not None
    require_match(policy.contract, env.contract)
    assert (set(policy.contract.cameras or {}) == set()) == (route == STATE_ALONE)
    assert ("puck" in (policy.contract.state or {})) == (route == STATE_ALONE)
    obs, _ = env.reset(seed=0)
    session = AgentCopies(policy).make()
    session.reset(obs, env.instruction, seed=0)
    for _ in range(3):
        for row in np.atleast_2d(session.act(obs).action):
            obs, *_ = env.step(Act(row))


def settings_of(words: list[str], option: str) -> dict[str, Any]:
    return parse_settings([value for name, value in pairwise(words) if name == option], option)


def test_a_server_records_what_lerobot_trains_on_and_the_policy_is_replayed_on(
    tmp_path: Path,
) -> None:
    with recorded(tmp_path / "traces") as server:
        for seed in range(2):
            server.robot().play(8, seed=seed)
    [root] = (tmp_path / "traces").iterdir()
    checkpoint = train(root, tmp_path / "act")
    other = replayed(root, checkpoint, tmp_path / "other")
    assert (other["frames"], len(other["by_step"])) == (16, 4)
    assert 0 < other["mae"] < np.inf
    with recorded(
        tmp_path / "own", LeRobot.from_config({"checkpoint": str(checkpoint), "device": "cpu"})
    ) as server:
        server.robot().play(8, seed=0)  # one session, so that no batch rounds differently
    same = replayed(tmp_path / "own", checkpoint, tmp_path / "same")
    assert (same["frames"], same["max"]) == (8, 0.0)


def replayed(dataset: Path, checkpoint: Path, out: Path) -> dict[str, Any]:
    """What the command writes about the checkpoint."""
    out.mkdir()
    file = deployment(checkpoint, out)
    given = ["open-loop", str(dataset), "--policy", str(file), "--out", str(out)]
    done = CliRunner().invoke(app, given)
    assert done.exit_code == 0, done.output
    found: dict[str, Any] = json.loads((out / "open_loop.json").read_text())
    return found


def deployment(checkpoint: Path, folder: Path) -> Path:
    """The file of a server of the checkpoint."""
    config = {"checkpoint": str(checkpoint), "device": "cpu"}
    args = {"policy": "lerobot", "config": config}
    application = {
        "name": "act",
        "route_prefix": "/",
        "import_path": "vlagents_ray.serve.app:build",
        "args": args,
    }
    path = folder / "act.yaml"
    path.write_text(json.dumps({"applications": [application]}))
    return path


def test_its_contract_is_the_envs_with_the_meaning_of_its_actions(policy: LeRobot) -> None:
    contract, env = policy.contract, Roller().contract
    assert contract is not None
    require_match(contract, env)
    assert contract.action == replace(env.action, low=None, high=None)
    assert contract.control_hz == env.control_hz
    assert contract.gripper
    assert contract.state == {"joints": StateSpec(2, "rad"), "xyzrpy": StateSpec(6, "m+rad")}
    assert set(contract.cameras or {}) == {"base"}
    assert contract.action.relative


def test_the_policy_sees_the_state_as_its_dataset_has_it(policy: LeRobot, tmp_path: Path) -> None:
    env = Roller()
    obs, _ = env.reset(seed=0)
    seen = []
    for _ in range(6):
        seen.append(policy.perceive(obs)["observation.state"])
        obs, *_ = env.step(Act(np.array([Roller.TURN, 1.0], np.float32)))
    assert np.abs(np.diff([state[3] for state in seen])).max() == pytest.approx(
        Roller.TURN, abs=1e-5
    ), "the roll"
    assert [state[6] for state in seen] == [1.0] * 6, "the gripper"
    results = play(
        flat_config(envs=[ROLLER], episodes=1, record="all", video="none", out=tmp_path / "out"),
        Turner,
    )
    to_lerobot(results, tmp_path / "again", state=["xyzrpy", "gripper", "joints"])
    written = pq.read_table(tmp_path / "again/data/chunk-000/file-000.parquet").to_pydict()[
        "observation.state"
    ]
    np.testing.assert_allclose(seen, written[:6], atol=1e-6)


def test_parts_that_are_set_by_hand_win_and_are_seen_alike(
    checkpoint: Path, policy: LeRobot
) -> None:
    renamed = served(checkpoint, state=["pose", "gripper", "q"])
    obs = Roller().reset(seed=0)[0]
    obs.state["xyzrpy"][3] = 3.0
    other = replace(obs, state={"pose": obs.state["xyzrpy"], "q": obs.state["joints"]})
    np.testing.assert_array_equal(
        renamed.perceive(other)["observation.state"], policy.perceive(obs)["observation.state"]
    )
    assert renamed.perceive(other)["observation.state"][3] == pytest.approx(
        3 - 2 * np.pi, abs=1e-5
    ), "the arc's middle is -2.9"


def test_without_a_contract_features_and_statistics_tell_the_parts_and_their_angles(
    checkpoint: Path, policy: LeRobot, tmp_path: Path
) -> None:
    old = tmp_path / "old"
    shutil.copytree(checkpoint, old)
    [statistics] = old.glob("policy_preprocessor_*normalizer*.safetensors")
    tensors = {
        name: one for name, one in load_file(statistics).items() if not name.startswith(STATISTICS)
    }
    save_file(tensors, statistics)
    policy_without = served(old)
    contract = policy_without.contract
    assert contract is not None
    assert set(contract.state or {}) == {"joints", "xyzrpy"}
    assert contract.gripper
    assert contract.action.delta is None
    obs = Roller().reset(seed=0)[0]
    for roll in (2.5, 3.1, -3.1, -2.0):
        obs.state["xyzrpy"][3] = roll
        seen = [one.perceive(obs)["observation.state"] for one in (policy, policy_without)]
        np.testing.assert_allclose(
            seen[1], seen[0], atol=1e-6, err_msg="order of the parts, and the angle"
        )
        assert seen[1][3] < 0, "wrapped"


def test_a_contract_of_another_width_is_not_used(
    checkpoint: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    odd = tmp_path / "odd"
    shutil.copytree(checkpoint, odd)
    [statistics] = odd.glob("policy_preprocessor_*normalizer*.safetensors")
    about = DatasetContract(Contract(state={"xyz": StateSpec(3)}), ("xyz",))
    text = torch.tensor(about.to_statistics(9)[STATISTICS][BYTES], dtype=torch.float32)
    save_file(load_file(statistics) | {f"{STATISTICS}.{BYTES}": text}, statistics)
    contract = served(odd).contract
    assert "has 3 numbers of state, the policy accepts 9" in caplog.text
    assert contract is not None
    assert contract.state == {"joints": StateSpec(9)}


def test_lerobots_trainer_takes_what_a_human_corrected(tmp_path: Path) -> None:
    with (
        Recorder(tmp_path / "corrected", 10, interventions=True) as recorder,
        recorder.episode("stack the cups"),
    ):
        for i in range(20):
            seen = Obs(
                {"front": np.full((32, 48, 3), 10 * i, np.uint8)},
                state={"joints": np.full(3, i, np.float32)},
            )
            recorder.add(seen, np.full(2, i, np.float32), tick=i, intervention=i > 9)
        recorder.label("success")
    policy = LeRobot.from_config(
        {"checkpoint": str(train(tmp_path / "corrected", tmp_path / "run")), "device": "cpu"}
    )
    policy.initialize()
    assert policy.contract is not None
    assert (policy.contract.action.dim, list(policy.contract.state or {})) == (2, ["joints"])
    config = json.loads(
        (tmp_path / f"run/checkpoints/{STEPS:06d}/pretrained_model/config.json").read_text()
    )
    assert set(config["output_features"]) == {"action"}, "it does not learn what the policy wanted"
    assert not any("policy" in name or "intervention" in name for name in config["input_features"])
