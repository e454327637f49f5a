"""Real-time chunking as in LeRobot 0.4.4 and 0.6.1, for batches whose rows have different leftovers and delays.

LeRobot's `RTCProcessor.denoise_step` has one delay for the whole batch. The velocity v of a row is corrected to
v - g(t) * w * (leftover - x1), where x1 = x - t * v is the predicted end of the row, w is 1 for the rows that will have
been executed and falls to 0 over the execution horizon, and g is capped. (Black, Galliker & Levine 2025,
https://arxiv.org/abs/2506.07339, multiply the correction by the Jacobian of x1, which LeRobot takes for 1.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from vlagents_ray.policies.flow import Change
from vlagents_ray.registry import require


class Guidance:
    """Guides chunks as the `RTCProcessor` of a flow-matching policy of LeRobot does, whose settings it has."""

    def __init__(self, processor: Any) -> None:
        self._processor = processor  # its settings and schedule are used

    def towards(self, plans: Sequence[Any], delays: Sequence[int], shape: tuple[int, int], device: Any) -> Change:
        """Return the change of velocities that leads chunks to the leftovers of their sessions.

        Args:
            plans: The leftover of each of the B rows in the policy's units, (H', D'), or None.
            delays: The number of rows of each that will have been executed.
            shape: Rows and numbers of a chunk, (H, D).
            device: The policy's device.
        """
        torch = require("torch")
        target, weights = torch.zeros(len(plans), *shape), torch.zeros(len(plans), shape[0], 1)
        for i, (plan, delay) in enumerate(zip(plans, delays, strict=True)):
            if plan is not None:
                part = plan[: shape[0]]
                target[i, : len(part), : part.shape[1]] = part
                weights[i, :, 0] = self._weights(delay, len(part), shape[0])
        target, weights = target.to(device), weights.to(device)

        def change(velocity: Any, actions: Any, time: float) -> Any:
            end = actions - time * velocity
            return velocity - self._strength(time) * weights * (target - end)

        return change

    def _weights(self, delay: int, leftover: int, chunk: int) -> Any:
        """Return the weight of the leftover in each row of a chunk, (chunk,) float32 in [0, 1]."""
        horizon = min(self._processor.rtc_config.execution_horizon, leftover)
        return self._processor.get_prefix_weights(max(delay, 0), horizon, chunk)

    def _strength(self, time: float) -> float:
        """Return g for LeRobot's time, which runs from 1 (noise) to 0."""
        most = float(self._processor.rtc_config.max_guidance_weight)
        done = 1 - time
        return most if done == 0 else min(most, time / done * (time**2 + done**2) / time**2)
