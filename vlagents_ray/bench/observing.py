"""What every server in a benchmark gets to see, ours or a peer's, byte for byte."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np

from vlagents_ray.interface import Obs


@functools.cache
def observation(size: int = 224, cameras: int = 2) -> Obs:
    """Cameras with smooth structure and some noise, as photographs have; seven joints; a gripper.

    The same object each time: it is not to be changed.
    """
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:size, 0:size] / size
    images = {}
    for number in range(cameras):
        waves = [np.sin(2 * np.pi * (a * x + b * y) + number) for a, b in rng.uniform(-4, 4, (6, 2))]
        base = np.stack([sum(waves[i : i + 2]) for i in (0, 2, 4)], axis=-1)
        images[f"camera_{number}"] = np.clip(128 + 50 * base + rng.normal(0, 6, base.shape), 0, 255).astype(np.uint8)
    return Obs(images, 0.5, {"joints": np.zeros(7, np.float32)})


def save(obs: Obs, path: Path) -> None:
    """As an .npz that a peer's driver loads: every camera by its name, `joints`, `gripper`."""
    if obs.gripper is None:
        raise ValueError("the observation of a benchmark has a gripper")
    np.savez(path, gripper=np.float64(obs.gripper), joints=obs.state["joints"], **obs.cameras)  # type: ignore[arg-type]
