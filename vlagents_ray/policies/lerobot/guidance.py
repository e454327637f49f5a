"""Real-time chunking as LeRobot 0.4.4 does it, for a batch whose rows have leftovers and delays of their own.

LeRobot's `RTCProcessor.denoise_step` takes one delay for the whole batch. The velocity v of a row is corrected to
v - g(t) * w * (leftover - x1), where x1 = x - t * v is where the row would end up, w is 1 for the rows that will have
been executed and falls to 0 over the execution horizon, and g is capped. (Black, Galliker & Levine 2025,
https://arxiv.org/abs/2506.07339, multiply the correction by the Jacobian of x1, which LeRobot takes for 1.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Guidance:
    """Stands where a flow-matching policy of LeRobot has its `RTCProcessor`."""

    def __init__(self, processor: Any) -> None:
        self._processor = processor  # whose settings and schedule hold

    def weights(self, delay: int, leftover: int, chunk: int) -> Any:
        """How much each row of a chunk follows the leftover, (chunk,) float32 in [0, 1]."""
        horizon = min(self._processor.rtc_config.execution_horizon, leftover)
        return self._processor.get_prefix_weights(max(delay, 0), horizon, chunk)

    def denoise_step(
        self,
        x_t: Any,
        prev_chunk_left_over: Any,
        inference_delay: Any,
        time: float,
        original_denoise_step_partial: Callable[[Any], Any],
        execution_horizon: int | None = None,
    ) -> Any:
        """The guided velocity, (B, T, D).

        `prev_chunk_left_over` is (B, T, D), or None for a batch without leftovers; `inference_delay` holds the
        weights, (B, T, 1), 0 for a row without one. The names are those by which the policy calls it.
        """
        velocity = original_denoise_step_partial(x_t)
        if prev_chunk_left_over is None:
            return velocity
        end = x_t - time * velocity
        return velocity - self._strength(time) * inference_delay * (prev_chunk_left_over - end)

    def is_debug_enabled(self) -> bool:
        """Nothing is tracked."""
        return False

    def _strength(self, time: float) -> float:
        """g, for LeRobot's time, which runs from 1 (noise) to 0."""
        most = float(self._processor.rtc_config.max_guidance_weight)
        done = 1 - time
        return most if done == 0 else min(most, time / done * (time**2 + done**2) / time**2)
