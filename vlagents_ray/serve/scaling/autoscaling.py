"""An autoscaling policy for Ray Serve, which derives the number of replicas from the measured load.

Serve's own policy counts requests. But a WebSocket counts as one request for as long as it is open,
and a session over shared memory or a Serve handle's actor does not count at all. Therefore each
replica reports these values (`record_autoscaling_stats`):

- `utilisation`: the share of the time that the replica's clients need its policy's thread, in
  [0, 1]. Time that robots with slack use only for fresher actions does not count.
- `sessions`: the number of its sessions (robots and envs), over all transports.

Serve averages the utilisation over `look_back_s`. Its controller calls the policy ten times a
second, limits the result to the minimum and maximum number of replicas, and applies it after a
delay. Utilisation must need a replica during the whole `upscale_delay_s`. The need of sessions
counts after all replicas have reported, since two replicas count a session while it moves.

The module is pickled by value for the controller, so it imports no other module of this package.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

UTILISATION = "utilisation"
SESSIONS = "sessions"

# A replica is removed only if the load of the remaining replicas stays below this share of each
# target, so that the number of replicas does not oscillate.
_MARGIN = 0.8
# Utilisation below which a replica counts as idle; the measured utilisation of an idle replica is
# some millionths.
_NOTHING = 1e-3
# Key of the policy's state: the time since which utilisation has needed more replicas, s; None if
# it does not.
_BUSY_SINCE = "busy_since"


class MeasuredLoad:
    """Requests the smallest number of replicas that keeps each replica below all targets. The state
    is stored in the context of the calls.

    Args:
        target_utilisation: Utilisation per replica, in [0, 1].
        target_sessions: Sessions per replica; by default, sessions only prevent scaling to zero.
        busy_s: Time for which utilisation must need more replicas before they are requested, s, in
            addition to Serve's own delay.
    """

    def __init__(
        self,
        *,
        target_utilisation: float = 0.7,
        target_sessions: float | None = None,
        busy_s: float = 0.0,
    ) -> None:
        self._target_utilisation = target_utilisation
        self._target_sessions = target_sessions
        self._busy_s = busy_s

    def __call__(self, ctx: Any) -> tuple[int, dict[str, Any]]:
        """Return the desired number of replicas for a `ray.serve.config.AutoscalingContext`, and
        the new state.
        """
        metrics: Mapping[str, Mapping[Any, float]] = ctx.aggregated_metrics or {}
        target: int = ctx.target_num_replicas
        reported = metrics.get(UTILISATION, {})
        if not reported:  # no replica runs, or none has reported yet
            return target, dict(ctx.policy_state or {})
        utilisation, sessions = sum(reported.values()), _sessions(ctx)

        by_utilisation = self._by_utilisation(utilisation, 1.0)
        state = {_BUSY_SINCE: _busy_since(ctx, by_utilisation)}
        if not self._is_due(ctx, state[_BUSY_SINCE]):
            by_utilisation = target
        needed = max(by_utilisation, self._by_sessions(sessions, 1.0))
        needed_with_margin = max(
            self._by_utilisation(utilisation, _MARGIN), self._by_sessions(sessions, _MARGIN)
        )
        if sessions or ctx.total_num_requests:
            # Only an unused application may be scaled to zero.
            needed, needed_with_margin = max(1, needed), max(1, needed_with_margin)

        if needed > target:
            return needed, state
        # A replica without a report may be busy.
        if needed_with_margin < target and len(reported) >= ctx.current_num_replicas:
            return needed_with_margin, state
        return target, state

    def _by_utilisation(self, utilisation: float, margin: float) -> int:
        """Return the number of replicas that the total utilisation needs."""
        return math.ceil(utilisation / (margin * self._target_utilisation) - _NOTHING)

    def _by_sessions(self, sessions: float, margin: float) -> int:
        """Return the number of replicas that the sessions need."""
        if self._target_sessions is None:
            return 0
        return math.ceil(sessions / (margin * self._target_sessions) - _NOTHING)

    def _is_due(self, ctx: Any, busy_since: float | None) -> bool:
        """Return whether the number of replicas that the utilisation needs may be applied."""
        return busy_since is None or bool(_now(ctx) - busy_since >= self._busy_s)


def _busy_since(ctx: Any, needed: int) -> float | None:
    """Return the time since which utilisation has needed more replicas than there are, s; None if
    it does not.
    """
    if needed <= ctx.target_num_replicas:
        return None
    since: float | None = (ctx.policy_state or {}).get(_BUSY_SINCE)
    return _now(ctx) if since is None else since


def _sessions(ctx: Any) -> float:
    """Return the number of sessions of all replicas, from their last reports, if there are any.
    Sessions come and go at once, so the mean is too late.
    """
    raw: Mapping[str, Mapping[Any, Any]] = ctx.raw_metrics or {}
    last_values = [series[-1].value for series in raw.get(SESSIONS, {}).values() if series]
    means: Mapping[str, Mapping[Any, float]] = ctx.aggregated_metrics or {}
    return sum(last_values or means.get(SESSIONS, {}).values())


def _now(ctx: Any) -> float:
    now: float = ctx.current_time or 0.0
    return now
