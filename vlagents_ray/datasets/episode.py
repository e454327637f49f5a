"""A running episode, with its videos on disk and its numbers in memory, and the statistics of a
complete episode.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.dataset_contract import GRIPPER, DatasetContract
from vlagents_ray.errors import InvalidObservation
from vlagents_ray.images.mp4 import Mp4
from vlagents_ray.interface import Obs
from vlagents_ray.naming import distinct

IMAGES, STATE, ACTION = "observation.images.", "observation.state", "action"
ENVIRONMENT = "observation.environment_state"
TICK_COLUMN, SAFE_COLUMN = "tick", "safe"
MOMENTS = {  # names of further columns of each recorded frame
    "captured_at": "float64",  # time of the frame, s since 1970
    TICK_COLUMN: "int64",  # tick of the control loop; gaps are missed or dropped frames
    SAFE_COLUMN: "bool",  # whether the action is a safe action instead of the policy's action
}
WANTED_ACTION, INTERVENTION_COLUMN = "policy_action", "intervention"
# Further columns of a recording with interventions, in addition to `WANTED_ACTION`, (D,) float32.
INTERVENTIONS = {
    INTERVENTION_COLUMN: "bool",  # whether an operator chose the action
    # Whether the policy's action is known; if not, `WANTED_ACTION` is zeros.
    "policy_known": "bool",
}
# LeRobot's own names for the outcome of an action. `success` belongs to the state after the action.
OUTCOMES = {"next.reward": "float32", "next.success": "bool", "next.done": "bool"}
Stats = dict[str, np.ndarray]  # "min", "max", "mean", "std", "count", "q01", ...
Label = Literal["success", "failure", "discard"]
INDEX = {  # names of columns that the dataset adds to each frame
    "timestamp": "float32",  # time in the episode, s: frame_index / fps
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_DTYPES = {bool: "bool", int: "int64", float: "float64", str: "string"}
_KEY_FRAMES = 2  # interval of key frames in frames, as in LeRobot, for quick access to any frame


@dataclass(frozen=True, slots=True)
class FinishedEpisode:
    """A complete episode of N frames, whose files are moved into the dataset."""

    instructions: Sequence[str]  # the instruction of each frame
    features: dict[str, Any]  # descriptions of the features, as in `meta/info.json`
    # The values of each feature: (N, D) float32, (N,) of the feature's dtype, or (N,) objects for
    # texts.
    rows: dict[str, np.ndarray]
    images: dict[str, Stats]  # statistics of the videos' frames
    videos: dict[str, Path]  # MP4 files with at least N frames, of which the first N are used
    about: DatasetContract  # the same for each episode of a dataset
    label: Label | None = None
    # The folder of the running episode. It is removed with all files that are left in it.
    folder: Path | None = None


@dataclass(slots=True, eq=False)
class RunningEpisode:
    """A running episode, to which frames are added."""

    folder: Path  # folder of the episode's videos
    instruction: str
    fps: float
    features: dict[str, Any]  # features of earlier episodes; empty in the first episode
    interventions: bool
    lossless: bool
    meaning: ActionSpec
    rows: dict[str, list[Any]] = field(default_factory=dict)
    videos: dict[str, tuple[Path, Mp4]] = field(default_factory=dict)
    images: dict[str, ImageStatistics] = field(default_factory=dict)
    about: DatasetContract = field(default_factory=lambda: DatasetContract(Contract()))

    def add(
        self,
        obs: Obs,
        action: np.ndarray,
        captured_at: float,
        tick: int,
        safe: bool,
        intervention: bool = False,
        policy_action: np.ndarray | None = None,
        more: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        """Append a frame; raises `InvalidObservation` if cameras or shapes differ from earlier
        frames.

        `policy_action` is the policy's action, (D,), if another action was executed; None if it is
        unknown. `more` contains further columns by name, which must be the same in each frame. A
        value is a bool, int, float, text, or (D,) float32.
        """
        values, names = state_vector(
            obs.state, None if obs.gripper is None else np.array(obs.gripper)
        )
        if not self.rows:
            self._first(obs, names, len(action), more)

        keys = camera_keys(obs.cameras)
        if set(keys.values()) != self.videos.keys():
            raise InvalidObservation(
                f"recording: expected the cameras {sorted(self.videos)} as in the first frame, "
                f"got {sorted(obs.cameras)}"
            )
        for name, shape in ((STATE, values.shape), (ACTION, action.shape)):
            first = tuple(self.features[name]["shape"]) if name in self.features else (0,)
            if shape != first:
                raise InvalidObservation(
                    f"recording: expected {name} of {first} as in the first frame, got {shape}"
                )

        for name, image in obs.cameras.items():
            self.videos[keys[name]][1].add(image)
            self.images[keys[name]].add(image)
        frame: dict[str, Any] = {
            ACTION: np.asarray(action, np.float32),
            "captured_at": captured_at,
            TICK_COLUMN: tick,
            SAFE_COLUMN: safe,
            **more,
        }
        if len(values):
            frame[STATE] = values
        if self.interventions:
            if not safe and not intervention:
                policy_action = action
            is_known = policy_action is not None
            frame[WANTED_ACTION] = (
                np.asarray(policy_action, np.float32) if is_known else np.zeros_like(frame[ACTION])
            )
            frame |= {INTERVENTION_COLUMN: intervention, "policy_known": is_known}

        for key, value in frame.items():
            self.rows.setdefault(key, []).append(value)

    def finish(self, label: Label | None = None) -> FinishedEpisode:
        """Complete the videos, and return the episode."""
        for _, video in self.videos.values():
            video.finish()

        rows = {}
        for key, values in self.rows.items():
            is_text = isinstance(values[0], str)
            rows[key] = np.array(values, object) if is_text else np.stack(values)
        if self.interventions:
            success = np.zeros(len(rows[ACTION]), bool)
            success[-1] = label == "success"
            rows |= outcome_rows(success, success)
        return FinishedEpisode(
            [self.instruction] * len(rows[ACTION]),
            self.features,
            rows,
            {key: images.result() for key, images in self.images.items()},
            {key: path for key, (path, _) in self.videos.items()},
            self.about,
            label,
            self.folder,
        )

    def abandon(self) -> None:
        """Remove the episode's files."""
        for _, video in self.videos.values():
            video.abandon()
        shutil.rmtree(self.folder, ignore_errors=True)

    def _first(self, obs: Obs, names: list[str], action_dim: int, more: Mapping[str, Any]) -> None:
        """Begin the videos, and determine the features and the contract from the first frame."""
        features: dict[str, Any] = {}
        keys = camera_keys(obs.cameras)
        for name, image in sorted(obs.cameras.items()):
            key = keys[name]
            path = self.folder / f"{key}.mp4"
            video = Mp4(path, image.shape, self.fps, key_frames=_KEY_FRAMES, lossless=self.lossless)
            self.videos[key], self.images[key] = (path, video), ImageStatistics()
            height, width = video.size
            features[key] = video_feature(
                height, width, self.fps, "gbrp" if self.lossless else "yuv420p"
            )

        if names:
            features[STATE] = vector_feature(names)
        features[ACTION] = vector_feature([f"action_{i}" for i in range(action_dim)])
        if self.interventions:
            features |= {WANTED_ACTION: features[ACTION]} | number_features(
                INTERVENTIONS | OUTCOMES
            )
        features |= number_features(MOMENTS | INDEX)
        for name, value in more.items():
            dtype = "float32" if isinstance(value, np.ndarray) else _DTYPES[type(value)]
            features[name] = {"dtype": dtype, "shape": [np.size(value)], "names": None}
        if self.features and self.features != features:
            keys_of_both = sorted(self.features.keys() | features.keys())
            differing = [key for key in keys_of_both if self.features.get(key) != features.get(key)]
            raise InvalidObservation(
                f"recording: {differing} differ from the dataset's; record into a new folder"
            )
        self.features = features

        parts = parts_of(obs.state, obs.gripper is not None)
        state_names = [name for name in parts if name != GRIPPER or obs.gripper is None]
        self.about = DatasetContract(
            Contract(
                cameras={name: CameraSpec(*image.shape[:2]) for name, image in obs.cameras.items()},
                state={name: StateSpec(len(obs.state[name])) for name in state_names},
                gripper=obs.gripper is not None,
                action=replace(self.meaning, dim=action_dim),
                control_hz=self.fps,
            ),
            tuple(parts),
            {key: name for name, key in keys.items()},
        )


