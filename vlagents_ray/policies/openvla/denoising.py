"""The deterministic sampler of OFT's diffusion head (DDIM, arXiv 2010.02502), with upstream's squared-cosine noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from vlagents_ray.registry import require


def denoise(noise: Any, predict: Callable[[int, Any], Any], trained: int, steps: int) -> Any:
    """Actions (B, H, D) in [-1, 1] from noise; `predict` says what noise is in them at a time of training's scale."""
    kept = _kept(trained)
    for time, before in _times(trained, steps):
        guessed = predict(time, noise)
        clean = (noise - (1 - kept[time]) ** 0.5 * guessed) / kept[time] ** 0.5
        left = kept[before] if before >= 0 else 1.0
        noise = left**0.5 * clean.clamp(-1, 1) + (1 - left) ** 0.5 * guessed
    return noise


def time_embedding(time: int, dim: int, device: Any) -> Any:
    """(dim,) float32, sines and then cosines."""
    torch = require("torch")
    half = dim // 2
    rates = torch.exp(torch.arange(half, device=device) * -math.log(10000) / (half - 1))
    return torch.cat([(time * rates).sin(), (time * rates).cos()])


def _times(trained: int, steps: int) -> Iterator[tuple[int, int]]:
    stride = trained // steps
    for i in reversed(range(steps)):
        yield i * stride, (i - 1) * stride


def _kept(trained: int) -> list[float]:
    """Share of the signal that is left at each time of training."""

    def alpha(x: float) -> float:
        return math.cos((x + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - alpha((i + 1) / trained) / alpha(i / trained), 0.999) for i in range(trained)]
    kept: list[float] = np.cumprod(1 - np.array(betas, np.float32)).tolist()
    return kept
