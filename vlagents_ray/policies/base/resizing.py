"""Images to the size of a model's vision tower."""

from __future__ import annotations

import numpy as np

from vlagents_ray.registry import require


def resize_with_pad(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """The whole (H, W, 3) uint8 image, centred in black (height, width, 3); a copy, also where nothing changes.

    Bilinear, by Pillow, and rounded as openpi's `image_tools.resize_with_pad` does it: its policies were trained on
    such images.
    """
    have_height, have_width = image.shape[:2]
    if (have_height, have_width) == (height, width):
        return image.copy()
    ratio = max(have_width / width, have_height / height)
    inner_height, inner_width = max(1, int(have_height / ratio)), max(1, int(have_width / ratio))
    pil = require("PIL.Image")
    small = pil.fromarray(np.ascontiguousarray(image)).resize((inner_width, inner_height), pil.Resampling.BILINEAR)
    padded = np.zeros((height, width, 3), np.uint8)
    top, left = (height - inner_height) // 2, (width - inner_width) // 2
    padded[top : top + inner_height, left : left + inner_width] = small
    return padded
