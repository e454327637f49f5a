"""What the cameras saw, as H.264 in MP4 that a browser plays.

Frames are encoded as they come, in the worker: at 224x224 a frame takes about 0.3 ms, less than
keeping it as a JPEG would, so there is no thread and no backlog. The file is made in memory and travels
to the driver with the episode's result; that works on any node, and nothing half-written is left
by a worker that dies.
"""

from __future__ import annotations

import io
import os
import re
from pathlib import Path

from vlagents_ray.errors import EnvFailed, InvalidObservation
from vlagents_ray.evaluate.cells import Cell
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.jobs import EpisodeKey
from vlagents_ray.interface import HIGH_RES, Obs
from vlagents_ray.mp4 import Mp4

DEFAULT_FPS = 20.0  # of an env whose contract states no control rate


class VideoRecorder:
    """Videos of one episode, one a camera. Use as a context manager: leaving it frees the encoders."""

    def __init__(self, fps: float | None = None) -> None:
        self._fps = fps or DEFAULT_FPS
        self._tracks: dict[str, tuple[io.BytesIO, Mp4]] = {}

    def add(self, obs: Obs) -> None:
        """Append every camera's image, (H, W, 3) uint8 RGB; a high-resolution view replaces its camera's."""
        for name, image in (obs.cameras | obs.info.get(HIGH_RES, {})).items():
            if name not in self._tracks:
                file = io.BytesIO()
                self._tracks[name] = file, Mp4(file, image.shape, self._fps)
            try:
                self._tracks[name][1].add(image)
            except InvalidObservation as error:
                raise EnvFailed(f"camera {name!r}: {error}") from error

    def finish(self) -> dict[str, bytes]:
        """The MP4 files by camera; the recorder is empty afterwards."""
        videos = {}
        while self._tracks:
            name, (file, track) = self._tracks.popitem()
            track.finish()
            videos[name] = file.getvalue()
        return dict(sorted(videos.items()))

    def __enter__(self) -> VideoRecorder:
        return self

    def __exit__(self, *exc: object) -> None:
        while self._tracks:
            self._tracks.popitem()[1][1].abandon()


def save_videos(out: Path, cell: Cell, result: EpisodeResult, videos: dict[str, bytes]) -> list[str]:
    """Write `out/videos/POLICY/SUITE/ENV/epNNNN_seedS_OUTCOME_CAMERA.mp4`; returns the paths relative to `out`.

    A suite without a name has no folder.

    Each file is whole from the moment it has its name, and what an earlier attempt at the episode
    left is removed.
    """
    folder = out.joinpath("videos", *(_plain(part) for part in cell.name if part))
    stem = _stem(result.key)
    for old in folder.glob(f"{stem}_*"):
        old.unlink()
    if not videos:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for camera, data in videos.items():
        path = folder / f"{stem}_{_outcome(result)}_{_plain(camera)}.mp4"
        part = path.with_suffix(".part")
        part.write_bytes(data)
        os.replace(part, path)
        written.append(str(path.relative_to(out)))
    return written


def _stem(key: EpisodeKey) -> str:
    return f"ep{key.episode:04d}_seed{key.seed}"


def _outcome(result: EpisodeResult) -> str:
    if result.status != "done":
        return result.status
    return "success" if result.success_once else "failure"


def _plain(name: str) -> str:
    """`name` as a part of a file's name: "maniskill/PushCube-v1" -> "maniskill_PushCube-v1"."""
    return re.sub(r"[^\w.-]+", "_", name)