def parts_of(state: Iterable[str], gripper: bool) -> list[str]:
    """Return the parts of the proprioception in the order of `observation.state`.

    If an observation has `Obs.gripper`, "gripper" is `Obs.gripper`, and a part of the state with
    that name is omitted.
    """
    if not gripper:
        return sorted(state)
    return [*sorted(name for name in state if name != GRIPPER), GRIPPER]


def camera_keys(names: Iterable[str]) -> dict[str, str]:
    """Return a distinct feature name for each camera."""
    return {name: IMAGES + key for name, key in distinct(names, without_slash).items()}


def without_slash(name: str) -> str:
    """Replace the slashes in a name, since LeRobot allows no slashes in a feature's name."""
    return name.replace("/", "_")


def video_feature(height: int, width: int, fps: float, pixels: str = "yuv420p") -> dict[str, Any]:
    """Describe the feature of a camera from the size of its videos, pixels, their rate, Hz, and
    their pixel format.
    """
    size = {"video.height": height, "video.width": width, "video.fps": fps, "video.channels": 3}
    kind = {
        "video.codec": "h264",
        "video.pix_fmt": pixels,
        "video.is_depth_map": False,
        "has_audio": False,
    }
    names = ["height", "width", "channels"]
    return {"dtype": "video", "shape": [height, width, 3], "names": names, "info": size | kind}


