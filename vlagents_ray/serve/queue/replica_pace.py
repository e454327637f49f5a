"""The pace at which the robots of a replica replan.

If the robots of a busy replica sent their next requests as soon as they are answered, all requests
would wait in the queue, and their observations would become old. Therefore each answer contains the
time at which the robot's next request is useful. The robot waits until then, and sends a fresher
observation. The needs of the robots are read from their requests.

If the robots need more than the replica can compute, the robots whose episodes began first are
served first, as many as can be in time. The requests of the other robots wait behind their
requests. Otherwise, all robots would be slightly late.

Robots that send no slack, and simulations, get what the robots with known needs leave: a batch with
their requests is only so large that these robots are in time, who then send their requests earlier.
"""

from __future__ import annotations

import bisect
import math
import reprlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from vlagents_ray.errors import InvalidInput
from vlagents_ray.interface import SLACK
from vlagents_ray.serve.queue.robots_load import (
    IDLE,
    USABLE,
    CostCurve,
    RobotNeed,
    RobotsLoad,
    Room,
    answer_s,
    robots_load,
    room_for_others,
)

_READ_S = 0.5  # time after which the needs of all sessions are read again, s
# The same time at the beginning; it then doubles until it is `_READ_S`. The first curve is computed
# from a single batch, and later curves are soon more accurate.
_FIRST_READ_S = 0.02
# Share by which the observed rate of a robot must differ from the known rate to replace it. Equal
# robots thereby have equal needs.
_DIFFERS = 0.1
# Time without a request, in addition to the duration of its rows, after which a robot does not
# count, s. It is then paused, or its client has left without ending the session.
_PRESENT_S = 10.0
# Load, and interval in ticks, up to which robots may send requests slightly more often than their
# pace.
_IDLE_LOAD, _FEW_TICKS = 0.5, 4
# Number of answers for which the rows of a robot behind others must last, so that it can be in time
# with the places that other robots leave.
_SEVERAL_ANSWERS = 4
_MOST_SLACK_MS = 60_000.0  # limits the wait of a request in a queue that is never empty


@dataclass(slots=True)
class RobotPlan:
    """The needs of the robot of an episode, and the state of its plan according to its last
    request.
    """

    need: RobotNeed | None = None  # None until the need is known
    # Time of the last answer to the robot's acts, or of the arrival of its reset, s; inf means now.
    heard: float = math.inf
    # Time at which the robot's last answered act arrived, s; 0.0 before the first answer.
    asked: float = 0.0
    # Time at which the robot begins to execute the rows of its last answer, s. If its rows had run
    # out, the time for which it stood still is skipped.
    begins: float = 0.0
    began: float = 0.0  # time at which the episode began, s
    # Whether the requests of other robots are served first, since not all robots can be in time.
    waits_behind_others: bool = False

    def to_list(self) -> list[Any]:
        """Return the needs as a list, for the replica to which the session moves."""
        return [] if self.need is None else [self.need.hz, self.need.rows]

    @classmethod
    def from_list(cls, values: Sequence[Any], began: float, now: float) -> RobotPlan:
        """Return the plan of a session that moves here at `now`, s, and whose episode began at
        `began`, s, from the result of `to_list`.
        """
        return cls(RobotNeed(*values) if values else None, began=began, heard=now)

    @property
    def sends_slack(self) -> bool:
        """Whether the robot has sent its slack."""
        return self.need is not None or self.asked > 0

    def is_present(self, now: float, *, waits: bool) -> bool:
        """Return whether a request of the robot waits, or was answered recently, at the time `now`,
        s.
        """
        rows_s = 0.0 if self.need is None else self.need.longest_s
        return waits or now - self.heard <= _PRESENT_S + rows_s

    def observe(self, rows: int, arrived: float, needed: float, now: float) -> None:
        """Update the needs of the robot from an act.

        Args:
            rows: The number of rows of the answer.
            arrived: The time at which the act arrived, s.
            needed: The time at which the robot runs out of rows, s; 0.0 if the robot did not send
                its slack.
            now: The time at which the act is answered, s.
        """
        asked, self.asked = self.asked, arrived
        self.heard = now
        began = self.begins
        # The robot skips one row for each action that it executed while it waited.
        self.begins = now - min(now - arrived, max(0.0, needed - arrived))
        if not needed or needed <= arrived or not asked:
            return

        # The robot's remaining rows come from the previous answer. If an answer has one row, the
        # robot sends a request at each tick.
        plan_s = needed - began if rows > 1 else arrived - asked
        if plan_s <= 0:
            return
        # A robot that executes only the first rows of each answer seems to be faster. Its interval
        # is correct nevertheless, since it is the time of the rows that it executes.
        hz = float(f"{rows / plan_s:.2g}")
        known = self.need
        if known is None or known.rows != rows or abs(hz - known.hz) > _DIFFERS * known.hz:
            self.need = RobotNeed(hz, rows)


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


