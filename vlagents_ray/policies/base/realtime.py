"""Real-time chunking of flow-matching policies: a new chunk continues the motion that the robot is executing.

After Black, Galliker & Levine 2025 (https://arxiv.org/abs/2506.07339), with two differences. Rows that will have been
executed when the answer comes are not guided but moved straight from the noise to the plan, so that they come out as
planned. And the correction of the later rows takes the model's Jacobian as the identity, as LeRobot 0.4.4 does: it
needs no backward pass.

Flow time is openpi's: 1 is noise, 0 is the actions, and the velocity is noise minus actions.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.policies.base.model_inputs import Row


@dataclass(frozen=True, slots=True)
class Guide:
    """The plan that each row of a batch of chunks follows, as arrays of the library in which the model is written."""

    plan: Any  # (B, H, D) in the model's units, i.e. normalised; zeros where there is no plan
    frozen: Any  # (B, H, 1): 1.0 where a row will have been executed, else 0.0
    weight: Any  # (B, H, 1) in [0, 1]: how closely a later row follows

    @classmethod
    def of(cls, rows: Sequence[Row], horizon: int, dim: int) -> Guide | None:
        """Return the guide of the rows' `delay` and `leftover`, in the model's units; None if no row has any."""
        if all(row.leftover is None for row in rows):
            return None
        plan = np.zeros((len(rows), horizon, dim), np.float32)
        frozen = np.zeros((len(rows), horizon, 1), np.float32)
        weight = np.zeros((len(rows), horizon, 1), np.float32)
        for i, row in enumerate(rows):
            if row.leftover is not None:
                left = row.leftover[:horizon]
                delay = min(max(row.delay, 0), len(left))
                plan[i, : len(left), : left.shape[1]] = left
                frozen[i, :delay] = 1.0
                weight[i, delay:, 0] = _weights(delay, len(left), horizon)[delay:]
        return cls(plan, frozen, weight)

    def to(self, convert: Callable[[np.ndarray], Any]) -> Guide:
        """Convert the arrays to another library, or move them to another device."""
        return Guide(convert(self.plan), convert(self.frozen), convert(self.weight))

    def change(self, noise: Any, *, steps: int, limit: float) -> Callable[[Any, Any, float], Any]:
        """Return `steer` for a flow from some noise (B, H, D), as a function of velocity, noisy actions and time."""
        return lambda velocity, actions, time: self.steer(velocity, actions, noise, time, steps=steps, limit=limit)

    def steer(
        self,
        velocity: Any,
        actions: Any,
        noise: Any,
        time: Any,
        *,
        steps: int,
        limit: float,
        lower: Callable[[Any, float], Any] = min,
    ) -> Any:
        """Return the velocity (B, H, D), corrected by the plan, at the noisy actions of this flow time.

        The gain of the correction of a later row is at most `limit`, and at most the number of steps: with that, one
        step goes all the way. `lower` returns the smaller of two numbers, for libraries whose `time` is not a plain
        number.
        """
        spread = (1.0 - time) ** 2 + time**2
        gain = lower(spread / (time * (1.0 - time) + 1e-6), min(limit, float(steps)))
        pulled = velocity - gain * self.weight * (self.plan - (actions - time * velocity))
        return self.frozen * (noise - self.plan) + (1.0 - self.frozen) * pulled


def _weights(delay: int, length: int, horizon: int) -> np.ndarray:
    """Return (horizon,): the paper's soft mask, from about 1 after the frozen rows down to 0 where the plan ends."""
    behind = np.arange(horizon, dtype=np.float32)
    share = np.clip((length - behind) / (length - delay + 1), 0.0, 1.0)
    return np.asarray(share * np.expm1(share) / np.expm1(1.0), np.float32)
