"""Tests that the MCAP file contains the recorded values with their times, according to the reader
of the package `mcap`.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from in_process_evaluation import play
from mcap.reader import make_reader
from recorded_sessions import recorded
from typer.testing import CliRunner

from vlagents_ray.cli.main import app
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.images import jpeg_png
from vlagents_ray.interface import Obs
from vlagents_ray.robot.record import Recorder
from vlagents_ray_results.mcap_file import dataset_to_mcap, results_to_mcap

Config = Callable[..., EvalConfig]
CAMERA = {"camera": [32, 48], "state_dim": 2}
NS = 1_000_000_000


@dataclass
class Topic:
    """The messages of a topic in the order of their times."""

    schema: str
    times: list[int]  # log times, ns
    messages: list[dict[str, Any]]

    def values(self) -> list[list[float]]:
        return [message["values"] for message in self.messages]

    def images(self) -> list[np.ndarray]:
        return [jpeg_png.decode(base64.b64decode(one["data"])) for one in self.messages]


def read(file: Path) -> dict[str, Topic]:
    """Return the topics of a file, by name."""
    topics: dict[str, Topic] = {}
    with file.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "json")
            assert json.loads(schema.data)["title"] == schema.name
            content = json.loads(message.data)
            time = content["timestamp"]
            assert time["sec"] * NS + time["nsec"] == message.log_time == message.publish_time
            topic = topics.setdefault(channel.topic, Topic(schema.name, [], []))
            topic.times.append(message.log_time)
            topic.messages.append(content)
    return topics


def metadata(file: Path) -> Iterator[tuple[str, Mapping[str, str]]]:
    with file.open("rb") as stream:
        for record in make_reader(stream).iter_metadata():
            yield record.name, record.metadata


def export(folder: Path, out: Path, *words: str) -> Any:
    command = ["export", str(folder), "--out", str(out), "--to", "mcap", *words]
    return CliRunner().invoke(app, command, env={"COLUMNS": "200"})


@pytest.fixture
def results(config: Config) -> Results:
    return play(config(episodes=3, record="all", env_options=CAMERA))


def test_an_evaluation_has_the_values_images_and_clock_of_its_episodes(
    results: Results, tmp_path: Path
) -> None:
    file = tmp_path / "episodes.mcap"
    done = export(results.out, file)
    assert done.exit_code == 0, done.output
    assert f"wrote 3 episodes to {file}" in done.output

    topics = read(file)
    episodes = sorted(results.cases[0].episodes, key=lambda episode: episode.finished)
    trajectories = [Trajectory.load(results.out / str(one.trajectory)) for one in episodes]
    hz = results.cases[0].contract["control_hz"]
    period_ns = NS / (hz or 20)

    assert topics["/camera/front"].schema == "foxglove.CompressedImage"
    state = np.concatenate([one.state["position"] for one in trajectories])
    assert topics["/state/position"].values() == state.tolist()
    actions = np.concatenate([one.actions for one in trajectories])
    assert topics["/action"].values() == actions.tolist()
    outcomes = topics["/outcome"].messages
    rewards = np.concatenate([one.rewards for one in trajectories])
    assert [one["reward"] for one in outcomes] == rewards.tolist()
    solved = np.concatenate([one.success for one in trajectories])
    assert [one["success"] for one in outcomes] == solved.tolist()
    assert sum(one["done"] for one in outcomes) == 3

    begins = topics["/episode"]
    assert [one["episode"] for one in begins.messages] == [one.result.full_key for one in episodes]
    assert [one["instruction"] for one in begins.messages] == [
        one.result.instruction for one in episodes
    ]
    expected_times = []
    for start, trajectory in zip(begins.times, trajectories, strict=True):
        steps = len(trajectory.actions)
        expected_times += [start + round(i * period_ns) for i in range(steps + 1)]
    assert topics["/state/position"].times == expected_times
    assert topics["/camera/front"].times == expected_times
    assert expected_times == sorted(set(expected_times))
    first_end = begins.times[0] + round(len(trajectories[0].actions) * period_ns)
    assert first_end == pytest.approx(episodes[0].finished * NS, abs=1000)

    assert dict(metadata(file))[f"episode {episodes[0].result.full_key}"] == {
        "policy": "policy",
        "env": results.cases[0].env,
        "suite": "",
        "seed": str(episodes[0].result.key.seed),
        "success_once": json.dumps(episodes[0].result.success_once),
        "status": "done",
    }


def test_images_of_videos_are_jpeg_of_the_chosen_quality(results: Results, tmp_path: Path) -> None:
    sizes = {}
    for quality in (30, 95):
        file = tmp_path / f"{quality}.mcap"
        results_to_mcap(results, file, quality=quality)
        messages = read(file)["/camera/front"].messages
        assert {message["format"] for message in messages} == {"jpeg"}
        assert {message["frame_id"] for message in messages} == {"front"}
        sizes[quality] = sum(len(message["data"]) for message in messages)
    assert sizes[30] < sizes[95]
    shapes = {image.shape for image in read(tmp_path / "95.mcap")["/camera/front"].images()}
    assert shapes == {(32, 48, 3)}


def test_cameras_are_chosen(results: Results, tmp_path: Path) -> None:
    done = export(results.out, tmp_path / "none.mcap", "--set", "cameras=[]")
    assert done.exit_code == 0, done.output
    assert not [topic for topic in read(tmp_path / "none.mcap") if topic.startswith("/camera")]

    done = export(results.out, tmp_path / "x.mcap", "--set", "cameras=[fornt]")
    assert done.exit_code == 2
    assert "cameras: expected only ['front'], got 'fornt'; did you mean 'front'" in done.stderr
    assert not (tmp_path / "x.mcap").exists()
    assert not list(tmp_path.glob("*.part"))


def test_an_evaluation_without_trajectories_is_an_error(config: Config, tmp_path: Path) -> None:
    results = play(config(episodes=1))
    with pytest.raises(ConfigError, match="expected trajectories, got none; evaluate with"):
        results_to_mcap(results, tmp_path / "x.mcap")


@pytest.mark.parametrize("quality", [0, 101])
def test_a_quality_that_jpeg_does_not_have(results: Results, tmp_path: Path, quality: int) -> None:
    message = f"quality: expected a number from 1 to 100, got {quality}"
    with pytest.raises(ConfigError, match=message):
        results_to_mcap(results, tmp_path / "x.mcap", quality=quality)


def robot_recording(folder: Path, *, interventions: bool) -> list[float]:
    """Record two episodes of a robot, and return the times of their frames, s."""
    times = []
    with Recorder(folder, 10, interventions=interventions) as recorder:
        for episode in range(2):
            with recorder.episode("count"):
                for i in range(4):
                    captured_at = 1_800_000_000.0 + 10 * episode + 0.1 * i
                    image = np.full((32, 48, 3), 40 * i, np.uint8)
                    state = {"joints": np.array([i, 2 * i], np.float32)}
                    obs = Obs({"front": image}, 0.5, state, {"captured_at": captured_at})
                    recorder.add(obs, np.array([i + 1, 2 * i + 2], np.float32), tick=i)
                    times.append(captured_at)
    return times


@pytest.mark.parametrize("interventions", [False, True], ids=["plain", "with interventions"])
def test_a_robots_recording_has_the_times_of_its_cameras(
    tmp_path: Path, interventions: bool
) -> None:
    times = robot_recording(tmp_path / "arm", interventions=interventions)
    file = tmp_path / "arm.mcap"
    done = export(tmp_path / "arm", file, "--set", "quality=100")
    assert done.exit_code == 0, done.output
    assert "wrote 2 episodes" in done.output

    topics = read(file)
    expected_times = [round(time * NS) for time in times]
    for topic in ("/camera/front", "/state/joints", "/state/gripper", "/action"):
        assert topics[topic].times == expected_times
    counted = [[i, 2 * i] for i in range(4)] * 2
    assert topics["/state/joints"].values() == counted
    assert topics["/state/gripper"].values() == [[0.5]] * 8
    assert topics["/action"].values() == [[first + 1, second + 2] for first, second in counted]
    assert topics["/action"].messages[0]["names"] == ["action_0", "action_1"]
    assert [one["episode"] for one in topics["/episode"].messages] == ["arm#0", "arm#1"]
    means = [float(image.mean()) for image in topics["/camera/front"].images()]
    assert means == pytest.approx([0, 40, 80, 120] * 2, abs=3)
    assert ("/policy_action" in topics) == interventions
    assert ("/outcome" in topics) == interventions


def test_images_that_a_dataset_embeds_stay_as_they_are(tmp_path: Path) -> None:
    files = embed_images(tmp_path / "public")
    file = tmp_path / "public.mcap"
    assert dataset_to_mcap(tmp_path / "public", file) == 1
    topic = read(file)["/camera/front"]
    assert [base64.b64decode(message["data"]) for message in topic.messages] == files
    assert [message["format"] for message in topic.messages] == ["jpeg", "png"]
    # Without times of the cameras, frames follow at the dataset's rate.
    assert topic.times == [0, NS // 5]


def embed_images(root: Path) -> list[bytes]:
    """Write a dataset of two frames at 5 Hz, whose images are files in the table; return them."""
    image = np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8)
    png = jpeg_png.encode_png(image)
    files = [jpeg_png.encode_jpeg(image, 50), bytes(png)]
    rows = {
        "action": [[0.0, 1.0], [2.0, 3.0]],
        "observation.state": [[0.0, 0.5], [1.0, 1.5]],
        "observation.images.front": [{"bytes": data, "path": None} for data in files],
        "episode_index": [0, 0],
    }
    (root / "data/chunk-000").mkdir(parents=True)
    pq.write_table(pa.table(rows), root / "data/chunk-000/episode_000000.parquet")
    features = {
        "action": {"dtype": "float32", "shape": [2], "names": ["x", "y"]},
        "observation.state": {"dtype": "float32", "shape": [2], "names": None},
        "observation.images.front": {"dtype": "image", "shape": [24, 32, 3], "names": None},
    }
    info = {
        "codebase_version": "v2.1",
        "fps": 5,
        "chunks_size": 1000,
        "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
        "features": features,
    }
    (root / "meta").mkdir()
    (root / "meta/info.json").write_text(json.dumps(info))
    row = {"episode_index": 0, "tasks": ["look"], "length": 2}
    (root / "meta/episodes.jsonl").write_text(json.dumps(row) + "\n")
    return files


def test_the_sessions_of_a_server_have_their_own_topics(tmp_path: Path) -> None:
    with recorded(tmp_path / "served") as server:
        for number in range(2):
            server.robot().play(3, seed=number, first=10 * number)
    file = tmp_path / "served.mcap"
    assert dataset_to_mcap(tmp_path / "served", file) == 2
    topics = read(file)
    assert {topic.split("/")[1] for topic in topics} == {"session_0", "session_1"}
    assert len(topics["/session_1/action"].messages) == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--to", "csv"], "expected a format for a LeRobotDataset, one of ['mcap'], got 'csv'"),
        (["--policy", "noop"], "expected results of an evaluation with --policy and --env"),
        (["--set", "successes=true"], "there is no such setting"),
    ],
)
def test_what_a_dataset_does_not_have(tmp_path: Path, words: list[str], message: str) -> None:
    robot_recording(tmp_path / "arm", interventions=False)
    done = export(tmp_path / "arm", tmp_path / "x.mcap", *words)
    assert done.exit_code == 2
    assert message in " ".join(done.stderr.split())


def test_a_reward_that_is_not_a_number_is_null(
    results: Results, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = Trajectory.load.__func__  # type: ignore[attr-defined]

    def with_nan(path: Path) -> Trajectory:
        trajectory: Trajectory = load(Trajectory, path)
        trajectory.rewards[0] = np.nan
        return trajectory

    monkeypatch.setattr(Trajectory, "load", with_nan)
    results_to_mcap(results, tmp_path / "x.mcap")
    assert read(tmp_path / "x.mcap")["/outcome"].messages[0]["reward"] is None
