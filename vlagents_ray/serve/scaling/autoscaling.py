"""An autoscaling policy for Ray Serve, which derives the number of replicas from the measured load.

Serve's own policy counts requests. But a WebSocket counts as one request for as long as it is open,
and a session over shared memory or a Serve handle's actor does not count at all. So each replica
reports (`record_autoscaling_stats`):

- `utilisation`: the share of the time in which its policy's thread was busy, in [0, 1].
- `waiting`: the mean number of requests in its batch queue, in batches of the largest size.
- `sessions`: the robots and envs that it holds, over all transports.

Serve averages these values over `look_back_s`. Its controller calls the policy ten times a second,
limits the result to the minimum and maximum number of replicas, and applies it after
`upscale_delay_s` or `downscale_delay_s`.

The module is pickled by value for the controller, so it imports no other module of this package.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

UTILISATION = "utilisation"
WAITING = "waiting"
SESSIONS = "sessions"

# A replica is removed only if the load of the remaining ones stays below this share of each target,
# so that their number does not oscillate.
_MARGIN = 0.8
# Utilisation below which a replica counts as idle; an idle replica measures some millionths.
_NOTHING = 1e-3


class MeasuredLoad:
    """Requests the smallest number of replicas that keeps each of them below all targets. It has no
    state.

    Args:
        target_utilisation: Utilisation per replica, in [0, 1].
        target_waiting: Mean queue length per replica, in batches of the largest size.
        target_sessions: Sessions per replica; by default, sessions only prevent scaling to zero.
    """

    def __init__(
        self,
        *,
        target_utilisation: float = 0.7,
        target_waiting: float = 1.0,
        target_sessions: float | None = None,
    ) -> None:
        self._targets = {UTILISATION: target_utilisation, WAITING: target_waiting}
        if target_sessions is not None:
            self._targets[SESSIONS] = target_sessions

    def __call__(self, ctx: Any) -> tuple[int, dict[str, Any]]:
        """Return the desired number of replicas for a `ray.serve.config.AutoscalingContext`, and
        an empty state.
        """
        metrics: Mapping[str, Mapping[Any, float]] = ctx.aggregated_metrics or {}
        target: int = ctx.target_num_replicas
        reported = metrics.get(UTILISATION, {})
        if not reported:  # no replica runs, or none has reported yet
            return target, {}
        totals = {
            name: sum(metrics.get(name, {}).values()) for name in (UTILISATION, WAITING, SESSIONS)
        }

        needed = self._needed(totals, 1.0)
        needed_with_margin = self._needed(totals, _MARGIN)
        if totals[SESSIONS] or ctx.total_num_requests:
            # Only an unused application may have no replica.
            needed, needed_with_margin = max(1, needed), max(1, needed_with_margin)

        if needed > target:
            return needed, {}
        # A replica without a report may be busy.
        if needed_with_margin < target and len(reported) >= ctx.current_num_replicas:
            return needed_with_margin, {}
        return target, {}

    def _needed(self, totals: Mapping[str, float], margin: float) -> int:
        needed = max(totals[name] / (margin * target) for name, target in self._targets.items())
        return math.ceil(needed - _NOTHING)
