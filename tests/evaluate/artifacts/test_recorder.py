"""The recordings of an episode, and their places."""

from __future__ import annotations

import hashlib
import io
import os
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from eval_fakes import SPARING_LINE, ToZero
from in_process_evaluation import play

from vlagents_ray.errors import ConfigError, EnvFailed
from vlagents_ray.evaluate import ClockConfig, EvalConfig, PolicyConfig, SuiteConfig, WorkerConfig
from vlagents_ray.evaluate.artifacts.recorder import (
    NO_VERSION,
    Recording,
    Trajectory,
    TrajectoryRecorder,
    VideoRecorder,
    save_videos,
    videos_of,
)
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs

Config = Callable[..., EvalConfig]
CAMERA = {"camera": [32, 32]}


def test_a_trajectory_is_what_was_seen_and_done(config: Config) -> None:
    results = play(config(episodes=4, record="all", env_options=CAMERA))
    for episode in results.cases[0].episodes:
        result = episode.result
        path = results.out / str(episode.trajectory)
        found = Trajectory.load(path)
        assert found.actions.shape == (result.steps, 1)
        assert found.rewards.sum() == pytest.approx(result.episode_return)
        assert bool(found.success[-1]) == result.success_at_end
        assert bool(found.success.any()) == result.success_once
        moves = np.clip(found.actions, -1, 1)
        assert np.diff(found.state["position"], axis=0) == pytest.approx(moves, abs=1e-5)
        assert hashlib.sha256(found.actions.tobytes()).hexdigest() == result.actions_sha256
        with av.open(str(videos_of(path, ["front"])["front"])) as video:
            assert sum(1 for _ in video.decode(video=0)) == result.steps + 1


@pytest.mark.parametrize(
    ("record", "kept"), [("none", [False] * 2), ("failures", [True, False]), ("all", [True] * 2)]
)
def test_trajectories_are_kept_of_the_episodes_that_are_wanted(
    config: Config, record: str, kept: list[bool]
) -> None:
    results = play(config(episodes=12, record=record))
    found = {
        bool(one.result.success_once): one.trajectory is not None
        for one in results.cases[0].episodes
    }
    assert [found[False], found[True]] == kept
    stored = {str(path.relative_to(results.out)) for path in results.out.rglob("*.npz")}
    assert stored == {one.trajectory for one in results.cases[0].episodes} - {None}


def test_a_checkpoint_of_a_sweep_has_not_the_files_of_a_policy_named_almost_like_it(
    config: Config,
) -> None:
    settings = config(episodes=1, record="all", policy="pi0", steps=[2])
    other = settings.policies[0].model_copy(update={"name": "pi0_2", "steps": []})
    results = play(settings.model_copy(update={"policies": [*settings.policies, other]}))
    paths = [episode.trajectory for case in results.cases for episode in case.episodes]
    assert len(set(paths)) == 2


def test_a_video_that_is_also_the_trajectorys_is_there_once(config: Config) -> None:
    results = play(config(episodes=1, record="all", video="all", env_options=CAMERA))
    [episode] = results.cases[0].episodes
    paths = (
        results.out / episode.videos[0],
        videos_of(results.out / str(episode.trajectory), ["front"])["front"],
    )
    assert os.path.samefile(*paths)


class Pushed(ToZero):
    """A policy that returns chunks of two rows, each from a newer version of the weights."""

    def __init__(self) -> None:
        super().__init__(chunk=2)
        self.version = 0

    def act(self, obs: Obs) -> Act:
        self.version += 1
        return replace(
            super().act(obs), info={"policy": {"version": self.version, "fingerprint": "of a test"}}
        )


def versions(config: EvalConfig, make: Callable[[], Agent]) -> list[int]:
    """Return the versions of the weights that chose the actions of the only episode."""
    results = play(config, make)
    found = Trajectory.load(results.out / str(results.cases[0].episodes[0].trajectory)).versions
    assert found is not None
    assert found.dtype == np.int64
    return list(map(int, found))


def test_a_trajectory_names_the_weights_that_chose_each_action(
    config: Config, tmp_path: Path
) -> None:
    recorded = config(episodes=1, record="all")
    assert versions(recorded, Pushed) == [1, 1, 2, 2, 3, 3, 4, 4, 5, 5]
    assert (
        versions(config(episodes=1, record="all", out=tmp_path / "none"), ToZero)
        == [NO_VERSION] * 10
    )


