"""Images as Octo's ResizeImageWrapper makes them."""

from __future__ import annotations

import numpy as np

from vlagents_ray.registry import require

_CROPPED = np.sqrt(np.float32(0.9))  # of each side: the average area of the training's random crops


def resized(image: np.ndarray, height: int, width: int, *, crop: bool) -> np.ndarray:
    """A (H, W, 3) uint8 image as (height, width, 3), of its own memory: Lanczos, then the middle of it if `crop`."""
    if not crop and image.shape[:2] == (height, width):
        return image.copy()  # what the filter would give
    tf = require("tensorflow")
    found = tf.image.resize(image, (height, width), method="lanczos3", antialias=True)
    if crop:
        edge = (np.float32(1) - _CROPPED) / 2
        box = [[edge, edge, edge + _CROPPED, edge + _CROPPED]]
        found = tf.image.crop_and_resize(found[None], box, [0], (height, width))[0]
    return np.asarray(tf.cast(tf.clip_by_value(tf.round(found), 0, 255), tf.uint8))
