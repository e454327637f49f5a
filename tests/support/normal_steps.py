"""The log-probability of a flow's random steps as in the papers (Flow-GRPO, πRL), to compare with
this package's function.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


def logprob_of_steps(velocity: Callable[[Any, float], Any], chain: np.ndarray, level: float) -> Any:
    """Return the log-probability of each number of a chain (K + 1, H, D), summed over the steps.
    `velocity` returns (1, H, D).
    """
    import torch

    states = torch.from_numpy(chain)
    times = np.linspace(1, 0, len(chain))
    total = torch.zeros(states.shape[1:], dtype=torch.float64)
    for before, after, t, s in zip(states, states[1:], times, times[1:], strict=False):
        v, sigma = (
            velocity(before[None], float(t))[0],
            level * (t / (1 - (t if t < 1 else s))) ** 0.5,
        )
        # The model's estimates of data and noise.
        clean, noise = before - t * v, before + (1 - t) * v
        mean = (1 - s) * clean + (s - sigma**2 * (t - s) / (2 * t)) * noise
        total += torch.distributions.Normal(mean, sigma * (t - s) ** 0.5).log_prob(after)
    return total
