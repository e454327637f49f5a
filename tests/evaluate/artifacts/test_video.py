from __future__ import annotations

import io
from pathlib import Path

import av
import numpy as np
import pytest

from vlagents_ray.errors import EnvFailed
from vlagents_ray.evaluate import PolicyConfig, SuiteConfig, WorkerConfig
from vlagents_ray.evaluate.artifacts.video import VideoRecorder, save_videos
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Obs

ENV = "maniskill/PushCube-v1"
COLOURS = [(200, 40, 40), (40, 200, 40), (40, 40, 200), (220, 220, 220), (20, 20, 20)]


def record(frames: list[np.ndarray], fps: float | None = None) -> dict[str, bytes]:
    with VideoRecorder(fps) as recorder:
        for frame in frames:
            recorder.add(Obs(cameras={"front": frame}))
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
    with VideoRecorder() as recorder:
        recorder.add(Obs(cameras={"front": plain(COLOURS[0], 128, 128), "wrist": plain(COLOURS[1])}))
        videos = recorder.finish()
    sizes = {}
    for camera, video in videos.items():
        with av.open(io.BytesIO(video)) as container:
            sizes[camera] = (container.streams.video[0].height, container.streams.video[0].width)
    assert sizes == {"front": (128, 128), "wrist": (64, 96)}


def test_a_camera_that_changes_its_size_is_an_env_failure() -> None:
    with pytest.raises(EnvFailed, match=r"want \(64, 96, 3\)"):
        record([plain(COLOURS[0]), plain(COLOURS[0], 32, 32)])


CELL = EvalCase(PolicyConfig(name="act", steps=[20]), 20, SuiteConfig(name="unseen", envs=[ENV]), ENV, WorkerConfig())


def result(success: bool, status: str = "done") -> EpisodeResult:
    key = EpisodeKey(ENV, 3, 3, "0")
    return EpisodeResult(key, status, success_once=success)  # type: ignore[arg-type]


def test_a_video_is_named_by_env_episode_outcome_and_camera(tmp_path: Path) -> None:
    paths = save_videos(tmp_path, CELL, result(True), {"base_camera": b"1", "left/wrist": b"2"})
    assert paths == [
        "videos/act@20/unseen/maniskill_PushCube-v1/ep0003_seed3_success_base_camera.mp4",
        "videos/act@20/unseen/maniskill_PushCube-v1/ep0003_seed3_success_left_wrist.mp4",
    ]
    assert (tmp_path / paths[0]).read_bytes() == b"1"


def test_two_cameras_never_share_a_video(tmp_path: Path) -> None:
    videos = {"left/wrist": b"1", "left_wrist": b"2", "left wrist": b"3"}
    paths = save_videos(tmp_path, CELL, result(True), videos)
    assert [(tmp_path / path).read_bytes() for path in paths] == [b"1", b"2", b"3"]
    assert paths[1].endswith("success_left_wrist.mp4")


def test_a_repeated_episode_replaces_its_videos(tmp_path: Path) -> None:
    save_videos(tmp_path, CELL, result(True), {"front": b"old", "wrist": b"old"})
    folder = tmp_path / "videos" / "act@20" / "unseen" / "maniskill_PushCube-v1"
    (folder / "ep0003_seed3_success_side.part").write_bytes(b"cut off by a crash")
    (folder / "ep0003_seed33_success_front.mp4").write_bytes(b"another episode")
    save_videos(tmp_path, CELL, result(False), {"front": b"new"})
    assert sorted(path.name for path in folder.iterdir()) == [
        "ep0003_seed33_success_front.mp4",
        "ep0003_seed3_failure_front.mp4",
    ]