def test_what_is_executed_until_an_answer_comes_is_of_the_weights_before_it(
    config: Config, tmp_path: Path
) -> None:
    [suite] = config().suites
    # One step at 10 Hz.
    late = ClockConfig(latency=0.1, mode="async", neutral=[0.0])
    settings = config(episodes=1, record="all").model_copy(
        update={"suites": [suite.model_copy(update={"clock": late, "episodes": 1})]}
    )
    assert versions(settings, Pushed)[:5] == [NO_VERSION, 1, 2, 3, 4]
    waiting = late.model_copy(update={"mode": "open_loop"})
    waits = suite.model_copy(update={"clock": waiting, "episodes": 1})
    settings = settings.model_copy(update={"suites": [waits], "out": tmp_path / "waits"})
    assert versions(settings, Pushed)[:6] == [NO_VERSION, 1, 1, 1, 2, 2]


def test_nothing_is_encoded_or_collected_unless_it_is_asked_for(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object) -> None:
        raise AssertionError

    monkeypatch.setattr(VideoRecorder, "add_observation", fail)
    monkeypatch.setattr(TrajectoryRecorder, "add_observation", fail)
    with closing(Recording("none", "none", 10.0)) as recording:
        recording.add_observation(Obs(state={"position": np.zeros(1, np.float32)}))
        recording.add_action(np.zeros(1, np.float32), 0.0, False)
        assert not recording.needs_images


def test_an_observation_that_lacks_a_part_of_the_state_is_the_simulators_failure() -> None:
    recorder = TrajectoryRecorder()
    recorder.add_observation(Obs(state={"joints": np.zeros(7, np.float32)}))
    with pytest.raises(
        EnvFailed, match=r"expected.*'joints': \(7,\).*as after reset, got.*'joints': \(6,\)"
    ):
        recorder.add_observation(Obs(state={"joints": np.zeros(6, np.float32)}))


def test_states_of_several_arms_and_a_gripper_survive_the_file(tmp_path: Path) -> None:
    recorder = TrajectoryRecorder()
    for i in range(3):
        parts = {
            "left/joints": np.full(7, i, np.float32),
            "right/joints": np.full(6, -i, np.float32),
        }
        recorder.add_observation(Obs(gripper=i / 2, state=parts))
        if i < 2:
            recorder.add_action(np.full(13, i, np.float32), 0.5, i == 1)
    (tmp_path / "a.npz").write_bytes(recorder.finish().to_bytes())
    found = Trajectory.load(tmp_path / "a.npz")
    assert {part: values.shape for part, values in found.state.items()} == {
        "left/joints": (3, 7),
        "right/joints": (3, 6),
    }
    assert found.gripper is not None
    assert found.gripper.tolist() == [0, 0.5, 1]
    assert found.success.tolist() == [False, True]
    assert found.cameras == ()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"{}"])
