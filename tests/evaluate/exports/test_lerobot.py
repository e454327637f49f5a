"""The dataset holds what was recorded, frame by frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import LINE, OTHER_LINE
from played import play

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig
from vlagents_ray.evaluate.exports import to_lerobot
from vlagents_ray.evaluate.trajectory import Trajectory
from vlagents_ray.policies.scripted import Scripted

Config = Callable[..., EvalConfig]
CAMERA = {"camera": [32, 48]}


def test_frames_states_actions_rewards_and_success_are_those_of_the_episodes(config: Config, tmp_path: Path) -> None:
    results = play(config(episodes=3, record="all", env_options=CAMERA | {"state_dim": 2}))
    root = tmp_path / "dataset"
    assert to_lerobot(results, root) == 3
    for number, episode in enumerate(results.cells[0].episodes):
        trajectory = Trajectory.load(results.out / str(episode.trajectory))
        rows = pq.read_table(root / f"data/chunk-000/file-{number:03d}.parquet").to_pydict()
        assert rows["action"] == trajectory.actions[:, 0].tolist()  # LeRobot wants no lists of one number
        assert rows["observation.state.position"] == trajectory.state["position"][:-1].tolist()
        assert rows["observation.state"] == rows["observation.state.position"]
        assert rows["next.reward"] == trajectory.rewards.astype(np.float32).tolist()
        assert rows["next.success"] == trajectory.success.tolist()
        assert rows["next.done"] == [False] * 9 + [True]
        with av.open(str(root / f"videos/observation.images.front/chunk-000/file-{number:03d}.mp4")) as video:
            red = [frame.to_ndarray(format="rgb24")[..., 0].mean() for frame in video.decode(video=0)]
        assert red[:10] == pytest.approx([20 * i for i in range(10)], abs=6)
    tasks = pq.read_table(root / "meta/tasks.parquet").column("__index_level_0__").to_pylist()
    assert tasks == [episode.result.instruction for episode in results.cells[0].episodes]


def test_units_and_the_meaning_of_actions_go_along(config: Config, tmp_path: Path) -> None:
    to_lerobot(play(config(envs=["tabletop"], episodes=1, record="all"), Scripted), tmp_path / "dataset")
    features = json.loads((tmp_path / "dataset/meta/info.json").read_text())["features"]
    assert features["action"]["spec"]["space"] == "ee_position"
    units = {key: one["unit"] for key, one in features.items() if key.startswith("observation.state.")}
    assert units
    assert all(units.values())


def test_the_trajectories_stay_as_they_are(config: Config, tmp_path: Path) -> None:
    results = play(config(episodes=1, record="all", video="all", env_options=CAMERA))
    before = {path: path.read_bytes() for path in sorted(results.out.rglob("*.mp4"))}
    to_lerobot(results, tmp_path / "dataset")
    assert {path: path.read_bytes() for path in sorted(results.out.rglob("*.mp4"))} == before


def test_envs_that_differ_are_exported_one_by_one(config: Config, tmp_path: Path) -> None:
    suites = [{"envs": [LINE], "episodes": 1}, {"envs": [OTHER_LINE], "episodes": 1, "env_options": CAMERA}]
    settings = EvalConfig.model_validate(config(record="all").model_dump() | {"suites": suites})
    results = play(settings)
    with pytest.raises(ConfigError, match=r"has other features.*images.front.*--env"):
        to_lerobot(results, tmp_path / "both")
    assert to_lerobot(results.only(env=OTHER_LINE), tmp_path / "one") == 1


def test_without_trajectories_the_cure_is_said(config: Config, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="record: all"):
        to_lerobot(play(config(episodes=1)), tmp_path / "dataset")


def test_nothing_is_written_into_a_folder_that_holds_something(config: Config, tmp_path: Path) -> None:
    results = play(config(episodes=1, record="all"))
    with pytest.raises(ConfigError, match="not empty"):
        to_lerobot(results, tmp_path)
