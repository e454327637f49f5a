"""Tests that the dataset contains each recorded frame."""

from __future__ import annotations

import errno
import json
import weakref
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow.parquet as pq
import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero
from in_process_evaluation import flat_config, play
from scipy.spatial.transform import Rotation
from wrist_roll_env import ROLLER, TILTED_ROLLER, Roller, Turner

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.dataset_contract import BYTES, INFO, STATISTICS, DatasetContract
from vlagents_ray.datasets.episode import FinishedEpisode
from vlagents_ray.datasets.writer import Dataset
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.interface import Act, Obs
from vlagents_ray_results.lerobot import to_lerobot

Config = Callable[..., EvalConfig]
CAMERA = {"camera": [32, 48]}


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Return the results of two episodes of a hand that rolls; the first is solved."""
    out = tmp_path_factory.mktemp("rolled") / "out"
    return play(flat_config(envs=[ROLLER], episodes=2, record="all", out=out, video="none"), Turner)


def test_frames_states_actions_rewards_and_success_are_those_of_the_episodes(
    config: Config, tmp_path: Path
) -> None:
    results = play(config(episodes=3, record="all", env_options=CAMERA | {"state_dim": 2}))
    root = tmp_path / "dataset"
    assert to_lerobot(results, root) == 3
    for number, episode in enumerate(results.cases[0].episodes):
        trajectory = Trajectory.load(results.out / str(episode.trajectory))
        rows = pq.read_table(root / f"data/chunk-000/file-{number:03d}.parquet").to_pydict()
        # LeRobot stores a single number instead of a list of one number.
        assert rows["action"] == trajectory.actions[:, 0].tolist()
        assert rows["observation.state.position"] == trajectory.state["position"][:-1].tolist()
        assert rows["observation.state"] == rows["observation.state.position"]
        assert rows["next.reward"] == trajectory.rewards.astype(np.float32).tolist()
        assert rows["next.success"] == trajectory.success.tolist()
        assert rows["next.done"] == [False] * 9 + [True]
        with av.open(
            str(root / f"videos/observation.images.front/chunk-000/file-{number:03d}.mp4")
        ) as video:
            red = [
                frame.to_ndarray(format="rgb24")[..., 0].mean() for frame in video.decode(video=0)
            ]
        assert red[:10] == pytest.approx([20 * i for i in range(10)], abs=6)
    tasks = pq.read_table(root / "meta/tasks.parquet").column("__index_level_0__").to_pylist()
    assert tasks == [episode.result.instruction for episode in results.cases[0].episodes]


def test_the_trajectories_stay_as_they_are(config: Config, tmp_path: Path) -> None:
    results = play(config(episodes=1, record="all", video="all", env_options=CAMERA))
    before = {path: path.read_bytes() for path in sorted(results.out.rglob("*.mp4"))}
    to_lerobot(results, tmp_path / "dataset")
    assert {path: path.read_bytes() for path in sorted(results.out.rglob("*.mp4"))} == before


def test_images_that_were_recorded_exactly_stay_exact(config: Config, tmp_path: Path) -> None:
    results = play(
        config(episodes=1, record="all", record_images="exact", video="all", env_options=CAMERA)
    )
    root = tmp_path / "dataset"
    to_lerobot(results, root)
    info = json.loads((root / "meta/info.json").read_text())
    feature = info["features"]["observation.images.front"]
    assert feature["info"]["video.pix_fmt"] == "gbrp"
    file = root / "videos/observation.images.front/chunk-000/file-000.mp4"
    with av.open(str(file)) as video:
        images = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    for step, image in enumerate(images):
        assert (image == (20 * step, 200 - 20 * step, 60)).all()


def test_envs_that_differ_are_exported_one_by_one(config: Config, tmp_path: Path) -> None:
    suites = [
        {"envs": [LINE], "episodes": 1},
        {"envs": [OTHER_LINE], "episodes": 1, "env_options": CAMERA},
    ]
    settings = EvalConfig.model_validate(config(record="all").model_dump() | {"suites": suites})
    results = play(settings)
    with pytest.raises(ConfigError, match=r"has other features.*images.front.*--env"):
        to_lerobot(results, tmp_path / "both")
    assert list(tmp_path.glob("both*")) == [], "the first environment alone must leave no dataset"
    assert to_lerobot(results.only(env=OTHER_LINE), tmp_path / "one") == 1


@pytest.mark.parametrize("end", ["npz", "mp4"])
def test_a_file_that_is_gone_is_said_in_one_sentence(
    config: Config, tmp_path: Path, end: str
) -> None:
    results = play(config(episodes=2, record="all", env_options=CAMERA))
    [gone] = (results.out / "trajectories").rglob(f"ep0001_*.{end}")
    gone.unlink()
    with pytest.raises(
        ConfigError, match=rf"{gone.name}: expected the file .*, got none; copy the folder again"
    ):
        to_lerobot(results, tmp_path / "dataset")
    assert list(tmp_path.glob("dataset*")) == []


def test_after_an_export_that_failed_the_same_command_works(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = play(config(episodes=2, record="all"))
    save, saved = Dataset.save, []

    def disk_full_at_the_second(dataset: Dataset, episode: FinishedEpisode) -> None:
        if saved:
            raise OSError(errno.ENOSPC, "No space left on device")
        saved.append(episode)
        save(dataset, episode)

    monkeypatch.setattr(Dataset, "save", disk_full_at_the_second)
    with pytest.raises(OSError, match="No space"):
        to_lerobot(results, tmp_path / "new" / "dataset")
    assert list((tmp_path / "new").iterdir()) == []
    monkeypatch.undo()
    assert to_lerobot(results, tmp_path / "new" / "dataset") == 2


def test_trajectories_are_in_memory_one_at_a_time(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = play(config(episodes=4, record="all"))
    load = Trajectory.load
    loaded: list[weakref.ref[np.ndarray]] = []
    alive: list[int] = []

    def counted(path: Path) -> Trajectory:
        trajectory = load(path)
        actions = trajectory.actions
        # The weak reference is to the base array, which views keep alive.
        loaded.append(weakref.ref(actions if actions.base is None else actions.base))
        alive.append(sum(one() is not None for one in loaded))
        return trajectory

    monkeypatch.setattr(Trajectory, "load", counted)
    assert to_lerobot(results, tmp_path / "dataset") == 4
    assert max(alive) <= 2  # the last trajectory is alive until the next one has been read


def test_a_folder_that_holds_something_and_results_without_trajectories_are_refused(
    config: Config, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match="expected a new or empty folder"):
        to_lerobot(play(config(episodes=1, record="all")), tmp_path)
    with pytest.raises(ConfigError, match=r"--record all \(`record: all`"):
        to_lerobot(play(config(episodes=1, out=tmp_path / "without")), tmp_path / "dataset")


def info(root: Path) -> dict[str, Any]:
    return dict(json.loads((root / "meta/info.json").read_text()))


def rows(root: Path, number: int) -> dict[str, Any]:
    return dict(pq.read_table(root / f"data/chunk-000/file-{number:03d}.parquet").to_pydict())


def test_cameras_and_parts_of_the_state_are_chosen_in_that_order(
    results: Results, tmp_path: Path
) -> None:
    to_lerobot(results, tmp_path / "d", cameras=["wrist"], state=["gripper", "joints"])
    features = info(tmp_path / "d")["features"]
    assert [key for key in features if "images" in key] == ["observation.images.wrist"]
    assert features["observation.state"]["names"] == ["gripper", "joints_0", "joints_1"]
    assert {key for key in features if key.startswith("observation.state.")} == {
        "observation.state.joints"
    }
    assert rows(tmp_path / "d", 0)["observation.state"][0] == pytest.approx([1.0, 0.1, 0.0])
    assert not (tmp_path / "d/videos/observation.images.base").exists()


@pytest.mark.parametrize("both", [False, True])
def test_parts_of_the_environments_state_are_apart_and_need_no_camera(
    results: Results, tmp_path: Path, both: bool
) -> None:
    (tmp_path / "d").mkdir()  # the folder may exist if it is empty
    chosen = ["joints", "gripper"] if both else None
    to_lerobot(results, tmp_path / "d", cameras=[], state=chosen, environment_state=["joints"])
    features = info(tmp_path / "d")["features"]
    assert [key for key in features if "images" in key] == []
    assert features["observation.environment_state"]["names"] == ["joints_0", "joints_1"]
    others = [f"joints_{i}" for i in range(2)] if both else [f"xyzrpy_{i}" for i in range(6)]
    assert features["observation.state"]["names"] == [*others, "gripper"]
    first = {key: values[0] for key, values in rows(tmp_path / "d", 0).items()}
    assert first["observation.environment_state"] == pytest.approx([0.1, 0.0])
    about = DatasetContract.from_json(info(tmp_path / "d")[INFO])
    assert about.environment == ("joints",)
    assert set(about.contract.state or {}) == ({"joints"} if both else {"joints", "xyzrpy"})
    assert sorted(path.name for path in (tmp_path / "d").iterdir()) == ["data", "meta"]


@pytest.mark.parametrize(
    ("chosen", "text"),
    [
        (
            {"cameras": ["wrst"]},
            (
                r"cameras: .*Roller: expected only \['base', 'wrist'\], got 'wrst'; did you mean "
                r"'wrist'"
            ),
        ),
        (
            {"state": ["joints", "torque"]},
            "state: .*Roller: expected only .*'gripper', 'joints'.*got 'torque'",
        ),
        ({"state": ["joints", "joints"]}, "expected each name once"),
        (
            {"environment_state": ["gripper"]},
            "environment_state: .*expected only .*'joints', 'xyzrpy'.*got 'gripper'",
        ),
    ],
)
def test_what_the_episodes_do_not_have_cannot_be_chosen(
    results: Results, tmp_path: Path, chosen: dict[str, Any], text: str
) -> None:
    with pytest.raises(ConfigError, match=text):
        to_lerobot(results, tmp_path / "d", **chosen)
    assert not (tmp_path / "d").exists()


def test_only_what_was_solved_goes_into_it(config: Config, tmp_path: Path) -> None:
    results = play(config(envs=[ROLLER], episodes=4, record="all"), Turner)
    assert to_lerobot(results, tmp_path / "all") == 4
    assert to_lerobot(results, tmp_path / "solved", successes=True) == 2
    assert all(any(rows(tmp_path / "solved", number)["next.success"]) for number in range(2))
    unsolved = play(
        config(envs=[ROLLER], episodes=1, seed=1, record="all", out=tmp_path / "unsolved"), Turner
    )
    with pytest.raises(ConfigError, match="in none of the 1 recorded episodes was the task solved"):
        to_lerobot(unsolved, tmp_path / "none", successes=True)


def test_an_episode_ends_where_nothing_moves_any_more_after_it_was_solved(
    results: Results, tmp_path: Path
) -> None:
    to_lerobot(results, tmp_path / "d", cut_idle=True)
    first, second = rows(tmp_path / "d", 0), rows(tmp_path / "d", 1)
    assert [action[0] for action in first["action"]] == pytest.approx([Roller.TURN] * 6 + [0.0])
    assert first["next.done"] == [False] * 6 + [True]
    assert first["next.success"][-1]
    assert len(second["action"]) == Roller.max_steps, "it was not solved"


class Pushed(ToZero):
    """Reports another version of the weights at each step."""

    def act(self, obs: Obs) -> Act:
        self.acts = getattr(self, "acts", 2) + 1
        return replace(
            super().act(obs), info={"policy": {"version": self.acts, "fingerprint": "of a test"}}
        )


def test_a_frame_names_the_weights_that_chose_its_action(config: Config, tmp_path: Path) -> None:
    results = play(config(episodes=1, record="all"), Pushed)
    [played] = results.cases[0].episodes
    to_lerobot(results, tmp_path / "d")
    assert info(tmp_path / "d")["features"]["policy_version"]["dtype"] == "int64"
    assert rows(tmp_path / "d", 0)["policy_version"] == list(range(3, 13))
    assert played.result.policy_version == 12
    others = play(config(episodes=1, record="all", out=tmp_path / "others"))
    to_lerobot(others, tmp_path / "none")
    assert "policy_version" not in info(tmp_path / "none")["features"]


def test_angles_are_written_without_jumps_and_info_says_about_what(
    results: Results, tmp_path: Path
) -> None:
    recorded = Trajectory.load(results.out / str(results.cases[0].episodes[0].trajectory)).state[
        "xyzrpy"
    ][:-1]
    assert np.abs(np.diff(recorded[:, 3])).max() > np.pi
    to_lerobot(results, tmp_path / "d")
    angles = info(tmp_path / "d")[INFO]["angles"]
    # The vector contains joint, joint, x, y, z and roll; only the roll jumps.
    assert list(angles) == ["5"]
    written = rows(tmp_path / "d", 0)
    roll = np.array(written["observation.state"])[:, 5]
    assert np.abs(np.diff(roll)).max() == pytest.approx(Roller.TURN, abs=1e-5)
    assert np.abs(roll - angles["5"]).max() < np.pi / 2
    np.testing.assert_array_equal(np.array(written["observation.state.xyzrpy"])[:, 3], roll)
    about = DatasetContract.from_json(info(tmp_path / "d")[INFO])
    np.testing.assert_allclose(
        about.wrapped(np.insert(recorded, 0, [[0], [0]], axis=1))[:, 5], roll, atol=1e-6
    )


def test_rotation_vectors_are_written_without_jumps_and_are_the_same_rotations(
    config: Config, tmp_path: Path
) -> None:
    results = play(config(envs=[TILTED_ROLLER], episodes=2, record="all"), Turner)
    recorded = Trajectory.load(results.out / str(results.cases[0].episodes[0].trajectory)).state[
        "xyz_axis_angle"
    ][:-1]
    assert np.linalg.norm(np.diff(recorded[:, 3:], axis=0), axis=1).max() > np.pi
    to_lerobot(results, tmp_path / "d")
    about = DatasetContract.from_json(info(tmp_path / "d")[INFO])
    assert list(about.angles) == [5]
    written = rows(tmp_path / "d", 0)
    vectors = np.array(written["observation.state"])[:, 5:8]
    assert np.linalg.norm(np.diff(vectors, axis=0), axis=1).max() == pytest.approx(
        Roller.TURN, abs=1e-5
    )
    np.testing.assert_allclose(
        Rotation.from_rotvec(vectors).as_matrix(),
        Rotation.from_rotvec(recorded[:, 3:]).as_matrix(),
        atol=1e-5,
    )
    served = about.wrapped(
        np.concatenate(
            [np.zeros((len(recorded), 2)), recorded, np.ones((len(recorded), 1))], axis=1
        )
    )
    np.testing.assert_allclose(served[:, 5:8], vectors, atol=1e-6)
    alone = np.array(written["observation.state.xyz_axis_angle"])
    np.testing.assert_array_equal(alone, np.array(written["observation.state"])[:, 2:8])


def test_the_contract_of_a_policy_goes_along_in_info_and_in_the_statistics(
    results: Results, tmp_path: Path
) -> None:
    to_lerobot(results, tmp_path / "d", cameras=["wrist"], state=["joints", "gripper"])
    features = info(tmp_path / "d")["features"]
    assert features["action"]["spec"]["space"] == "joint"
    assert features["observation.state.joints"]["unit"] == "rad"
    about = DatasetContract.from_json(info(tmp_path / "d")[INFO])
    assert about.state == ("joints", "gripper")
    assert about.cameras == {"observation.images.wrist": "wrist"}
    assert about.contract == Contract(
        cameras={"wrist": CameraSpec(16, 16)},
        state={"joints": StateSpec(2, "rad")},
        gripper=True,
        action=ActionSpec(dim=2, delta=True, space="joint", gripper_open=1.0, gripper_closed=-1.0),
        control_hz=10.0,
    )
    statistics = json.loads((tmp_path / "d/meta/stats.json").read_text())
    assert DatasetContract.from_statistics(statistics[STATISTICS][BYTES]) == about
