"""Observations out of trajectories that evaluations recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.artifacts.trajectory import Trajectory, videos_of
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require


def recorded_observations(folder: Path, count: int) -> list[Obs]:
    """Read observations, spread evenly over the trajectories below a folder and over their steps.

    Args:
        folder: A folder of results, of an evaluation with `record`, or a part of it.
        count: The number of observations.

    Raises:
        ConfigError: There is no trajectory, or one cannot be read.
    """
    files = sorted(folder.rglob("*.npz"))
    if not files:
        raise ConfigError(f"--frames {folder}: holds no trajectory (.npz), want a folder of them, as evaluations save")
    used = files[:: max(1, len(files) // count)][:count]
    found: list[Obs] = []
    for number, file in enumerate(used):
        share = len(range(number, count, len(used)))
        found += _of_trajectory(file, share)
    return found


def _of_trajectory(file: Path, count: int) -> list[Obs]:
    trajectory = Trajectory.load(file)
    steps = np.linspace(0, len(trajectory.actions), count, dtype=int).tolist()
    images = {camera: _images(video, steps) for camera, video in videos_of(file, trajectory.cameras).items()}
    return [
        Obs(
            cameras={camera: images[camera][step] for camera in trajectory.cameras},
            gripper=None if trajectory.gripper is None else float(trajectory.gripper[step]),
            state={part: values[step] for part, values in trajectory.state.items()},
        )
        for step in steps
    ]


def _images(video: Path, steps: list[int]) -> dict[int, np.ndarray]:
    """Return the images of these steps, (H, W, 3) uint8 RGB."""
    av = require("av")
    found: dict[int, np.ndarray] = {}
    try:
        with av.open(str(video)) as container:
            for number, frame in enumerate(container.decode(video=0)):
                if number in steps:
                    found[number] = frame.to_ndarray(format="rgb24")
    except (OSError, ValueError) as error:  # PyAV's errors of broken files are of these kinds
        raise ConfigError(f"--frames: {video} cannot be read ({error})") from error
    if missing := sorted(set(steps) - set(found)):
        raise ConfigError(f"--frames: {video} has no frames {missing}, which its trajectory has")
    return found
