"""Real-time chunking of flow-matching policies: a chunk that goes on from what the robot is doing meanwhile.

After Black, Galliker & Levine 2025 (https://arxiv.org/abs/2506.07339), with two differences. Rows that will have been
executed when the answer comes are not guided but set, at each step, to the plan with as much noise as is left, so that
they come out as they were planned, exactly. And the later rows' correction takes the model's Jacobian for the identity,
as LeRobot 0.4.4 does: it costs no backward pass.

Flow time is openpi's: 1 is noise, 0 is the actions, and the velocity is noise minus actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.policies.base.row import Row


@dataclass(frozen=True, slots=True)
class Guide:
    """What each row of a batch of chunks is to follow, as arrays of whichever library the model is written in."""

    plan: Any  # (B, H, D) as the model sees actions, i.e. normalised; zeros where there is none
    frozen: Any  # (B, H, 1): 1.0 where a row will have been executed, else 0.0
    weight: Any  # (B, H, 1) in [0, 1]: how closely a later row is to follow

    @classmethod
    def of(
        cls, rows: Sequence[Row], horizon: int, dim: int, normalise: Callable[[np.ndarray], np.ndarray]
    ) -> Guide | None:
        """That of the rows' `leftover` and `delay`, in numpy; None if no row has any."""
        if all(row.leftover is None for row in rows):
            return None
        plan = np.zeros((len(rows), horizon, dim), np.float32)
        frozen = np.zeros((len(rows), horizon, 1), np.float32)
        weight = np.zeros((len(rows), horizon, 1), np.float32)
        for i, row in enumerate(rows):
            if row.leftover is not None:
                left = normalise(row.leftover[:horizon])
                delay = min(max(row.delay, 0), len(left))
                plan[i, : len(left), : left.shape[1]] = left
                frozen[i, :delay] = 1.0
                weight[i, delay:, 0] = _weights(delay, len(left), horizon)[delay:]
        return cls(plan, frozen, weight)

    def to(self, convert: Callable[[np.ndarray], Any]) -> Guide:
        """The same in another library, or on another device."""
        return Guide(convert(self.plan), convert(self.frozen), convert(self.weight))

    def hold(self, actions: Any, noise: Any, time: float) -> Any:
        """The noisy actions (B, H, D) with the frozen rows as the plan has them at that flow time."""
        known = time * noise + (1.0 - time) * self.plan
        return self.frozen * known + (1.0 - self.frozen) * actions

    def pull(self, actions: Any, velocity: Any, time: float, steps: int, limit: float) -> Any:
        """The velocity (B, H, D), corrected toward the plan with a gain of at most `limit`.

        Nor is it more than the number of steps: at that, one step goes all the way.
        """
        spread = (1.0 - time) ** 2 + time**2
        gain = min(limit, float(steps), spread / max(time * (1.0 - time), 1e-6))
        return velocity - gain * self.weight * (self.plan - (actions - time * velocity))


def _weights(delay: int, length: int, horizon: int) -> np.ndarray:
    """(horizon,): the paper's soft mask, from about 1 after the frozen rows down to 0 where the plan ends."""
    behind = np.arange(horizon, dtype=np.float32)
    share = np.clip((length - behind) / (length - delay + 1), 0.0, 1.0)
    return np.asarray(share * np.expm1(share) / np.expm1(1.0), np.float32)
