"""An autoscaling policy for Ray Serve, which derives the number of replicas from the measured load.

Serve's own policy counts requests. But a WebSocket counts as one request for as long as it is open,
and a session over shared memory or a Serve handle's actor does not count at all. Therefore each
replica reports these values (`record_autoscaling_stats`):

- `utilisation`: the share of the time in which its policy's thread was busy, in [0, 1].
- `waiting`: the mean number of requests in its batch queue, in batches of the largest size.
- `sessions`: the number of its sessions (robots and envs), over all transports.
- `slo_load`: the share of a replica that its robots need to be in time, according to their SLOs and
  the measured costs of its batches (`vlagents_ray.serve.scaling.slo_load`).
- `moved_load`: the part of that load whose sessions have just moved from other replicas.
- `slo_robots`: the number of its sessions with an SLO.
- `late_robots`: the number of its robots that were not in time recently.

Serve averages these values over `look_back_s`. Its controller calls the policy ten times a second,
limits the result to the minimum and maximum number of replicas, and applies it after a delay.

The needs of robots are known at their resets, so `slo_load` is not averaged, and a burst of robots
gets all its replicas together. Its delay is only a second, in which the first measured costs of
batches become more accurate. A replica reports `slo_load` as soon as it has changed. While a
session moves, and until Serve has noticed that a replica was killed, two replicas count the
session; `moved_load` therefore requests no replica. The need of sessions counts after all replicas
have reported. Utilisation and queues must need a replica during the whole `upscale_delay_s`. A
robot replans more often than necessary while its replica has capacity, so utilisation and queues do
not show the needs of robots with an SLO. They are not used if all sessions have an SLO.

If robots are late although there are as many replicas as the load needs, one more replica is
requested. The number of robots is remembered for an hour, so that the replica is not repeatedly
removed and requested.

The module is pickled by value for the controller, so it imports no other module of this package.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

UTILISATION = "utilisation"
WAITING = "waiting"
SESSIONS = "sessions"
SLO_LOAD = "slo_load"
MOVED_LOAD = "moved_load"
SLO_ROBOTS = "slo_robots"
LATE_ROBOTS = "late_robots"

_REPORTED = (UTILISATION, WAITING, SESSIONS, SLO_LOAD, MOVED_LOAD, SLO_ROBOTS, LATE_ROBOTS)
# Values that change only when a robot arrives, leaves or is reset. The last report is used, not the
# mean.
_EXACT = (SESSIONS, SLO_LOAD, MOVED_LOAD, SLO_ROBOTS)

# A replica is removed only if the load of the remaining replicas stays below this share of each
# target, so that the number of replicas does not oscillate.
_MARGIN = 0.8
# Utilisation below which a replica counts as idle; the measured utilisation of an idle replica is
# some millionths.
_NOTHING = 1e-3
# Time after a change of the number of replicas or robots in which late robots do not count, s, in
# addition to the averaging time. Sessions move within 10 s, and shares cover the last 10 s.
_SETTLE_S = 20.0
_REMEMBERED_S = 3600.0  # time for which late robots are remembered, s

# Keys of the policy's state. `_TOO_MANY`: for each number of replicas, the number of robots that
# was too large for it, and the time at which that was observed, s. `_STEADY`: the current numbers
# of replicas and robots, and the time of their last change, s. `_BUSY_SINCE`, `_CROWDED_SINCE`: the
# time since which utilisation and queues, or sessions, have needed more replicas, s; None if they
# do not.
_TOO_MANY = "too_many"
_STEADY = "steady"
_BUSY_SINCE = "busy_since"
_CROWDED_SINCE = "crowded_since"


class MeasuredLoad:
    """Requests the smallest number of replicas that keeps each replica below all targets. The state
    is stored in the context of the calls.

    Args:
        target_utilisation: Utilisation per replica, in [0, 1].
        target_waiting: Mean queue length per replica, in batches of the largest size.
        target_sessions: Sessions per replica; by default, sessions only prevent scaling to zero.
        target_slo_load: Load of a replica according to the SLOs of its robots, in (0, 1].
        busy_s: Time for which utilisation or queues must need more replicas before they are
            requested, s, in addition to Serve's own delay.
        crowded_s: Time for which sessions must need more replicas, s, in addition to Serve's own
            delay.
    """

    def __init__(
        self,
        *,
        target_utilisation: float = 0.7,
        target_waiting: float = 1.0,
        target_sessions: float | None = None,
        target_slo_load: float = 0.8,
        busy_s: float = 0.0,
        crowded_s: float = 0.0,
    ) -> None:
        self._targets = {UTILISATION: target_utilisation, WAITING: target_waiting}
        self._target_sessions = target_sessions
        self._target_slo_load = target_slo_load
        self._busy_s = busy_s
        self._crowded_s = crowded_s

    def __call__(self, ctx: Any) -> tuple[int, dict[str, Any]]:
        """Return the desired number of replicas for a `ray.serve.config.AutoscalingContext`, and
        the new state.
        """
        metrics: Mapping[str, Mapping[Any, float]] = ctx.aggregated_metrics or {}
        target: int = ctx.target_num_replicas
        reported = metrics.get(UTILISATION, {})
        if not reported:  # no replica runs, or none has reported yet
            return target, _kept(ctx)
        totals = {name: sum(metrics.get(name, {}).values()) for name in _REPORTED}
        totals |= _last_totals(ctx)

        by_load, by_sessions = self._by_load(totals, 1.0), self._by_sessions(totals, 1.0)
        by_needs = self._by_needs(totals, totals[SLO_LOAD])
        # The memory of late robots is kept while there are no late robots.
        state = _observe(ctx, totals, len(reported), max(by_load, by_sessions, by_needs))
        if not _is_due(ctx, state, _BUSY_SINCE, by_load, self._busy_s):
            by_load = target
        if not _is_due(ctx, state, _CROWDED_SINCE, by_sessions, self._crowded_s):
            by_sessions = target
        newly_needed = self._by_needs(totals, totals[SLO_LOAD] - totals[MOVED_LOAD])
        needed = max(by_load, by_sessions, newly_needed)
        needed_with_margin = max(
            self._by_load(totals, _MARGIN),
            self._by_sessions(totals, _MARGIN),
            self._by_needs(totals, totals[SLO_LOAD] / _MARGIN),
        )

        least = _least_replicas(state[_TOO_MANY], totals[SLO_ROBOTS])
        needed, needed_with_margin = max(needed, least), max(needed_with_margin, least)
        if totals[SESSIONS] or ctx.total_num_requests:
            # Only an unused application may be scaled to zero.
            needed, needed_with_margin = max(1, needed), max(1, needed_with_margin)

        if needed > target:
            return needed, state
        # A replica without a report may be busy.
        if needed_with_margin < target and len(reported) >= ctx.current_num_replicas:
            return needed_with_margin, state
        return target, state

    def _by_load(self, totals: Mapping[str, float], margin: float) -> int:
        """Return the number of replicas that utilisation and queues need."""
        robots = totals[SLO_ROBOTS]
        if robots > 0 and robots >= totals[SESSIONS]:
            return 0
        shares = [totals[name] / (margin * target) for name, target in self._targets.items()]
        return math.ceil(max(shares) - _NOTHING)

    def _by_sessions(self, totals: Mapping[str, float], margin: float) -> int:
        """Return the number of replicas that the sessions need."""
        if self._target_sessions is None:
            return 0
        return math.ceil(totals[SESSIONS] / (margin * self._target_sessions) - _NOTHING)

    def _by_needs(self, totals: Mapping[str, float], load: float) -> int:
        """Return the number of replicas that the robots with an SLO need to be in time, for a given
        load.
        """
        # More replicas than robots would be useless.
        needed = min(totals[SLO_ROBOTS], load / self._target_slo_load)
        return math.ceil(needed - _NOTHING)


def _last_totals(ctx: Any) -> dict[str, float]:
    """Return the sums of the last reports of the exact values, without values that no replica
    reports.
    """
    totals = {}
    raw: Mapping[str, Mapping[Any, Any]] = ctx.raw_metrics or {}
    for name in _EXACT:
        last_values = [series[-1].value for series in raw.get(name, {}).values() if series]
        if last_values:
            totals[name] = sum(last_values)
    return totals


def _now(ctx: Any) -> float:
    now: float = ctx.current_time or 0.0
    return now


def _kept(ctx: Any) -> dict[str, Any]:
    """Return the state after the last call."""
    state: Mapping[str, Any] = ctx.policy_state or {}
    names = (_TOO_MANY, _STEADY, _BUSY_SINCE, _CROWDED_SINCE)
    return {name: state[name] for name in names if name in state}


def _is_due(ctx: Any, state: dict[str, Any], name: str, needed: int, delay_s: float) -> bool:
    """Return whether the number `needed` of a measure may be applied: it has exceeded the number of
    replicas for `delay_s`, or does not exceed it.

    Args:
        ctx: The context of the call.
        state: The policy's new state, in which the time since then is stored.
        name: Name of that time in the state.
        needed: The number of replicas.
        delay_s: The time, s.
    """
    if needed <= ctx.target_num_replicas:
        state[name] = None
        return True
    since = _kept(ctx).get(name)
    if since is None:
        since = _now(ctx)
    state[name] = since
    return bool(_now(ctx) - since >= delay_s)


def _observe(ctx: Any, totals: Mapping[str, float], reporting: int, needed: int) -> dict[str, Any]:
    """Return the new state.

    Args:
        ctx: The context of the call.
        totals: The sums of the reported values.
        reporting: The number of replicas that report.
        needed: The number of replicas that the load needs.
    """
    state = _kept(ctx)
    now = _now(ctx)
    robots = totals[SLO_ROBOTS]
    replicas_then, robots_then, since = state.get(_STEADY, (None, None, now))
    if (reporting, robots) != (replicas_then, robots_then):
        since = now

    too_many = {
        replicas: (count, when)
        for replicas, (count, when) in state.get(_TOO_MANY, {}).items()
        if now - when < _REMEMBERED_S
    }
    settle_s = _SETTLE_S + getattr(ctx.config, "look_back_period_s", 0.0)
    is_settled = now - since >= settle_s and reporting >= ctx.target_num_replicas
    # If robots are late with one replica more than the load needs, there is another cause, such as
    # the network.
    may_help = reporting == max(1, needed) and reporting < robots
    # The value is a mean over the averaging time; 0.5 means that a robot was late during half of
    # this time.
    if is_settled and may_help and totals[LATE_ROBOTS] >= 0.5:
        too_many[reporting] = (robots, now)
    return {_TOO_MANY: too_many, _STEADY: (reporting, robots, since)}


def _least_replicas(too_many: Mapping[int, tuple[float, float]], robots: float) -> int:
    """Return the smallest number of replicas with which this number of robots was not late."""
    return max(
        (replicas + 1 for replicas, (count, _) in too_many.items() if robots >= count), default=0
    )
