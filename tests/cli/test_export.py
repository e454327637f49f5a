"""`vlagents-ray export`: what goes into a dataset is chosen on the command line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from in_process_evaluation import flat_config, play
from typer.testing import CliRunner, Result
from wrist_roll_env import ROLLER, Turner

from vlagents_ray.cli.main import app


def export(*words: object) -> Result:
    return CliRunner().invoke(app, ["export", *map(str, words)], env={"COLUMNS": "200"})


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    play(flat_config(envs=[ROLLER], episodes=2, record="all", video="none", out=out), Turner)
    return out


def test_cameras_parts_successes_and_ends_of_a_dataset_are_chosen(played: Path, tmp_path: Path) -> None:
    chosen = ["--cameras", "wrist", "--state", "joints, gripper", "--successes", "--cut-idle"]
    done = export(played, "--out", tmp_path / "d", "--to", "lerobot", *chosen)
    assert done.exit_code == 0, done.output
    assert done.output.startswith("wrote 1 episodes")
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    assert info["total_frames"] == 7
    assert info["features"]["observation.state"]["names"] == ["joints_0", "joints_1", "gripper"]
    assert [key for key in info["features"] if "images" in key] == ["observation.images.wrist"]


def test_a_dataset_without_cameras_has_a_state_of_the_environment(played: Path, tmp_path: Path) -> None:
    done = export(played, "--out", tmp_path / "d", "--to", "lerobot", "--cameras", "", "--environment-state", "joints")
    assert done.exit_code == 0, done.output
    features = json.loads((tmp_path / "d/meta/info.json").read_text())["features"]
    assert features["observation.environment_state"]["names"] == ["joints_0", "joints_1"]
    assert not (tmp_path / "d/videos").exists()


def test_a_table_has_no_frames_to_choose(played: Path, tmp_path: Path) -> None:
    done = export(played, "--out", tmp_path / "t.csv", "--to", "csv", "--cut-idle", "--state", "joints")
    assert done.exit_code == 2
    assert "--state, --cut-idle: got --to csv, want --to lerobot" in " ".join(done.output.split())
    assert not (tmp_path / "t.csv").exists()
