"""Images like photographs, for realistic measurements of camera images: with random noise, JPEG
needs four times the bytes and twice the time.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from vlagents_ray.interface import Obs


def photograph(height: int = 224, width: int = 224, seed: int = 0) -> np.ndarray:
    """Return an image, (H, W, 3) uint8, with detail that decreases with frequency, a shaded disc,
    and noise that neighbours share, as after demosaicing.
    """
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    frequency[0, 0] = 1.0

    def cloud(power: float) -> np.ndarray:
        spectrum = np.fft.rfft2(rng.normal(size=(height, width))) / frequency**power
        values = np.fft.irfft2(spectrum, s=(height, width))
        normal: np.ndarray = (values - values.mean()) / values.std()
        return normal

    light, red, blue = cloud(1.2), cloud(1.4), cloud(1.4)
    image = (
        128 + 38 * light[..., None] + np.stack([18 * red, -9 * red - 6 * blue, 22 * blue], axis=-1)
    )
    y, x = np.mgrid[0:height, 0:width]
    inside = np.clip(height / 5 - np.hypot(y - height / 2, x - width / 3), 0, 1)[..., None]
    image = image * (1 - inside) + inside * (
        np.array([190.0, 120, 60]) + 30 * (x[..., None] / width)
    )
    noise = rng.normal(0, 3, (height + 1, width + 1, 3))
    image += (noise[1:, 1:] + noise[:-1, 1:] + noise[1:, :-1] + noise[:-1, :-1]) / 2
    pixels: np.ndarray = image.round().clip(0, 255).astype(np.uint8)
    return pixels


# The same robots are often created again, and a photograph of 224 px takes about 10 ms.
_photograph = lru_cache(maxsize=1024)(photograph)


def with_photographs(obs: Obs, seed: int) -> Obs:
    """Return an observation whose cameras show photographs of the same sizes.

    Args:
        obs: The observation.
        seed: The seed of the photographs.
    """
    cameras = {}
    for number, (name, image) in enumerate(obs.cameras.items()):
        height, width, _ = image.shape
        cameras[name] = _photograph(height, width, 100 * seed + number).copy()
    return replace(obs, cameras=cameras)
