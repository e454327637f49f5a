"""Statistics of recorded features for LeRobot's normalisation (0.4.4, `lerobot/datasets/compute_stats.py`)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

Stats = dict[str, np.ndarray]  # "min", "max", "mean", "std", "count", "q01", ...

_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_PIXEL_STRIDE = 4  # in both directions; LeRobot samples pixels as well


def of_values(values: np.ndarray) -> Stats:
    """Compute the statistics of one episode's rows, (N, D) -> (D,) each; `count` is (1,)."""
    values = values.astype(np.float64)
    return {
        "min": values.min(0),
        "max": values.max(0),
        "mean": values.mean(0),
        "std": values.std(0),
        "count": np.array([len(values)]),
        **{name: np.quantile(values, q, axis=0) for name, q in _QUANTILES.items()},
    }


class ImageStatistics:
    """The statistics of one camera in one episode, by channel, of pixels in [0, 1], (3, 1, 1) each."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, 256), np.int64)
        self._images = 0

    def add(self, image: np.ndarray) -> None:
        """Count a sample of the pixels of an image, (H, W, 3) uint8."""
        seen = image[::_PIXEL_STRIDE, ::_PIXEL_STRIDE]
        for channel in range(3):
            self._counts[channel] += np.bincount(seen[..., channel].ravel(), minlength=256)
        self._images += 1

    def result(self) -> Stats:
        """Return the statistics of all images, with the keys of `of_values`."""
        levels = np.arange(256) / 255
        share = self._counts / self._counts.sum(1, keepdims=True)
        mean = share @ levels
        below = np.cumsum(share, axis=1)

        def quantile(q: float) -> np.ndarray:
            return np.asarray(levels[np.argmax(below >= min(q, 1 - 1e-9), axis=1)])

        stats = {
            "min": quantile(1e-12),
            "max": levels[255 - np.argmax(self._counts[:, ::-1] > 0, axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(share @ levels**2 - mean**2, 0)),
            **{name: quantile(q) for name, q in _QUANTILES.items()},
        }
        return {name: value.reshape(3, 1, 1) for name, value in stats.items()} | {"count": np.array([self._images])}


def joined(a: Mapping[str, Stats], b: Mapping[str, Stats]) -> dict[str, Stats]:
    """Combine the statistics of two sets of frames; quantiles are averaged by count, as LeRobot does."""
    return {key: _joined(a[key], b[key]) if key in a else b[key] for key in b}


def _joined(a: Stats, b: Stats) -> Stats:
    n, m = float(a["count"][0]), float(b["count"][0])
    mean = (n * a["mean"] + m * b["mean"]) / (n + m)
    variance = (n * (a["std"] ** 2 + (a["mean"] - mean) ** 2) + m * (b["std"] ** 2 + (b["mean"] - mean) ** 2)) / (n + m)
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": a["count"] + b["count"],
        **{name: (n * a[name] + m * b[name]) / (n + m) for name in _QUANTILES},
    }
