"""Real-time chunking as in LeRobot 0.4.4, for batches whose rows have different leftovers and delays.

LeRobot's `RTCProcessor.denoise_step` has one delay for the whole batch. The velocity v of a row is corrected to
v - g(t) * w * (leftover - x1), where x1 = x - t * v is the predicted end of the row, w is 1 for the rows that will have
been executed and falls to 0 over the execution horizon, and g is capped. (Black, Galliker & Levine 2025,
https://arxiv.org/abs/2506.07339, multiply the correction by the Jacobian of x1, which LeRobot takes for 1.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vlagents_ray.policies.flow import RandomSteps


class Guidance:
    """Replaces the `RTCProcessor` of a flow-matching policy of LeRobot."""

    def __init__(self, processor: Any) -> None:
        self._processor = processor  # its settings and schedule are used

    def weights(self, delay: int, leftover: int, chunk: int) -> Any:
        """Return the weight of the leftover in each row of a chunk, (chunk,) float32 in [0, 1]."""
        horizon = min(self._processor.rtc_config.execution_horizon, leftover)
        return self._processor.get_prefix_weights(max(delay, 0), horizon, chunk)

    def denoise_step(
        self,
        x_t: Any,
        prev_chunk_left_over: Any,
        inference_delay: Any,
        time: float,
        original_denoise_step_partial: Callable[[Any], Any],
        execution_horizon: RandomSteps | None = None,
    ) -> Any:
        """Compute the guided velocity, (B, T, D).

        `prev_chunk_left_over` is (B, T, D), or None for a batch without leftovers; `inference_delay` is the
        weights, (B, T, 1), 0 for a row without one; `execution_horizon` is the random steps of rows without a leftover,
        or None. The policy passes them by these names.
        """
        velocity = original_denoise_step_partial(x_t)
        if prev_chunk_left_over is not None:
            end = x_t - time * velocity
            velocity = velocity - self._strength(time) * inference_delay * (prev_chunk_left_over - end)
        return velocity if execution_horizon is None else execution_horizon.velocity(velocity, x_t)

    def is_debug_enabled(self) -> bool:
        """Return False, as nothing is tracked."""
        return False

    def _strength(self, time: float) -> float:
        """Return g for LeRobot's time, which runs from 1 (noise) to 0."""
        most = float(self._processor.rtc_config.max_guidance_weight)
        done = 1 - time
        return most if done == 0 else min(most, time / done * (time**2 + done**2) / time**2)
