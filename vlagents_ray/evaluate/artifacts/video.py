"""Videos of episodes, as H.264 in MP4, which browsers play.

Frames are encoded at once, in the worker: at 224x224 a frame takes about 0.3 ms, less than a JPEG, so there is no
thread and no backlog. The file is made in memory and sent to the driver with the episode's result, which works on any
node and leaves no partial files of a worker that dies.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path

from vlagents_ray.errors import EnvFailed, InvalidObservation
from vlagents_ray.evaluate.artifacts.storage import VIDEOS, episode_folder, outcome, remove_old, stem, whole
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.images.mp4 import Mp4
from vlagents_ray.interface import Obs
from vlagents_ray.naming import distinct

DEFAULT_FPS = 20.0  # for an env whose contract has no control rate


@dataclass(frozen=True, slots=True)
class Footage:
    """MP4 files by camera, each with a frame for every observation; {} if they are not recorded."""

    shown: dict[str, bytes] = field(default_factory=dict)  # for people
    seen: dict[str, bytes] = field(default_factory=dict)  # for the trajectory


class VideoRecorder:
    """Videos of one episode, one for each camera. Use as a context manager, whose end frees the encoders."""

    def __init__(self, fps: float | None = None) -> None:
        self._fps = fps or DEFAULT_FPS
        self._tracks: dict[str, tuple[io.BytesIO, Mp4]] = {}  # by camera

    def add(self, obs: Obs) -> None:
        """Append every camera's image, (H, W, 3) uint8 RGB."""
        for name, image in obs.cameras.items():
            if name not in self._tracks:
                file = io.BytesIO()
                self._tracks[name] = file, Mp4(file, image.shape, self._fps)
            try:
                self._tracks[name][1].add(image)
            except InvalidObservation as error:
                raise EnvFailed(f"camera {name!r}: {error}") from error

    def finish(self) -> dict[str, bytes]:
        """Finish the videos, by camera; the recorder is empty afterwards."""
        videos: dict[str, bytes] = {}
        while self._tracks:
            name, (file, track) = self._tracks.popitem()
            track.finish()
            videos[name] = file.getvalue()
        return dict(sorted(videos.items()))

    def close(self) -> None:
        while self._tracks:
            self._tracks.popitem()[1][1].abandon()

    def __enter__(self) -> VideoRecorder:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def save_videos(out: Path, cell: EvalCase, result: EpisodeResult, videos: dict[str, bytes]) -> list[str]:
    """Write `out/videos/POLICY/SUITE/ENV/epNNNN_seedS_OUTCOME_CAMERA.mp4`; returns the paths relative to `out`.

    A suite without a name has no folder. Two cameras never share a file (`vlagents_ray.naming.distinct`).

    Each file is complete once it has its name. Files of an earlier attempt at the episode are removed.
    """
    folder = episode_folder(out, VIDEOS, cell)
    remove_old(folder, result.key)
    written = []
    names = distinct(videos)
    for camera, data in videos.items():
        path = folder / f"{stem(result.key)}_{outcome(result)}_{names[camera]}.mp4"
        with whole(path) as part:
            part.write_bytes(data)
        written.append(str(path.relative_to(out)))
    return written
