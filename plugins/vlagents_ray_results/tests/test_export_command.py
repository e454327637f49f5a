"""Tests of `vlagents-ray export`: the command line selects the content of a dataset."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from in_process_evaluation import flat_config, play
from typer.testing import CliRunner, Result
from wrist_roll_env import ROLLER, Turner

from vlagents_ray.cli.main import app


def to_lerobot(folder: Path, out: Path, *settings: str) -> Result:
    words = ["export", str(folder), "--out", str(out), "--to", "lerobot"]
    for setting in settings:
        words += ["--set", setting]
    return CliRunner().invoke(app, words, env={"COLUMNS": "200"})


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "out"
    play(flat_config(envs=[ROLLER], episodes=2, record="all", video="none", out=out), Turner)
    return out


def test_cameras_parts_successes_and_ends_of_a_dataset_are_chosen(
    played: Path, tmp_path: Path
) -> None:
    chosen = ["cameras=[wrist]", "state=[joints, gripper]", "successes=true", "cut_idle=true"]
    done = to_lerobot(played, tmp_path / "d", *chosen)
    assert done.exit_code == 0, done.output
    assert done.output.startswith("wrote 1 episodes")
    info = json.loads((tmp_path / "d/meta/info.json").read_text())
    assert info["total_frames"] == 7
    assert info["features"]["observation.state"]["names"] == ["joints_0", "joints_1", "gripper"]
    assert [key for key in info["features"] if "images" in key] == ["observation.images.wrist"]


def test_a_dataset_without_cameras_has_a_state_of_the_environment(
    played: Path, tmp_path: Path
) -> None:
    done = to_lerobot(played, tmp_path / "d", "cameras=[]", "environment_state=[joints]")
    assert done.exit_code == 0, done.output
    features = json.loads((tmp_path / "d/meta/info.json").read_text())["features"]
    assert features["observation.environment_state"]["names"] == ["joints_0", "joints_1"]
    assert not (tmp_path / "d/videos").exists()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("cameras=wrist", "such as [wrist]"),
        ("successes=often", "'often'"),
        ("succeses=true", "did you mean 'successes'"),
        ("results=x", "there is no such setting"),
        ("cameras=[front]", "got 'front'"),
    ],
)
def test_a_setting_that_a_dataset_does_not_have_is_refused(
    played: Path, tmp_path: Path, setting: str, message: str
) -> None:
    done = to_lerobot(played, tmp_path / "d", setting)
    assert done.exit_code == 2
    assert message in " ".join(done.output.split())
    assert not (tmp_path / "d").exists()
