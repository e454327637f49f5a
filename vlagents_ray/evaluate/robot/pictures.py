"""The pictures of a scene: how it was at its first start, and how it is now over that."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vlagents_ray.evaluate.artifacts.storage import whole
from vlagents_ray.images.jpeg_png import decode, encode_jpeg
from vlagents_ray.interface import Obs
from vlagents_ray.naming import distinct

SCENES = "scenes"
_QUALITY = 92


def start_pictures(out: Path, place: str) -> dict[str, Path]:
    """Return the JPEG of each camera at the first start of a scene; {} before that.

    Args:
        out: The folder of results.
        place: The scene's name in files.
    """
    return {path.stem: path for path in sorted((out / SCENES / place).glob("*.jpg"))}


def save_start(out: Path, place: str, obs: Obs) -> None:
    """Save the pictures of a scene at its start, in place of earlier ones."""
    for camera, name in distinct(obs.cameras).items():
        with whole(out / SCENES / place / f"{name}.jpg") as part:
            part.write_bytes(encode_jpeg(obs.cameras[camera], _QUALITY))


def save_overlay(start: Path, now: np.ndarray) -> Path:
    """Save the mean of a start picture and the same camera's picture now, beside the former's folder.

    Args:
        start: The JPEG of the start picture.
        now: (H, W, 3) uint8.

    Returns:
        The new JPEG; it has the size of `now`, and only `now` if the sizes differ.
    """
    before = decode(start.read_bytes())
    mean = now if before.shape != now.shape else ((before.astype(np.uint16) + now) // 2).astype(np.uint8)
    path = start.parent.with_name(f"overlay-{start.name}")
    with whole(path) as part:
        part.write_bytes(encode_jpeg(mean, _QUALITY))
    return path
