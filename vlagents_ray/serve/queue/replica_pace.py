"""The load of a replica from the needs of its robots, and the pace at which the robots replan.

If the robots of a busy replica sent their next requests as soon as they are answered, all requests
would wait in the queue, and their observations would become old. Therefore each answer contains the
time at which the robot's next request is useful. The robot waits until then, and sends a fresher
observation.

If the robots need more than the replica can compute, the robots that arrived first are *admitted*,
up to the largest load at which all of them are in time. The requests of all other robots wait
behind the requests of admitted robots. Otherwise, all robots would be slightly late.
"""

from __future__ import annotations

import math
import reprlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
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
from vlagents_ray.slo import SHARE, Slo

_READ_S = 0.5  # time after which the needs of all sessions are read again, s
# The same time at the beginning; it then doubles until it is `_READ_S`. The first curve is computed
# from a single batch, and later curves are soon more accurate.
_FIRST_READ_S = 0.02
# Share by which the observed rate of a robot must differ from the known rate to replace it. Equal
# robots thereby have equal needs.
_DIFFERS = 0.1
# Load up to which further robots are admitted if there are too many robots. Admitted robots stay
# admitted up to `USABLE`, so that variations of the measured costs do not withdraw and restore
# admissions.
_ADMITTED_LOAD = 0.86
# Time without a request, in addition to the duration of its rows, after which a robot does not
# count, s. It is then paused, or its client has left without ending the session.
_PRESENT_S = 10.0
# Load, and interval in ticks, up to which robots may send requests slightly more often than their
# pace.
_IDLE_LOAD, _FEW_TICKS = 0.5, 4
# Maximum number of kinds of robots for which the remaining room is searched, to save time.
_KINDS = 4
_MOST_SLACK_MS = 60_000.0  # limits the wait of a request in a queue that is never empty


@dataclass(slots=True)
class RobotPlan:
    """The needs of a session's robot, and the state of its plan according to its last request."""

    need: RobotNeed | None = None  # None until the need is known
    is_stated: bool = False  # whether the rate comes from an SLO
    share: float = SHARE  # smallest required share of ticks with an action in time
    # Maximum number of rows of an answer that the robot executes; None for all.
    most_rows: int | None = None
    # Whether the robot is among the robots that the replica can serve in time; None until that is
    # decided.
    is_admitted: bool | None = None
    key: str = ""  # prefix of the session ids of the robot's key; empty without a key
    heard: float = math.inf  # time at which the robot's last reset or act arrived, s; inf means now
    asked: float = 0.0  # time at which the robot's last act arrived, s; 0.0 before the first act
    # Time at which the robot begins to execute the rows of its last answer, s. If its rows had run
    # out, the time for which it stood still is skipped.
    begins: float = 0.0

    def to_list(self) -> list[Any]:
        """Return the plan as a list, for the replica to which the session moves."""
        need = self.need
        if need is None:
            return []
        return [need.hz, need.rows, need.age_s, self.is_stated, self.share, self.most_rows]

    @classmethod
    def from_list(cls, values: Sequence[Any], key: str, now: float) -> RobotPlan:
        """Return the plan of a session of a key that moves here `now`, s, from the result of
        `to_list`.
        """
        plan = cls(key=key, heard=now)
        if values:
            hz, rows, age_s, plan.is_stated, plan.share, plan.most_rows = values
            plan.need = RobotNeed(hz, rows, age_s)
        return plan

    @classmethod
    def from_slo(cls, slo: Slo, rows: int) -> RobotPlan:
        """Return the plan of a robot with the SLO `slo`, if an answer has `rows` rows."""
        return cls(need_of(slo, rows), is_stated=True, share=slo.share, most_rows=slo.rows)

    def is_present(self, now: float) -> bool:
        """Return whether the robot has sent a request recently, at the time `now`, s."""
        rows_s = 0.0 if self.need is None else self.need.rows / self.need.hz
        return now - self.heard <= _PRESENT_S + rows_s

    @property
    def waits_behind_others(self) -> bool:
        """Whether the requests of admitted robots are served before the requests of this robot."""
        return self.is_admitted is False

    def observe(self, rows: int, arrived: float, needed: float, now: float) -> None:
        """Update the needs of the robot from an act.

        Args:
            rows: The number of rows of the answer.
            arrived: The time at which the act arrived, s.
            needed: The time at which the robot runs out of rows, s; 0.0 if the robot did not send
                its slack.
            now: The time at which the act is answered, s.
        """
        if self.most_rows is not None:
            rows = min(rows, self.most_rows)
        asked, self.asked = self.asked, arrived
        began = self.begins
        # The robot skips one row for each action that it executed while it waited.
        self.begins = now - min(now - arrived, max(0.0, needed - arrived))
        if self.is_stated:
            if self.need is not None and self.need.rows != rows:
                self.need = RobotNeed(self.need.hz, rows, self.need.age_s)
            return
        if not needed or needed <= arrived or not asked:
            return

        # The robot's remaining rows come from the previous answer. If an answer has one row, the
        # robot sends a request at each tick.
        plan_s = needed - began if rows > 1 else arrived - asked
        if plan_s <= 0:
            return
        hz = float(f"{rows / plan_s:.2g}")
        known = self.need
        if known is None or known.rows != rows or abs(hz - known.hz) > _DIFFERS * known.hz:
            self.need = RobotNeed(hz, rows)


