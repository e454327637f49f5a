"""One episode of a recording under way: videos on disk, numbers in memory."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Obs
from vlagents_ray.mp4 import Mp4
from vlagents_ray.robot.statistics import ImageStatistics

IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"
NUMBERS = {  # what each frame has beside the observation and the action
    "captured_at": "float64",  # s since 1970
    "tick": "int64",  # of the control loop; gaps are frames that were missed or dropped
    "safe": "bool",  # the action was the safe one, not the policy's
    "timestamp": "float32",  # s, frame_index / fps
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_KEY_FRAMES = 2  # LeRobot's own, for quick access to any frame


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
        values, names = _state(obs)
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
            features[key] = {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": _video_info(height, width, self._fps),
            }
        if names:
            features[STATE] = {"dtype": "float32", "shape": [len(names)], "names": names}
        features[ACTION] = {
            "dtype": "float32", "shape": [action_dim], "names": [f"action_{i}" for i in range(action_dim)]
        }  # fmt: skip
        features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in NUMBERS.items()}
        if self.features and self.features != features:
            odd = sorted(k for k in self.features.keys() | features.keys() if self.features.get(k) != features.get(k))
            raise InvalidObservation(f"recording: {odd} differ from the dataset's; record into a new folder")
        self.features = features


def camera_key(name: str) -> str:
    """A camera's feature; LeRobot allows no slash in it."""
    return IMAGES + name.replace("/", "_")


def _state(obs: Obs) -> tuple[np.ndarray, list[str]]:
    """All proprioception as one vector, as LeRobot's policies take it, and what its numbers are."""
    parts = dict(sorted(obs.state.items()))
    names = [f"{part}_{i}" for part, values in parts.items() for i in range(len(values))]
    gripper = [] if obs.gripper is None else [np.array([obs.gripper])]
    values = np.concatenate([*parts.values(), *gripper]) if parts or gripper else np.zeros(0)
    return values.astype(np.float32), names + ["gripper"] * len(gripper)


def _video_info(height: int, width: int, fps: float) -> dict[str, Any]:
    size = {"video.height": height, "video.width": width, "video.fps": fps, "video.channels": 3}
    kind = {"video.codec": "h264", "video.pix_fmt": "yuv420p", "video.is_depth_map": False, "has_audio": False}
    return size | kind
