"""How many replicas the measured load needs: a policy for Ray Serve's autoscaler.

Serve counts requests. But a WebSocket is one request as long as it lasts, and a session through
shared memory or a Serve handle's actor is none. So each replica reports (`record_autoscaling_stats`)

- `utilisation`: the share of the time in which its policy's thread was busy, in [0, 1],
- `waiting`: requests in its batch queue, as a mean over time, in batches of the largest size,
- `sessions`: robots and envs that it holds, by whatever transport,

and Serve averages them over `look_back_s`. It calls the policy ten times a second in its controller,
keeps the result within min and max replicas, and makes it wait `upscale_delay_s` or `downscale_delay_s`.

The controller gets this module by value, so it imports nothing of ours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

UTILISATION = "utilisation"
WAITING = "waiting"
SESSIONS = "sessions"

_MARGIN = 0.8  # one replica less must carry the load at this share of each target, or the replicas would flap
_NOTHING = 1e-3  # of a replica: an idle one measures that it was busy for some millionths of the time


class MeasuredLoad:
    """As many replicas as keep each of them below all targets. A function of the context alone."""

    def __init__(
        self, *, target_utilisation: float = 0.7, target_waiting: float = 1.0, target_sessions: float | None = None
    ) -> None:
        self._targets = {UTILISATION: target_utilisation, WAITING: target_waiting}
        if target_sessions is not None:
            self._targets[SESSIONS] = target_sessions

    def __call__(self, ctx: Any) -> tuple[int, dict[str, Any]]:
        """The number of replicas wanted for a `ray.serve.config.AutoscalingContext`; no state is kept."""
        metrics: Mapping[str, Mapping[Any, float]] = ctx.aggregated_metrics or {}
        target: int = ctx.target_num_replicas
        reported = metrics.get(UTILISATION, {})
        if not reported:  # no replica runs, or none has reported yet
            return target, {}
        totals = {name: sum(metrics.get(name, {}).values()) for name in (UTILISATION, WAITING, SESSIONS)}
        most = self._needed(totals, 1.0)
        least = self._needed(totals, _MARGIN)
        if totals[SESSIONS] or ctx.total_num_requests:
            most, least = max(1, most), max(1, least)  # only an application that nobody uses may have none
        if most > target:
            return most, {}
        if least < target and len(reported) >= ctx.current_num_replicas:  # a silent one may be busy
            return least, {}
        return target, {}

    def _needed(self, totals: Mapping[str, float], margin: float) -> int:
        needed = max(totals[name] / (margin * target) for name, target in self._targets.items())
        return math.ceil(needed - _NOTHING)