def test_a_file_that_is_no_trajectory_is_said_to_be_none(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.npz"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"a\.npz: cannot be read as a trajectory"):
        Trajectory.load(path)


ENV = "maniskill/PushCube-v1"
COLOURS = [(200, 40, 40), (40, 200, 40), (40, 40, 200), (220, 220, 220), (20, 20, 20)]


def record(frames: list[np.ndarray], fps: float | None = None) -> dict[str, bytes]:
    with closing(VideoRecorder(fps)) as recorder:
        for frame in frames:
            recorder.add_observation(Obs(cameras={"front": frame}))
        return recorder.finish()


def plain(colour: tuple[int, int, int], height: int = 64, width: int = 96) -> np.ndarray:
    return np.full((height, width, 3), colour, np.uint8)


def test_a_video_holds_every_frame_in_its_colours() -> None:
    video = record([plain(colour) for colour in COLOURS * 3])["front"]
    with av.open(io.BytesIO(video)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(decoded) == 15
    for image, colour in zip(decoded, COLOURS * 3, strict=True):
        assert image.shape == (64, 96, 3)
        assert np.abs(image.reshape(-1, 3).mean(axis=0) - colour).max() < 8


@pytest.mark.parametrize("fps", [10.0, 12.5, None])
def test_a_video_plays_at_the_control_rate(fps: float | None) -> None:
    with av.open(io.BytesIO(record([plain(COLOURS[0])] * 10, fps)["front"])) as container:
        assert float(container.streams.video[0].average_rate or 0) == pytest.approx(fps or 20.0)


def test_odd_sizes_are_made_even() -> None:
    video = record([plain(COLOURS[1], 65, 97)] * 2)["front"]
    with av.open(io.BytesIO(video)) as container:
        image = next(container.decode(video=0)).to_ndarray(format="rgb24")
    assert image.shape == (66, 98, 3)
    assert np.abs(image.astype(int) - COLOURS[1]).max() < 12


def test_every_camera_has_its_video() -> None:
    with closing(VideoRecorder()) as recorder:
        recorder.add_observation(
            Obs(cameras={"front": plain(COLOURS[0], 128, 128), "wrist": plain(COLOURS[1])})
        )
        videos = recorder.finish()
    sizes = {}
    for camera, video in videos.items():
        with av.open(io.BytesIO(video)) as container:
            sizes[camera] = (container.streams.video[0].height, container.streams.video[0].width)
    assert sizes == {"front": (128, 128), "wrist": (64, 96)}


def test_a_camera_that_changes_its_size_is_an_env_failure() -> None:
    with pytest.raises(EnvFailed, match=r"expected \(64, 96, 3\) .*, got \(32, 32, 3\)"):
        record([plain(COLOURS[0]), plain(COLOURS[0], 32, 32)])


CASE = EvalCase(
    PolicyConfig(name="act", steps=[20]),
    20,
    SuiteConfig(name="unseen", envs=[ENV]),
    ENV,
    WorkerConfig(),
)


def result(success: bool, status: str = "done") -> EpisodeResult:
    key = EpisodeKey(ENV, 3, 3, "0")
    return EpisodeResult(key, status, success_once=success)  # type: ignore[arg-type]


def test_a_video_is_named_by_env_episode_outcome_and_camera(tmp_path: Path) -> None:
    paths = save_videos(tmp_path, CASE, result(True), {"base_camera": b"1", "left/wrist": b"2"})
    assert paths == [
        "videos/act@20/unseen/maniskill_PushCube-v1/ep0003_seed3_success_base_camera.mp4",
        "videos/act@20/unseen/maniskill_PushCube-v1/ep0003_seed3_success_left_wrist.mp4",
    ]
    assert (tmp_path / paths[0]).read_bytes() == b"1"


def test_two_cameras_never_share_a_video(tmp_path: Path) -> None:
    videos = {"left/wrist": b"1", "left_wrist": b"2", "left wrist": b"3"}
    paths = save_videos(tmp_path, CASE, result(True), videos)
    assert [(tmp_path / path).read_bytes() for path in paths] == [b"1", b"2", b"3"]
    assert paths[1].endswith("success_left_wrist.mp4")


def test_a_repeated_episode_replaces_its_videos(tmp_path: Path) -> None:
    save_videos(tmp_path, CASE, result(True), {"front": b"old", "wrist": b"old"})
    folder = tmp_path / "videos" / "act@20" / "unseen" / "maniskill_PushCube-v1"
    (folder / "ep0003_seed3_success_side.part").write_bytes(b"cut off by a crash")
    (folder / "ep0003_seed33_success_front.mp4").write_bytes(b"another episode")
    save_videos(tmp_path, CASE, result(False), {"front": b"new"})
    assert sorted(path.name for path in folder.iterdir()) == [
        "ep0003_seed33_success_front.mp4",
        "ep0003_seed3_failure_front.mp4",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("video", ["none", "failures", "all"])
def test_exact_images_of_a_trajectory_are_those_that_the_policy_got(
    config: Config, video: str
) -> None:
    settings = {"episodes": 12, "record": "all", "video": video, "env_options": CAMERA}
    results = play(config(**settings, record_images="exact"))
    for episode in results.cases[0].episodes:
        path = results.out / str(episode.trajectory)
        recorded = videos_of(path, ["front"])["front"]
        with av.open(str(recorded)) as opened:
            images = [frame.to_ndarray(format="rgb24") for frame in opened.decode(video=0)]
        assert len(images) == episode.result.steps + 1
        for step, image in enumerate(images):
            assert (image == (20 * step, 200 - 20 * step, 60)).all(), "H.264 changes such colours"

        for shown in episode.videos:
            assert not os.path.samefile(results.out / shown, recorded)
            with av.open(str(results.out / shown)) as opened:
                assert opened.streams.video[0].codec_context.pix_fmt == "yuv420p"


def test_failures_that_are_recorded_exactly_have_the_image_of_every_step(
    config: Config,
) -> None:
    settings = {"episodes": 12, "record": "failures", "video": "none", "env_options": CAMERA}
    results = play(config(**settings, envs=[SPARING_LINE], record_images="exact"))
    recorded = [episode for episode in results.cases[0].episodes if episode.trajectory]
    assert recorded
    for episode in recorded:
        video = videos_of(results.out / str(episode.trajectory), ["front"])["front"]
        with av.open(str(video)) as opened:
            assert opened.streams.video[0].codec_context.pix_fmt == "gbrp"
            assert sum(1 for _ in opened.decode(video=0)) == episode.result.steps + 1
