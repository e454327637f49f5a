"""Synthetic camera images: one rendered, with saturated edges, and one like a photograph."""

from __future__ import annotations

import numpy as np


def rendered(height: int = 224, width: int = 224) -> np.ndarray:
    """Flat areas, saturated colours and hard edges: the hardest for coders that halve the
    colour.
    """
    y, x = np.mgrid[0:height, 0:width]
    image = np.zeros((height, width, 3), np.uint8)
    image[...] = (20, 160, 40)
    image[(x // 37 + y // 29) % 2 == 0] = (220, 20, 30)
    image[(x - width // 2) ** 2 + (y - height // 2) ** 2 < (height // 4) ** 2] = (20, 40, 230)
    return image


def photograph(height: int = 224, width: int = 224, seed: int = 0) -> np.ndarray:
    """Detail that falls with its frequency, a shaded disc, and noise that neighbours share, as
    after demosaicing.
    """
    rng = np.random.default_rng(seed)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)[None])
    frequency[0, 0] = 1.0

    def cloud(power: float) -> np.ndarray:
        spectrum = np.fft.rfft2(rng.normal(size=(height, width))) / frequency**power
        values = np.fft.irfft2(spectrum, s=(height, width))
        return (values - values.mean()) / values.std()

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
    return image.round().clip(0, 255).astype(np.uint8)


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    """dB, over all three channels; infinite for equal images."""
    error = np.mean((image.astype(float) - other) ** 2)
    return float("inf") if error == 0 else float(10 * np.log10(255**2 / error))
