"""A synthetic camera image with saturated edges; `benchmarks.photographs` has photographs."""

from __future__ import annotations

import numpy as np


def rendered(height: int = 224, width: int = 224) -> np.ndarray:
    """Return an image with flat areas, saturated colours and hard edges, the hardest content for
    codecs that subsample colour.
    """
    y, x = np.mgrid[0:height, 0:width]
    image = np.zeros((height, width, 3), np.uint8)
    image[...] = (20, 160, 40)
    image[(x // 37 + y // 29) % 2 == 0] = (220, 20, 30)
    image[(x - width // 2) ** 2 + (y - height // 2) ** 2 < (height // 4) ** 2] = (20, 40, 230)
    return image


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    """Return the peak signal-to-noise ratio in dB over all three channels, infinite for equal
    images.
    """
    error = np.mean((image.astype(float) - other) ** 2)
    return float("inf") if error == 0 else float(10 * np.log10(255**2 / error))
