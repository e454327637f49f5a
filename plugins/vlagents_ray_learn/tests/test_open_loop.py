"""Open loop: the checkpoint of a recording makes no error, another one does."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from live_server import live_server
from recorded_sessions import Brightness, recorded, seen
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.images import jpeg_png
from vlagents_ray.images.mp4 import Mp4
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.random import Random
from vlagents_ray.protocol.messages import Request
from vlagents_ray.recorded_dataset import Names, RecordedDataset
from vlagents_ray.robot.record import Recorder
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.launch.deployment_file import IMPORT_PATH
from vlagents_ray.serve.local_agent import LocalAgent, build_engine
from vlagents_ray_learn.open_loop import comparison
from vlagents_ray_learn.open_loop.command import parse_episodes
from vlagents_ray_learn.open_loop.comparison import (
    OpenLoopPlan,
    OpenSession,
    candidate,
    compare,
    open_datasets,
)
from vlagents_ray_live import episodes

ROOT = Path(__file__).parents[3]
_ROBOTS, _TICKS = 6, 8


class Follow(Agent):
    """Predicts that the state continues by one each frame."""

    @property
    def contract(self) -> Contract:
        return Contract(
            state={"joints": StateSpec(2)}, gripper=True, action=ActionSpec(dim=2), chunk=3
        )

    def act(self, obs: Obs) -> Act:
        assert obs.gripper == 0.5
        return Act(obs.state["joints"] + np.array([[1, 2], [2, 4], [3, 6]], np.float32))


@contextmanager
def loaded(agent: Agent) -> Iterator[OpenSession]:
    engine = Engine(agent)
    engine.start()
    try:
        yield partial(LocalAgent, engine)
    finally:
        engine.close()


def record(folder: Path, agent: Agent | None = None, sessions: int = 3, **settings: Any) -> None:
    with recorded(folder, agent, **settings) as server:
        for number in range(sessions):
            robot = server.robot()
            robot.play(4, seed=number, first=10 * number)


def demonstrate(folder: Path, frames: int = 6) -> None:
    """A dataset of demonstrations, two episodes, whose state goes up by one and two."""
    with Recorder(folder, 10) as recorder:
        for _ in range(2):
            with recorder.episode("count"):
                for i in range(frames):
                    obs = Obs(
                        {"front": seen(i).cameras["front"]},
                        0.5,
                        {"joints": np.array([i, 2 * i], np.float32)},
                    )
                    recorder.add(obs, np.array([i + 1, 2 * i + 2], np.float32), tick=i)


def test_the_same_checkpoint_makes_no_error(tmp_path: Path) -> None:
    record(tmp_path)
    with loaded(Brightness()) as open_session:
        result = compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()
    assert (result["mae"], result["max"], result["frames"], result["sessions"]) == (0.0, 0.0, 12, 3)
    assert result["against"] == "answers"


def test_another_checkpoint_makes_an_error_by_joint_and_by_step(tmp_path: Path) -> None:
    record(tmp_path)
    with loaded(Brightness(gain=1.5, chunk=3)) as open_session:
        result = compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()
    assert len(result["by_step"]) == 3, "as many rows as both have"
    assert [one["frames"] for one in result["by_step"]] == [12] * 3
    assert result["by_joint"][1]["joint"] == "action_1"
    assert result["by_step"][0]["mae"] > 0
    assert result["worst"][0]["mae"] == max(one["mae"] for one in result["worst"])


def test_noise_of_the_same_seeds_makes_no_error_and_of_others_it_does(tmp_path: Path) -> None:
    record(tmp_path, Random.from_config({"action_dim": 2}))
    with loaded(Random.from_config({"action_dim": 2})) as open_session:
        assert compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()["max"] == 0
    with loaded(Random.from_config({"action_dim": 2, "seed": 1})) as open_session:
        assert compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()["max"] > 0


def test_a_session_of_several_episodes_is_reset_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(episodes, "_FRAMES", 3)
    record(tmp_path)
    with loaded(Brightness()) as open_session:
        result = compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()
    assert (result["max"], len(result["by_episode"]), result["sessions"]) == (0.0, 6, 3)


def test_missing_acts_are_told(tmp_path: Path) -> None:
    with recorded(tmp_path) as server:
        robot = server.robot()
        robot.play(1)
        held, server.recorder._held_bytes = server.recorder._held_bytes, 0
        robot.act(seen(1))
        server.recorder._held_bytes = held
        robot.act(seen(2))
    with loaded(Brightness()) as open_session:
        assert (
            compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()["missing_acts"]
            == 1
        )


def test_the_actions_of_a_dataset_without_answers_are_those_of_the_frames_ahead(
    tmp_path: Path,
) -> None:
    demonstrate(tmp_path)
    with loaded(Follow()) as open_session:
        result = compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()
    assert (result["against"], result["frames"], result["max"]) == ("actions", 12, 0.0)
    assert [one["frames"] for one in result["by_step"]] == [12, 10, 8], "to the end of each episode"


def test_every_nth_frame_of_some_episodes_and_a_shorter_horizon(tmp_path: Path) -> None:
    demonstrate(tmp_path)
    with loaded(Follow()) as open_session:
        result = compare(
            open_datasets(tmp_path), open_session, OpenLoopPlan([1], horizon=2, stride=4)
        ).to_json()
    assert [one["frames"] for one in result["by_step"]] == [2, 2]
    assert [one["episode"] for one in result["by_episode"]] == [1]


def test_a_public_dataset_of_the_older_version_with_other_names(tmp_path: Path) -> None:
    """Without a contract of ours, with a picture in the table, and with a state of unnamed
    numbers.
    """
    image = seen(0).cameras["front"]
    rows = {
        "action": [[i + 1.0, 2 * i + 2.0] for i in range(4)],
        "observation.state": [[float(i), 2.0 * i, 0.5] for i in range(4)],
        "observation.images.top": [{"bytes": jpeg_png.encode_png(image), "path": "0.png"}] * 4,
        "episode_index": [0] * 4,
    }
    for name in ("data/chunk-000", "meta", "videos/chunk-000/observation.images.side"):
        (tmp_path / name).mkdir(parents=True)
    pq.write_table(pa.table(rows), tmp_path / "data/chunk-000/episode_000000.parquet")
    video = Mp4(
        tmp_path / "videos/chunk-000/observation.images.side/episode_000000.mp4", (32, 32, 3), 10
    )
    for _ in range(4):
        video.add(np.full((32, 32, 3), 100, np.uint8))
    video.finish()
    info = {
        "codebase_version": "v2.1",
        "fps": 10,
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        "features": {
            "action": {
                "dtype": "float32",
                "shape": [2],
                "names": {"motors": ["shoulder", "elbow"]},
            },
            "observation.state": {"dtype": "float32", "shape": [3], "names": None},
            "observation.images.top": {"dtype": "image", "shape": [33, 48, 3], "names": None},
            "observation.images.side": {"dtype": "video", "shape": [32, 32, 3], "names": None},
        },
    }
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    (tmp_path / "meta/episodes.jsonl").write_text(
        '{"episode_index": 0, "tasks": ["count"], "length": 4}\n'
    )
    with loaded(Follow()) as open_session:
        result = compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()
    assert (result["max"], result["by_joint"][1]["joint"]) == (0.0, "elbow")
    dataset = RecordedDataset(tmp_path)
    [session] = dataset.sessions()
    steps = list(dataset.steps(session.episodes[0], Names({"base": "top", "wrist": "side"}), None))
    np.testing.assert_array_equal(steps[3].obs.cameras["base"], image)
    assert abs(float(steps[3].obs.cameras["wrist"].mean()) - 100) < 3
    assert steps[3].obs.state["joints"].tolist() == [3, 6, 0.5]
    with pytest.raises(ConfigError, match="tip"):
        next(dataset.steps(session.episodes[0], Names({"base": "tip"}), None))


def test_a_state_that_cannot_be_divided_names_the_option(tmp_path: Path) -> None:
    demonstrate(tmp_path)
    info = json.loads((tmp_path / "meta/info.json").read_text())
    del info["vlagents_ray"]
    (tmp_path / "meta/info.json").write_text(json.dumps(info))
    dataset = RecordedDataset(tmp_path)
    steps = dataset.steps(dataset.sessions()[0].episodes[0], Names(state=["arm", "hand"]), None)
    with pytest.raises(ConfigError, match="--state"):
        next(steps)


def test_a_policy_of_another_robot_is_refused(tmp_path: Path) -> None:
    demonstrate(tmp_path)
    with (
        loaded(Random.from_config({"action_dim": 7})) as open_session,
        pytest.raises(ConfigError, match="7"),
    ):
        compare(open_datasets(tmp_path), open_session, OpenLoopPlan())


def test_an_error_of_the_policy_says_where(tmp_path: Path) -> None:
    class Fails(Follow):
        def act(self, obs: Obs) -> Act:
            if obs.state["joints"][0] == 3:
                raise ValueError("no")
            return super().act(obs)

    demonstrate(tmp_path)
    with loaded(Fails()) as open_session, pytest.raises(PolicyFailed, match="episode 0, frame 3"):
        compare(open_datasets(tmp_path), open_session, OpenLoopPlan())


def test_a_server_at_a_url_is_asked_in_the_same_way(tmp_path: Path) -> None:
    record(tmp_path)
    with live_server(Brightness()) as server, candidate(server.url) as open_session:
        result = compare(open_datasets(tmp_path), open_session, OpenLoopPlan()).to_json()
    assert (result["max"], result["frames"]) == (0.0, 12)


def test_the_command_prints_and_writes_the_errors(tmp_path: Path) -> None:
    demonstrate(tmp_path / "data")
    out = tmp_path / "report"
    done = CliRunner().invoke(
        app,
        ["open-loop", str(tmp_path / "data"), "--policy", policy_file(tmp_path), "--out", str(out)],
    )
    assert done.exit_code == 0, done.output
    assert "mean absolute error 5.25" in done.output
    document = json.loads((out / "open_loop.json").read_text())
    assert document["by_joint"][0]["mae"] == pytest.approx(np.mean([1, 2, 3, 4, 5, 6]))


@pytest.mark.torch
def test_each_answer_of_robots_in_batches_is_computed_again_alone_in_another_process(
    tmp_path: Path,
) -> None:
    pytest.importorskip("torch")
    args: dict[str, Any] = {
        "policy": "reference",
        "config": {
            "checkpoint": str(ROOT / "examples/reference/checkpoint"),
            "embodiment": "tabletop",
        },
        "batch": {"max_size": 4, "invariant": True},
    }
    engine = build_engine(ServerArgs(**args), args["config"])
    sizes: list[int] = []

    def play(server: Any, number: int) -> None:
        robot = server.robot()
        robot.ask(Request("reset", table(number), "lift the red puck", {"seed": number}))
        for tick in range(_TICKS):
            reply = robot.ask(Request("act", table(100 * number + tick)))
            sizes.append(reply.timing["batch_size"])

    with (
        recorded(tmp_path / "traces", engine) as server,
        ThreadPoolExecutor(_ROBOTS) as threads,
    ):
        list(threads.map(partial(play, server), range(_ROBOTS)))
    assert max(sizes) > 1

    # The file says nothing of batches: the number of rows is that of the recording.
    del args["batch"]
    (tmp_path / "policy.yaml").write_text(
        json.dumps({"applications": [{"import_path": IMPORT_PATH, "args": args}]})
    )
    command = ["open-loop", "traces", "--policy", "policy.yaml", "--out", "report"]
    done = subprocess.run(
        [sys.executable, "-m", "vlagents_ray", *command],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    frames = _ROBOTS * _TICKS
    assert f"equal to the bit: {frames} of {frames} answers" in done.stdout
    document = json.loads((tmp_path / "report" / "open_loop.json").read_text())
    assert (document["equal"], document["max"]) == (frames, 0.0)


def table(seed: int) -> Obs:
    """Return a random observation of the tabletop."""
    rng = np.random.default_rng(seed)
    images = {name: rng.integers(0, 256, (64, 64, 3), np.uint8) for name in ("front", "wrist")}
    pose = rng.normal(0, 0.1, 6).astype(np.float32)
    return Obs(images, 0.5, {"xyzrpy": pose})


def policy_file(folder: Path) -> str:
    """A policy of zeros with two numbers."""
    args = {"policy": "noop", "config": {"action_dim": 2}}
    application = {
        "name": "noop",
        "route_prefix": "/",
        "import_path": "vlagents_ray.serve.app:build",
        "args": args,
    }
    path = folder / "policy.yaml"
    path.write_text(json.dumps({"applications": [application]}))
    return str(path)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["DATA"], "--policy"),
        (["DATA", "--policy", "noop", "--episodes", "3-"], "--episodes"),
        (["DATA", "--policy", "noop", "--episodes", "7"], "episodes"),
        (["DATA", "--policy", "noop", "--camera-map", "base"], "--camera-map"),
    ],
)
def test_wrong_options_are_told(words: list[str], said: str, tmp_path: Path) -> None:
    demonstrate(tmp_path / "data", 2)
    given = [str(tmp_path / "data") if word == "DATA" else word for word in words]
    done = CliRunner().invoke(app, ["open-loop", *given, "--out", str(tmp_path / "out")])
    assert done.exit_code == 2
    assert said in done.output


@pytest.mark.parametrize("out", ["file", "file/below"])
def test_a_file_in_place_of_the_folder_of_errors_is_refused_before_the_policy_is_loaded(
    out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    demonstrate(tmp_path / "data", 2)
    (tmp_path / "file").write_text("kept")
    loaded: list[str] = []
    monkeypatch.setattr(comparison, "candidate", loaded.append)
    options = ["--policy", "noop", "--out", str(tmp_path / out)]
    done = CliRunner().invoke(app, ["open-loop", str(tmp_path / "data"), *options])
    assert done.exit_code == 2
    assert "expected a folder" in done.output
    assert loaded == []


def test_numbers_and_ranges() -> None:
    assert list(parse_episodes("0-2,7")) == [0, 1, 2, 7]


def test_a_folder_without_a_dataset_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="LeRobotDataset"):
        open_datasets(tmp_path)


@pytest.mark.parametrize("text", ["", "[", "[]", "{}", '{"codebase_version": "v3.0"}'])
def test_a_broken_description_of_a_dataset_is_named(text: str, tmp_path: Path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta/info.json").write_text(text)
    with pytest.raises(ConfigError, match=str(tmp_path)):
        open_datasets(tmp_path)


def test_datasets_of_other_actions_are_not_mixed(tmp_path: Path) -> None:
    demonstrate(tmp_path / "one", 2)
    record(tmp_path / "two")
    shutil.move(next((tmp_path / "two").iterdir()), tmp_path / "three")
    (tmp_path / "two").rmdir()
    with pytest.raises(ConfigError, match="one by one"):
        open_datasets(tmp_path)


def test_the_frames_of_an_operator_are_marked_for_training(tmp_path: Path) -> None:
    operators = [False, True, True, False]
    still, action = Obs(state={"joints": np.zeros(2, np.float32)}), np.ones(2, np.float32)
    with Recorder(tmp_path, 10, interventions=True) as recorder, recorder.episode("stack"):
        for tick, intervention in enumerate(operators):
            recorder.add(still, action, tick=tick, intervention=intervention)
    dataset = RecordedDataset(tmp_path)
    [session] = dataset.sessions()
    steps = dataset.steps(session.episodes[0], Names(), None)
    assert [step.intervention for step in steps] == operators