class PacedQueue(Protocol):
    """The queue of a replica, as its pace sees it: a `BatchQueue`."""

    largest: int  # the largest batch
    room: Room | None  # see `FairQueue.room`

    def had_others(self) -> bool:
        """Return whether requests waited behind the robots that are served first, since the last
        call.
        """

    def curve(self) -> CostCurve | None:
        """Return the measured durations of batches; None before the first batch."""

    def depth_first(self) -> int:
        """Return the number of waiting requests of robots that are served first."""


class ReplicaPace:
    """The load of a replica, the pace of its robots, and the room that they leave to other clients
    in the batches of the queue. Its callers need no lock.

    Args:
        queue: The replica's queue.
        plans: Returns the plan of each session, and whether a request of the session waits.
        clock: The engine's clock, s.
    """

    def __init__(
        self,
        queue: PacedQueue,
        plans: Callable[[], Iterable[tuple[RobotPlan, bool]]],
        clock: Callable[[], float],
    ) -> None:
        self._queue, self._plans, self._clock = queue, plans, clock
        self._load = IDLE  # load of the robots that are served first
        # Number of robots that send their slack. While there are some, `load` must be called after
        # each batch and idle time; otherwise the last robot that leaves would keep its room.
        self.robots = 0
        self._others = 0  # number of robots that wait behind others
        # Number of waiting requests for which no robot replans earlier, so that the robots behind
        # others get these places in batches. In the simulation of 445 robots with 50 rows, 444 are
        # in time, and 430 without this.
        self._places = 0
        self._throughput_hz = math.inf  # maximum number of answers per second
        self._read = -math.inf  # time at which the needs were read, s
        self._reread_s = _FIRST_READ_S  # time after which the needs are read again, s

    def load(self) -> RobotsLoad:
        """Return the load of the robots that are served first, which is at most half a second
        old.
        """
        now = self._clock()
        if now - self._read > self._reread_s:
            self._read = now
            self._reread_s = min(_READ_S, 2 * self._reread_s)
            self._read_plans()
        return self._load

    def needed(self) -> float:
        """Return the share of the replica that its robots need, in [0, 1]."""
        load = self.load().load
        return 1.0 if self._others else load

    def replan_s(self, plan: RobotPlan) -> float:
        """Return the time from now until the next request of a robot is useful, s; 0 if the robot
        may send it immediately.

        Args:
            plan: The plan of the robot, which has observed the act that is answered now.
        """
        load = self.load()
        need, now = plan.need, self._clock()
        # A request that is sent before the waiting requests are answered would have to wait.
        waiting = self._queue.depth_first()
        waiting_s = waiting / self._throughput_hz
        waited_s = now - plan.asked
        if need is None:
            # If many robots begin at the same time, they are answered one after the other. Their
            # next requests keep these distances.
            return waiting_s if self.robots < 2 else waiting_s + waited_s
        if self.robots < 2:
            return 0.0
        if plan.waits_behind_others:
            # An answer is most useful if all earlier rows have been executed.
            return max(0.0, plan.begins + need.longest_s - 0.5 / need.hz - now)

        # If several robots sent requests at the same time, the robot that is answered first sends
        # its next request first. Their next requests then do not arrive at the same time again.
        ahead_s = max(0, waiting - self._places) / self._throughput_hz
        earlier_s = (ahead_s - max(0.0, waited_s - load.latency_s)) / 2
        backlog_s = now - plan.begins + waiting_s
        longest_s = need.interval_s(load.latency_s)
        interval_s = min(longest_s, max(backlog_s, load.replan_s(need) - earlier_s))
        # A robot sends its request at the next tick, half a period later on average. If the load is
        # low and a tick is a large part of the interval, the time is rounded so that the robot
        # sends the request earlier instead.
        is_early = load.load <= _IDLE_LOAD and interval_s <= _FEW_TICKS / need.hz
        early_s = (1.0 if is_early else 0.5) / need.hz
        return max(0.0, plan.begins + interval_s - early_s - now)

    def _read_plans(self) -> None:
        """Read the needs of the robots that send their slack, and choose which robots are served
        first.
        """
        now = self._clock()
        plans: list[RobotPlan] = []
        for plan, waits in self._plans():
            if plan.sends_slack and plan.is_present(now, waits=waits):
                plans.append(plan)
            else:
                plan.waits_behind_others = False
        plans.sort(key=lambda plan: (plan.need is None, plan.began))
        known = Counter(plan.need for plan in plans if plan.need is not None)
        self.robots, self._others, self._places = len(plans), 0, 0
        self._load, self._queue.room = IDLE, None
        had_others = self._queue.had_others()
        curve = self._queue.curve()
        if curve is None:
            return
        largest = self._queue.largest
        self._throughput_hz = largest / curve.cost_s(largest)
        if not known:
            return

        # Until a robot's needs are known, it counts as the most frequent kind of robot, but does
        # not wait behind others.
        [(usual, _)] = known.most_common(1)
        needs = [plan.need or usual for plan in plans]
        first = self._most_in_time(needs, curve)
        for index, plan in enumerate(plans):
            plan.waits_behind_others = index >= first and plan.need is not None
        self._others = max(0, known.total() - first)
        self._load = self._load_of(needs[:first], curve)
        # Robots with short chunks behind others would be late anyway.
        shortest_s = _SEVERAL_ANSWERS * self._load.latency_s
        if any(need.interval_s(self._load.latency_s) > shortest_s for need in needs[first:]):
            self._places = self._others
        possible = self._that_can_be_in_time(needs[:first], curve, 1.0)
        room = self._queue.room = room_for_others(curve, possible, largest, self._load)
        if had_others:
            self._load = room.load

    def _most_in_time(self, needs: Sequence[RobotNeed], curve: CostCurve) -> int:
        """Return how many of the first robots can be in time together."""
        if self._load_of(needs, curve).in_time:
            return len(needs)
        counts = range(len(needs) + 1)
        loads = bisect.bisect_right(
            counts, USABLE, key=lambda count: self._load_of(needs[:count], curve).load
        )
        return loads - 1  # the first load is the load without robots

    def _load_of(self, needs: Sequence[RobotNeed], curve: CostCurve) -> RobotsLoad:
        """Return the load of robots."""
        counts = self._that_can_be_in_time(needs, curve, USABLE)
        return robots_load(curve, counts, self._queue.largest)

    @staticmethod
    def _that_can_be_in_time(
        needs: Sequence[RobotNeed], curve: CostCurve, usable: float
    ) -> Mapping[RobotNeed, int]:
        """Return the number of robots with each need, if the share `usable` of the replica is
        enough for each of them alone. A robot that cannot be in time even alone does not count,
        since it would make all other robots wait.
        """
        batch_s, soonest_s = curve.cost_s(1), answer_s(curve, 1, len(needs))
        return Counter(need for need in needs if usable * need.interval_s(soonest_s) >= batch_s)