def vector_feature(names: list[str]) -> dict[str, Any]:
    """Describe a feature of several numbers, one for each name."""
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def number_features(dtypes: Mapping[str, str]) -> dict[str, Any]:
    """Describe features of one number each."""
    return {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in dtypes.items()}


def outcome_rows(rewards: np.ndarray, success: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of `OUTCOMES` for an episode, (N,) each.

    The last frame is marked as done.
    """
    done = np.arange(len(success)) == len(success) - 1
    return dict(zip(OUTCOMES, (rewards.astype(np.float32), success, done), strict=True))


def state_vector(
    parts: Mapping[str, np.ndarray], gripper: np.ndarray | None, order: Iterable[str] | None = None
) -> tuple[np.ndarray, list[str]]:
    """Concatenate the parts of the proprioception, (..., d) each, as LeRobot's policies expect
    them, in `order`.

    `gripper`, (...,), is the opening of the gripper. Returns the numbers, (..., D) float32, and a
    name for each of the D numbers.
    """
    if order is None:
        order = parts_of(parts, gripper is not None)

    columns: list[np.ndarray] = []
    names: list[str] = []
    for name in order:
        if name == GRIPPER and gripper is not None:
            columns.append(gripper[..., np.newaxis])
            names.append(GRIPPER)
        else:
            columns.append(parts[name])
            names += [f"{name}_{i}" for i in range(parts[name].shape[-1])]
    values = np.concatenate(columns, axis=-1) if columns else np.zeros(0)
    return values.astype(np.float32), names


# Functions that compute the statistics of recorded features for LeRobot's normalisation (0.4.4,
# `lerobot/datasets/compute_stats.py`).

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_PIXEL_STRIDE = 4  # step between sampled pixels in both directions; LeRobot also samples pixels


def of_values(values: np.ndarray) -> Stats:
    """Compute the statistics of one episode's rows, (N, D) -> (D,) each; `count` is (1,)."""
    values = values.astype(np.float64)
    return {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        "count": np.array([len(values)]),
        **{name: np.quantile(values, q, axis=0) for name, q in _QUANTILES.items()},
    }


class ImageStatistics:
    """The statistics of one camera's pixels in one episode, for each channel, in [0, 1], (3, 1, 1)
    each.
    """

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), np.int64)
        self._images = 0

    def add(self, image: np.ndarray) -> None:
        """Add a sample of the pixels of an image, (H, W, 3) uint8."""
        sample = image[::_PIXEL_STRIDE, ::_PIXEL_STRIDE]
        for channel in range(3):
            self._counts[channel] += np.bincount(sample[..., channel].ravel(), minlength=256)
        self._images += 1

    def result(self) -> Stats:
        """Return the statistics of all images, with the keys of `of_values`."""
        levels = np.arange(256) / 255
        share = self._counts / self._counts.sum(1, keepdims=True)
        mean = share @ levels
        below = np.cumsum(share, axis=1)

        def quantile(q: float) -> np.ndarray:
            return np.asarray(levels[np.argmax(below >= min(q, 1 - 1e-9), axis=1)])

        stats = {
            "min": quantile(1e-12),
            "max": levels[255 - np.argmax(self._counts[:, ::-1] > 0, axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(share @ levels**2 - mean**2, 0)),
            **{name: quantile(q) for name, q in _QUANTILES.items()},
        }
        return {name: value.reshape(3, 1, 1) for name, value in stats.items()} | {
            "count": np.array([self._images])
        }


def joined(a: Mapping[str, Stats], b: Mapping[str, Stats]) -> dict[str, Stats]:
    """Combine the statistics of two sets of frames.

    Quantiles are averaged with the counts as weights, as in LeRobot.
    """
    return {key: _joined(a[key], b[key]) if key in a else b[key] for key in b}


def _joined(a: Stats, b: Stats) -> Stats:
    n, m = float(a["count"][0]), float(b["count"][0])
    mean = (n * a["mean"] + m * b["mean"]) / (n + m)
    variance = (
        n * (a["std"] ** 2 + (a["mean"] - mean) ** 2)
        + m * (b["std"] ** 2 + (b["mean"] - mean) ** 2)
    ) / (n + m)
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": a["count"] + b["count"],
        **{name: (n * a[name] + m * b[name]) / (n + m) for name in _QUANTILES},
    }
