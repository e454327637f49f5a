"""Recorded trajectories as a LeRobotDataset v3.0: to look at, and to train with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.files import link_or_copy
from vlagents_ray.evaluate.results import CellResults, Results
from vlagents_ray.evaluate.trajectory import Trajectory, video_of
from vlagents_ray.evaluate.video import DEFAULT_FPS
from vlagents_ray.registry import require
from vlagents_ray.robot.dataset import UNFINISHED, Dataset
from vlagents_ray.robot.episode import (
    ACTION,
    INDEX,
    STATE,
    Finished,
    camera_key,
    number_features,
    state_vector,
    vector_feature,
    video_feature,
)
from vlagents_ray.robot.statistics import ImageStatistics, Stats

GRIPPER = "observation.gripper"
# LeRobot's own names for what an action led to; `success` is that of the state after it.
OUTCOMES = {"next.reward": "float32", "next.success": "bool", "next.done": "bool"}


def to_lerobot(results: Results, path: Path) -> int:
    """Write the dataset into the new folder `path`; returns how many episodes it has. Needs the extra "record".

    A frame is what the policy saw and the action that followed: the last observation of an episode, which none
    followed, is left out. Raises `ConfigError` if no trajectory was recorded, or if they do not fit one dataset.
    """
    recorded = [(cell, one) for cell in results.cells for one in cell.episodes if one.trajectory is not None]
    if not recorded:
        raise ConfigError(f"{results.out}: has no trajectories; evaluate with `record: all`, or `failures`")
    if path.exists() and any(path.iterdir()):
        raise ConfigError(f"{path}: is there, and not empty; export into a new folder")
    rates = {_fps(cell) for cell, _ in recorded}
    if len(rates) > 1:
        raise ConfigError(f"the envs run at {sorted(rates)} Hz, and a dataset has one rate; {_CURE}")
    dataset = Dataset(path, rates.pop())
    for cell, episode in recorded:
        assert episode.trajectory is not None  # noqa: S101 - chosen by that
        finished = _finished(cell, episode.result.instruction, results.out / episode.trajectory, path / UNFINISHED)
        if not len(finished.rows[ACTION]):
            continue  # the policy failed before it acted: a dataset knows no empty episode
        if dataset.episodes and finished.features != dataset.info["features"]:
            odd = sorted(k for k, v in finished.features.items() if dataset.info["features"].get(k) != v)
            raise ConfigError(f"{cell.env}: has other features than the envs before it ({', '.join(odd)}); {_CURE}")
        dataset.save(finished)
    return dataset.episodes


_CURE = "export env by env (--env)"


def _fps(cell: CellResults) -> float:
    return float(cell.contract.get("control_hz") or DEFAULT_FPS)


def _finished(cell: CellResults, instruction: str, path: Path, folder: Path) -> Finished:
    """The episode as the dataset takes it; its videos are put into `folder` first."""
    trajectory = Trajectory.load(path)
    rows, features = _numbers(trajectory, cell.contract)
    images: dict[str, Stats] = {}
    videos: dict[str, Path] = {}
    for camera in trajectory.cameras:
        key = camera_key(camera)
        images[key], size = _statistics(video_of(path, camera), len(trajectory.actions))
        features[key] = video_feature(*size, _fps(cell))
        videos[key] = folder / f"{key}.mp4"
        link_or_copy(video_of(path, camera), videos[key])
    return Finished(instruction, features, rows, images, videos)


def _numbers(trajectory: Trajectory, contract: dict[str, Any]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Rows and features: the state in one vector and part by part, the action, and what came of it."""
    frames, dim = trajectory.actions.shape
    state = {part: values[:frames] for part, values in trajectory.state.items()}
    gripper = None if trajectory.gripper is None else trajectory.gripper[:frames]
    together, names = state_vector(state, gripper)
    rows = {
        ACTION: trajectory.actions,
        "next.reward": trajectory.rewards.astype(np.float32),
        "next.success": trajectory.success,
        "next.done": np.arange(frames) == frames - 1,
    }
    features = {ACTION: vector_feature([f"action_{i}" for i in range(dim)]), **number_features(OUTCOMES | INDEX)}
    features[ACTION]["spec"] = contract.get("action")
    if names:
        rows[STATE], features[STATE] = together, vector_feature(names)
    for part, values in state.items():
        key = f"{STATE}.{part.replace('/', '_')}"
        rows[key], features[key] = values, vector_feature([f"{part}_{i}" for i in range(values.shape[1])])
        features[key]["unit"] = (contract.get("state") or {}).get(part, {}).get("unit")
    if gripper is not None:
        rows[GRIPPER] = gripper
        features |= number_features({GRIPPER: "float32"})
    return rows, features


def _statistics(video: Path, frames: int) -> tuple[Stats, tuple[int, int]]:
    """Of the first `frames` pictures, and their height and width in pixels."""
    seen = ImageStatistics()
    with require("av").open(str(video)) as container:
        stream = container.streams.video[0]
        for number, frame in enumerate(container.decode(stream)):
            if number == frames:
                break
            seen.add(frame.to_ndarray(format="rgb24"))
        return seen.result(), (stream.height, stream.width)
