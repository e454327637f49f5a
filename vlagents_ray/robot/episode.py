"""One episode of a recording under way: videos on disk, numbers in memory."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.mp4 import Mp4
from vlagents_ray.robot.statistics import ImageStatistics, Stats

IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"
MOMENTS = {  # what each recorded frame has beside the observation and the action
    "captured_at": "float64",  # s since 1970
    "tick": "int64",  # of the control loop; gaps are frames that were missed or dropped
    "safe": "bool",  # the action was the safe one, not the policy's
}
INDEX = {  # what the dataset adds to each
    "timestamp": "float32",  # s, frame_index / fps
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_KEY_FRAMES = 2  # LeRobot's own, for quick access to any frame


@dataclass(frozen=True, slots=True)
class Finished:
    """An episode as a dataset takes it: N frames, and files that become the dataset's."""

    instruction: str
    features: dict[str, Any]  # as in `meta/info.json`
    rows: dict[str, np.ndarray]  # (N, D) float32, or (N,) of the feature's dtype
    images: dict[str, Stats]  # of the videos' frames
    videos: dict[str, Path]  # MP4s with N frames or more, of which the first N count


class Episode:
    """What is added frame by frame, and saved by the dataset when it is over."""

    def __init__(self, folder: Path, instruction: str, fps: float, features: dict[str, Any] | None) -> None:
        """`features` are the dataset's, which the frames must have; None in a dataset's first episode."""
        self.instruction = instruction
        self.features: dict[str, Any] = features or {}
        self.rows: dict[str, list[Any]] = {}
        self.videos: dict[str, tuple[Path, Mp4]] = {}
        self.images: dict[str, ImageStatistics] = {}
        self._folder = folder
        self._fps = fps

    def add(self, obs: Obs, action: np.ndarray, captured_at: float, tick: int, safe: bool) -> None:
        """Append a frame; `InvalidObservation` if it is not like those before it."""
        values, names = state_vector(obs.state, None if obs.gripper is None else np.array(obs.gripper))
        if not self.rows:
            self._first(obs, names, len(action))
        if {camera_key(name) for name in obs.cameras} != self.videos.keys():
            raise InvalidObservation(
                f"recording: got cameras {sorted(obs.cameras)}, want those of {sorted(self.videos)}"
            )
        for name, shape in ((STATE, values.shape), (ACTION, action.shape)):
            wanted = tuple(self.features[name]["shape"]) if name in self.features else (0,)
            if shape != wanted:
                raise InvalidObservation(f"recording: got {name} of {shape}, want {wanted} as in the first frame")
        for name, image in obs.cameras.items():
            key = camera_key(name)
            self.videos[key][1].add(image)
            self.images[key].add(image)
        frame = {ACTION: np.asarray(action, np.float32), "captured_at": captured_at, "tick": tick, "safe": safe}
        if len(values):
            frame[STATE] = values
        for key, value in frame.items():
            self.rows.setdefault(key, []).append(value)

    def finish(self) -> Finished:
        """What was added, its videos whole."""
        for _, video in self.videos.values():
            video.finish()
        return Finished(
            self.instruction,
            self.features,
            {key: np.stack(values) for key, values in self.rows.items()},
            {key: images.result() for key, images in self.images.items()},
            {key: path for key, (path, _) in self.videos.items()},
        )

    def abandon(self) -> None:
        """Give up what was recorded of it."""
        for _, video in self.videos.values():
            video.abandon()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _first(self, obs: Obs, names: list[str], action_dim: int) -> None:
        features: dict[str, Any] = {}
        for name, image in sorted(obs.cameras.items()):
            key = camera_key(name)
            path = self._folder / f"{key}.mp4"
            video = Mp4(path, image.shape, self._fps, key_frames=_KEY_FRAMES)
            self.videos[key], self.images[key] = (path, video), ImageStatistics()
            height, width = video.size
            features[key] = video_feature(height, width, self._fps)
        if names:
            features[STATE] = vector_feature(names)
        features[ACTION] = vector_feature([f"action_{i}" for i in range(action_dim)])
        features |= number_features(MOMENTS | INDEX)
        if self.features and self.features != features:
            odd = sorted(k for k in self.features.keys() | features.keys() if self.features.get(k) != features.get(k))
            raise InvalidObservation(f"recording: {odd} differ from the dataset's; record into a new folder")
        self.features = features


def camera_key(name: str) -> str:
    """A camera's feature; LeRobot allows no slash in it."""
    return IMAGES + name.replace("/", "_")


def video_feature(height: int, width: int, fps: float) -> dict[str, Any]:
    """Of a camera whose videos have that size, in pixels, and rate, in Hz."""
    size = {"video.height": height, "video.width": width, "video.fps": fps, "video.channels": 3}
    kind = {"video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "has_audio": False}
    names = ["height", "width", "channels"]
    return {"dtype": "video", "shape": [height, width, 3], "names": names, "info": size | kind}


def vector_feature(names: list[str]) -> dict[str, Any]:
    """Of as many numbers as there are names."""
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def number_features(dtypes: Mapping[str, str]) -> dict[str, Any]:
    """Of one number each."""
    return {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in dtypes.items()}


def state_vector(parts: Mapping[str, np.ndarray], gripper: np.ndarray | None) -> tuple[np.ndarray, list[str]]:
    """All proprioception side by side, (..., D) float32, as LeRobot's policies take it, and what its numbers are.

    `parts` are (..., d) each, the gripper's opening (...,).
    """
    parts = dict(sorted(parts.items()))
    names = [f"{part}_{i}" for part, values in parts.items() for i in range(values.shape[-1])]
    columns = [*parts.values(), *([] if gripper is None else [gripper[..., np.newaxis]])]
    values = np.concatenate(columns, axis=-1) if columns else np.zeros(0)
    return values.astype(np.float32), names + ["gripper"] * (gripper is not None)
