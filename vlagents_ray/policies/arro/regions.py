"""Regions of an image, in plain numpy: connected pixels, boxes, wider masks."""

from __future__ import annotations

import numpy as np


def connected(right: np.ndarray, down: np.ndarray) -> np.ndarray:
    """Label each pixel, (H, W) int; two pixels share a label if a chain of linked neighbours connects them.

    Args:
        right: (H, W - 1) bool, whether a pixel is linked to the next one in its row.
        down: (H - 1, W) bool, whether a pixel is linked to the one below it.
    """
    height, width = right.shape[0], down.shape[1]
    index = np.arange(height * width).reshape(height, width)
    one = np.concatenate([index[:, :-1][right], index[:-1][down]])
    other = np.concatenate([index[:, 1:][right], index[1:][down]])
    labels = index.ravel()
    while True:
        a, b = labels[one], labels[other]
        apart = a != b
        if not apart.any():
            return labels.reshape(height, width)
        np.minimum.at(labels, np.maximum(a, b)[apart], np.minimum(a, b)[apart])
        while not np.array_equal(labels, jumped := labels[labels]):
            labels = jumped


def split(mask: np.ndarray, smallest: int = 1) -> list[np.ndarray]:
    """Return the connected regions of `mask`, (H, W) bool each, of at least `smallest` pixels; the largest first."""
    labels = connected(mask[:, :-1] & mask[:, 1:], mask[:-1] & mask[1:])
    return [labels == label for label in largest(labels[mask], smallest)]


def flat(image: np.ndarray, tolerance: int) -> np.ndarray:
    """Label each pixel, (H, W) int; neighbours that differ by at most `tolerance` in all channels share a label."""
    signed = image.astype(np.int16)
    return connected(*(np.abs(np.diff(signed, axis=axis)).max(-1) <= tolerance for axis in (1, 0)))


def largest(labels: np.ndarray, smallest: int) -> np.ndarray:
    """Return the labels of at least `smallest` pixels, the most frequent first."""
    values, counts = np.unique(labels, return_counts=True)
    order = np.argsort(-counts, kind="stable")
    kept: np.ndarray = values[order[counts[order] >= smallest]]
    return kept


def box_of(mask: np.ndarray) -> np.ndarray:
    """Return the smallest box around the true pixels: (4,) float32, px: left, top, right, bottom."""
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    return np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1], np.float32)


def overlap(one: np.ndarray, other: np.ndarray) -> float:
    """Return the intersection over union of two masks; 0 if both are empty."""
    union = np.count_nonzero(one | other)
    return np.count_nonzero(one & other) / union if union else 0.0


def grown(mask: np.ndarray, pixels: int) -> np.ndarray:
    """Widen the mask by `pixels` to each side."""
    for axis in (0, 1):
        padding = [(0, 0), (0, 0)]
        padding[axis] = (pixels, pixels)
        windows = np.lib.stride_tricks.sliding_window_view(np.pad(mask, padding), 2 * pixels + 1, axis)
        mask = np.asarray(windows.any(-1))
    return mask
