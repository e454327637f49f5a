"""Recorded episodes for the tuner."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vlagents_ray.evaluate.artifacts.recorder import Trajectory
from vlagents_ray.images.mp4 import Mp4


def record(
    file: Path, first: float, steps: int = 5, frames: int = 6, part: str = "arm/joints"
) -> None:
    """Write a trajectory in which observation i has first + i as its joints, and an image of
    brightness 20 i.
    """
    state = {part: first + np.arange(steps + 1, dtype=np.float32)[:, None] * np.ones(2, np.float32)}
    trajectory = Trajectory(
        np.zeros((steps, 2), np.float32), np.zeros(steps), np.zeros(steps, bool), state,
        np.linspace(0, 1, steps + 1, dtype=np.float32), ("front",), np.full(steps, -1),
    )  # fmt: skip
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(trajectory.to_bytes())
    video = Mp4(file.with_name(f"{file.stem}_front.mp4"), (16, 16, 3), 20)
    for i in range(frames):
        video.add(np.full((16, 16, 3), 20 * i, np.uint8))
    video.finish()
