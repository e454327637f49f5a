"""How far the actions of a variant are from those of the file's own settings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_SMALLEST_RANGE = 0.1  # of a number of the action, as a share of its largest magnitude: it may hardly move


def largest_difference(actions: Sequence[np.ndarray], wanted: Sequence[np.ndarray]) -> float:
    """Return the largest difference of two lists of actions, as a share of the range of `wanted`.

    Each number of an action has a range of its own: the largest minus the smallest value among all actions and rows, or
    a tenth of its largest magnitude if that is more.

    Args:
        actions: The actions to judge, each (D,) or (H, D); the one at i belongs to `wanted[i % len(wanted)]`.
        wanted: The actions to compare with.

    Returns:
        The difference; infinity if shapes differ, or if a value is not finite.
    """
    rows = np.concatenate([np.atleast_2d(one) for one in wanted]).astype(np.float64)
    span = np.maximum(np.ptp(rows, axis=0), _SMALLEST_RANGE * np.abs(rows).max(axis=0))
    largest = 0.0
    for i, action in enumerate(actions):
        want = np.asarray(wanted[i % len(wanted)], np.float64)
        if np.shape(action) != want.shape or not np.isfinite(action).all():
            return float("inf")
        off = np.abs(action - want)
        shares = np.divide(off, span, out=np.where(off > 0, np.inf, 0.0), where=span > 0)
        largest = max(largest, float(shares.max(initial=0.0)))
    return largest
