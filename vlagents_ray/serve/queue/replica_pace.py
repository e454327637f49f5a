"""The load of a replica by what its robots need, and the pace at which they replan.

A robot that asks again as soon as it is answered makes all robots of a busy replica wait in the
queue, where their observations grow old. So each answer names the time at which the robot's next
request is useful, and the robot waits at home, with fresher observations.
"""

from __future__ import annotations

import math
import reprlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import SLACK
from vlagents_ray.serve.fleet import (
    IDLE,
    USABLE,
    CostCurve,
    ReplicaLoad,
    RobotNeed,
    answer_s,
    replica_load,
)
from vlagents_ray.slo import Slo

_READ_S = 0.5  # time after which the needs of all sessions are read again
# The same after the first time; it doubles until it is `_READ_S`. The first curve is of one batch,
# and the next ones are soon better.
_FIRST_READ_S = 0.02
# Share by which the observed rate of a robot must differ from the known one to replace it, so that
# the needs of equal robots are equal.
_DIFFERS = 0.1
_MOST_SLACK_MS = 60_000.0  # so that no request waits for longer in a queue that is never empty


@dataclass(slots=True)
class RobotPlan:
    """What a session's robot needs, and what its last request showed of its plan."""

    need: RobotNeed | None = None  # None until it is known
    is_stated: bool = False  # whether the robot's own SLO states the rate
    asked: float = 0.0  # time at which its last act arrived, s; 0.0 before the first one

    def to_list(self) -> list[Any]:
        """Return the plan for another replica, to which the session moves."""
        need = self.need
        if need is None:
            return []
        return [need.hz, need.rows, need.age_s, self.is_stated]

    @classmethod
    def from_list(cls, values: Sequence[Any]) -> RobotPlan:
        """Return the plan of a session that has moved here, from the result of `to_list`."""
        if not values:
            return cls()
        hz, rows, age_s, is_stated = values
        return cls(RobotNeed(hz, rows, age_s), is_stated)

    def observe(self, rows: int, arrived: float, needed: float) -> None:
        """Learn from an act what the robot needs.

        Args:
            rows: The number of rows of the answer.
            arrived: The time at which the act arrived, s.
            needed: The time at which the robot runs out of rows, s; 0.0 if it did not state it.
        """
        asked, self.asked = self.asked, arrived
        if self.is_stated:
            if self.need is not None and self.need.rows != rows:
                self.need = replace(self.need, rows=rows)
            return
        if not needed or needed <= arrived or not asked:
            return

        # The rows that are left are those of the answer to the request before. With one row an
        # answer, there is a request at each tick.
        plan_s = needed - asked if rows > 1 else arrived - asked
        if plan_s <= 0:
            return
        hz = float(f"{rows / plan_s:.2g}")
        known = self.need
        if known is None or known.rows != rows or abs(hz - known.hz) > _DIFFERS * known.hz:
            self.need = RobotNeed(hz, rows)


def need_of(slo: Slo, rows: int) -> RobotNeed:
    """Return what a robot with that SLO needs, if an answer has `rows` rows."""
    executed_rows = rows if slo.rows is None else min(rows, slo.rows)
    return RobotNeed(slo.hz, executed_rows, None if slo.age_ms is None else slo.age_ms / 1e3)


def stated_slack_s(info: Mapping[str, Any]) -> float | None:
    """Return the slack in the info of an observation, s; None if it states none.

    Raises:
        InvalidInput: It is not a finite number of at least 0.
    """
    slack_ms = info.get(SLACK)
    if slack_ms is None:
        return None
    # A NaN fails the comparison.
    if type(slack_ms) not in (int, float) or not 0 <= slack_ms < math.inf:
        raise InvalidInput(
            f"info[{SLACK!r}]: expected a finite number of at least 0 ms, got "
            f"{reprlib.repr(slack_ms)}; leave it out if the time is unknown"
        )
    return min(float(slack_ms), _MOST_SLACK_MS) / 1e3


