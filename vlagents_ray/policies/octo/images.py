"""Images in the form of Octo's ResizeImageWrapper."""

from __future__ import annotations

import numpy as np

from vlagents_ray.registry import require

_CROPPED = np.sqrt(np.float32(0.9))  # share of each side, by the average area of the training's random crops


def resized(image: np.ndarray, height: int, width: int, *, crop: bool) -> np.ndarray:
    """Resize an (H, W, 3) uint8 image to (height, width, 3) by Lanczos, with a crop of its centre if `crop`; a copy."""
    if not crop and image.shape[:2] == (height, width):
        return image.copy()  # the filter would change nothing
    tf = require("tensorflow")
    found = tf.image.resize(image, (height, width), method="lanczos3", antialias=True)
    if crop:
        edge = (np.float32(1) - _CROPPED) / 2
        box = [[edge, edge, edge + _CROPPED, edge + _CROPPED]]
        found = tf.image.crop_and_resize(found[None], box, [0], (height, width))[0]
    return np.asarray(tf.cast(tf.clip_by_value(tf.round(found), 0, 255), tf.uint8))