def need_of(slo: Slo, rows: int) -> RobotNeed:
    """Return the needs of a robot with the SLO `slo`, if an answer has `rows` rows."""
    executed_rows = rows if slo.rows is None else min(rows, slo.rows)
    return RobotNeed(slo.hz, executed_rows, None if slo.age_ms is None else slo.age_ms / 1e3)


def stated_slack_s(info: Mapping[str, Any]) -> float | None:
    """Return the slack in the info of an observation, s; None if there is none.

    Raises:
        InvalidInput: The slack is not a finite number of at least 0.
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
        plans: Returns the plan of each session, the oldest session first.
        max_batch_size: The largest batch.
        clock: The engine's clock, s.
        depth: Returns the number of requests that wait.
    """

    def __init__(
        self,
        curve: Callable[[], CostCurve | None],
        plans: Callable[[], Iterable[RobotPlan]],
        max_batch_size: int,
        clock: Callable[[], float],
        depth: Callable[[], int],
    ) -> None:
        self._curve, self._plans = curve, plans
        self._max_batch_size, self._clock = max_batch_size, clock
        self._depth = depth
        self._load = IDLE  # load of all robots, except robots that cannot be in time
        self._admitted_load = IDLE
        # The size up to which batches are filled with requests of robots that are not admitted. In
        # larger batches, the answers of the admitted robots would be late.
        self.most_with_others: float = math.inf
        self._robots = 0
        self._others = 0  # number of robots that are not admitted
        self._throughput_hz = math.inf  # maximum number of answers per second
        self._read = -math.inf  # time at which the needs were read, s
        self._reread_s = _FIRST_READ_S  # time after which the needs are read again, s

    def load(self) -> ReplicaLoad:
        """Return the load, at most half a second old, of the robots that can be in time."""
        now = self._clock()
        if now - self._read > self._reread_s:
            self._read = now
            self._reread_s = min(_READ_S, 2 * self._reread_s)
            self._read_plans()
        return self._load

    def check(self, newcomer: RobotNeed, key: str = "") -> dict[str, Any]:
        """Return whether one more robot can be in time here, as the info of its reset.

        Args:
            newcomer: The needs of the new robot.
            key: The prefix of the sessions of its key.
        """
        self.load()
        load = self._load_with(newcomer)
        # Robots that wait for admission come before the new robot.
        most = _ADMITTED_LOAD if self._others else USABLE
        if load.load <= most or self._fits_share(newcomer, key):
            return {"load": load.load, "in_time": True}
        if load.load == math.inf:
            reason = (
                f"expected actions at {newcomer.hz:g} Hz, but an answer takes up to "
                f"{load.latency_s * 1e3:.0f} ms here; lower the rate, or use longer chunks"
            )
            return {"load": None, "in_time": False, "reason": reason}
        reason = (
            f"expected a load of at most {most:g} with this robot, got {load.load:.2f}; add a "
            "replica, or lower the robots' rates"
        )
        return {"load": load.load, "in_time": False, "reason": reason}

    def _fits_share(self, newcomer: RobotNeed, key: str) -> bool:
        """Return whether one more robot of a key fits into the part of the load that is reserved
        for that key, regardless of the needs of other keys' robots.
        """
        curve = self._curve()
        if curve is None:
            return True
        plans = self._present()
        keys = {key, *(plan.key for plan in plans)}
        needs = _needs_of(plan for plan in plans if plan.key == key)
        needs[newcomer] += 1
        if newcomer.interval_s(answer_s(curve, 1, len(plans) + 1)) <= 0:
            return False
        return self._load_of(needs, curve).load <= _ADMITTED_LOAD / len(keys)

    def _load_with(self, newcomer: RobotNeed) -> ReplicaLoad:
        """Return the load of the admitted robots and a new robot; `inf` if the new robot cannot be
        in time at this replica.
        """
        curve = self._curve()
        if curve is None:
            return IDLE
        needs = _needs_of(plan for plan in self._present() if not plan.waits_behind_others)
        needs[newcomer] += 1
        soonest_s = answer_s(curve, 1, needs.total())
        if newcomer.interval_s(soonest_s) <= 0:
            return ReplicaLoad(math.inf, 1, soonest_s)
        return self._load_of(needs, curve)

    def replan_s(self, plan: RobotPlan) -> float:
        """Return the time from now until the next request of a robot is useful, s; 0 if the robot
        may send it immediately.

        Args:
            plan: The plan of the robot, which has observed the act that is answered now.
        """
        self.load()
        need, now = plan.need, self._clock()
        # For an admitted robot, the requests of robots that are not admitted do not count, since
        # they wait behind its requests.
        waiting = self._depth() if plan.waits_behind_others else self._depth() - self._others
        # A request that is sent before the waiting requests are answered would have to wait.
        waiting_s = max(0, waiting) / self._throughput_hz
        if need is None:
            return waiting_s
        if self._robots < 2:
            return 0.0

        load = self._admitted_load
        longest_s = need.interval_s(load.latency_s)
        if plan.waits_behind_others:
            # An answer is most useful if all earlier rows have been executed.
            interval_s = max(longest_s, need.rows / need.hz)
        else:
            # If several robots sent requests at the same time, the robot that is answered first
            # sends its next request first. Their next requests then do not arrive at the same time
            # again.
            waited_s = now - plan.asked
            earlier_s = (waiting_s - max(0.0, waited_s - load.latency_s)) / 2
            backlog_s = now - plan.begins + waiting_s
            interval_s = min(longest_s, max(backlog_s, load.replan_s(need) - earlier_s))
        # A robot sends its request at the next tick, half a period later on average. If the load is
        # low and a tick is a large part of the interval, the time is rounded so that the robot
        # sends the request earlier instead.
        is_early = load.load <= _IDLE_LOAD and interval_s <= _FEW_TICKS / need.hz
        early_s = (1.0 if is_early else 0.5) / need.hz
        return max(0.0, plan.begins + interval_s - early_s - now)

    def _present(self) -> list[RobotPlan]:
        """Return the plans of the robots whose needs are known and that send requests."""
        now = self._clock()
        return [plan for plan in self._plans() if plan.need is not None and plan.is_present(now)]

    def _withdraw_admissions(self) -> None:
        """Withdraw the admission of robots that send no requests. Their admission is decided again
        when they send requests.
        """
        now = self._clock()
        for plan in self._plans():
            if not plan.is_present(now):
                plan.is_admitted = None

    def _read_plans(self) -> None:
        """Compute the loads, and decide which robots are admitted."""
        self._withdraw_admissions()
        plans = self._present()
        curve = self._curve()
        self._robots, self._others = len(plans), 0
        self.most_with_others = math.inf
        if curve is None:
            self._load = self._admitted_load = IDLE
            return
        self._throughput_hz = self._max_batch_size / curve.cost_s(self._max_batch_size)
        self._load = self._admitted_load = self._load_of(_needs_of(plans), curve)
        if self._load.in_time:
            for plan in plans:
                plan.is_admitted = True
            return

        admitted = self._choose_admitted(plans, curve)
        self._admitted_load = self._load_of(_needs_of(admitted), curve)
        self.most_with_others = self._admitted_load.batch_size
        self._others = len(plans) - len(admitted)
        # Each value is assigned only once here, since the threads that accept requests read it.
        admitted_ids = {id(plan) for plan in admitted}
        for plan in plans:
            plan.is_admitted = id(plan) in admitted_ids

    def _choose_admitted(self, plans: Sequence[RobotPlan], curve: CostCurve) -> list[RobotPlan]:
        """Return the robots that can be in time together: first the robots that are already
        admitted, then the oldest other robots. A part of the load is reserved for each key. The
        robots of one key therefore never displace the robots of another key, regardless of their
        number and their time of arrival.
        """
        # A robot that cannot be in time even alone is never admitted.
        soonest_s = answer_s(curve, 1, len(plans))
        servable = [
            plan for plan in plans if plan.need is not None and plan.need.interval_s(soonest_s) > 0
        ]
        kept = [plan for plan in servable if plan.is_admitted]
        others = [plan for plan in servable if not plan.is_admitted]

        admitted: list[RobotPlan] = []
        keys = sorted({plan.key for plan in servable})
        if len(keys) > 1:
            for key in keys:
                of_key = [plan for plan in (*kept, *others) if plan.key == key]
                count = self._fitting([], of_key, _ADMITTED_LOAD / len(keys), curve)
                admitted += of_key[:count]

        for candidates, most in ((kept, USABLE), (others, _ADMITTED_LOAD)):
            known = {id(plan) for plan in admitted}
            left = [plan for plan in candidates if id(plan) not in known]
            for _ in range(_KINDS):
                count = self._fitting(admitted, left, most, curve)
                admitted += left[:count]
                if count == len(left):
                    break
                # There is no room for another robot of this kind.
                full = left[count].need
                left = [plan for plan in left[count:] if plan.need != full]
        return admitted

    def _fitting(
        self,
        admitted: Sequence[RobotPlan],
        candidates: Sequence[RobotPlan],
        most: float,
        curve: CostCurve,
    ) -> int:
        """Return how many of the first candidates fit next to the admitted robots with a load of at
        most `most`.
        """
        fits, too_many = 0, len(candidates) + 1
        while too_many - fits > 1:
            count = (fits + too_many) // 2
            needs = _needs_of([*admitted, *candidates[:count]])
            if self._load_of(needs, curve).load <= most:
                fits = count
            else:
                too_many = count
        return fits

    def _load_of(self, needs: Mapping[RobotNeed, int], curve: CostCurve) -> ReplicaLoad:
        robots = sum(needs.values())
        if not robots:
            return IDLE
        # A robot that cannot be in time even alone does not count, since it would make the load
        # `inf`.
        soonest_s = answer_s(curve, 1, robots)
        servable = {need: count for need, count in needs.items() if need.interval_s(soonest_s) > 0}
        return replica_load(curve, servable, self._max_batch_size)


def _needs_of(plans: Iterable[RobotPlan]) -> Counter[RobotNeed]:
    return Counter(plan.need for plan in plans if plan.need is not None)