class ReplicaPace:
    """The load of a replica, and the pace of its robots. Its callers need no lock.

    Args:
        curve: Returns the measured durations of batches; None before the first batch.
        needs: Returns what each robot of the replica needs.
        max_batch_size: The largest batch.
        clock: The engine's clock, s.
        depth: Returns the number of requests that wait.
    """

    def __init__(
        self,
        curve: Callable[[], CostCurve | None],
        needs: Callable[[], Iterable[RobotNeed | None]],
        max_batch_size: int,
        clock: Callable[[], float],
        depth: Callable[[], int],
    ) -> None:
        self._curve, self._needs = curve, needs
        self._max_batch_size, self._clock = max_batch_size, clock
        self._depth = depth
        self._load = IDLE
        self._robots = 0
        self._throughput_hz = math.inf  # largest number of answers a second
        self._read = -math.inf  # time at which the needs were read, s
        self._reread_s = _FIRST_READ_S  # time after which they are read again, s

    def load(self) -> ReplicaLoad:
        """Return the load, at most half a second old, of the robots that can be in time."""
        now = self._clock()
        if now - self._read > self._reread_s:
            self._read = now
            self._reread_s = min(_READ_S, 2 * self._reread_s)
            needs = Counter(need for need in self._needs() if need is not None)
            self._robots = needs.total()
            self._load = self._load_of(needs)
        return self._load

    def check(self, newcomer: RobotNeed) -> dict[str, Any]:
        """Return whether one more robot can be in time here, as the info of its reset."""
        load = self._load_with(newcomer)
        if load.in_time:
            return {"load": load.load, "in_time": True}
        if load.load == math.inf:
            reason = (
                f"expected actions at {newcomer.hz:g} Hz, but the policy takes "
                f"{load.latency_s * 1e3:.0f} ms for a request alone; lower the rate, or use longer "
                "chunks"
            )
            return {"load": None, "in_time": False, "reason": reason}
        reason = (
            f"expected a load of at most {USABLE:g} with this robot, got {load.load:.2f}; add a "
            "replica, or lower the robots' rates"
        )
        return {"load": load.load, "in_time": False, "reason": reason}

    def _load_with(self, newcomer: RobotNeed) -> ReplicaLoad:
        """Return the load with one more robot; it is `inf` if that cannot be in time even alone."""
        curve = self._curve()
        if curve is None:
            return IDLE
        if newcomer.interval_s(curve.cost_s(1)) <= 0:
            return ReplicaLoad(math.inf, 1, curve.cost_s(1))
        needs = Counter(need for need in self._needs() if need is not None)
        needs[newcomer] += 1
        return self._load_of(needs)

    def replan_s(self, need: RobotNeed, arrived: float, needed: float) -> float:
        """Return the time from now until the next request of a robot is useful, s; 0 if it may ask
        at once.

        Args:
            need: What the robot needs.
            arrived: The time at which its last request arrived, s.
            needed: The time at which its plan ended, without the answer to that request, s.
        """
        load = self.load()
        if self._robots < 2:
            return 0.0
        now = self._clock()
        longest_s = need.interval_s(load.latency_s)
        # A request that is sent before those that wait are answered would wait, too.
        waited_s = now - arrived
        waiting_s = self._depth() / self._throughput_hz
        # Of robots that asked at once, the first one that is answered asks again first, so that
        # their next requests do not come at once again.
        earlier_s = (waiting_s - max(0.0, waited_s - load.latency_s)) / 2
        interval_s = max(waited_s + waiting_s, load.replan_s(need) - earlier_s)
        interval_s = min(longest_s, interval_s)
        # A robot that holds still executes no row of the new plan meanwhile, which ends later.
        held_s = max(0.0, now - needed)
        # A robot sends its request at the next tick, half a period later on average.
        return max(0.0, arrived + held_s + interval_s - 0.5 / need.hz - now)

    def _load_of(self, needs: Mapping[RobotNeed, int]) -> ReplicaLoad:
        curve = self._curve()
        robots = sum(needs.values())
        if curve is None or not robots:
            return IDLE
        # A robot that cannot be in time at all says nothing about the others.
        soonest_s = answer_s(curve, 1, robots)
        servable = {need: count for need, count in needs.items() if need.interval_s(soonest_s) > 0}
        self._throughput_hz = self._max_batch_size / curve.cost_s(self._max_batch_size)
        return replica_load(curve, servable, self._max_batch_size)
