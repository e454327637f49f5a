"""A fleet in virtual time: robots that execute chunks, replicas with the batch queue of the server,
and what happens to them.

The order of the requests, their batches and the pace of the robots are those of the server's own
code, `FairQueue` and `ReplicaPace`. All else is arithmetic: a batch takes the time of the cost
curve, a message the time of the transport, and a robot follows the rules of the chunk player in
mode "async": one request at a time with the newest observation, sent at a tick, no earlier than the
server allows unless the robot would starve; rows for executed ticks are skipped, and a robot
without a row holds still, with its plan. Ticks are counted, not simulated: nothing but the rows
that are left changes between two answers. The same seed gives the same result.
"""

from __future__ import annotations

import heapq
import math
import random
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from vlagents_ray.protocol.messages import Priority, Request
from vlagents_ray.serve.fleet import CostCurve, RobotNeed
from vlagents_ray.serve.queue.fair_queue import FairQueue
from vlagents_ray.serve.queue.replica_pace import ReplicaPace, RobotPlan
from vlagents_ray.serve.requests import IncomingMessage, PendingRequest
from vlagents_ray.serve.scaling.slo_load import slo_load

_ACT = Request("act")
_MESSAGE = IncomingMessage("simulation")  # message of all requests: nothing is delivered
_DRAWN = 8192  # random delays, which are drawn once, as each message has one
_AGE_BIN_S = 0.001
_AGE_BINS = 120_000
_FLUSH = 200_000  # runs of ticks that are kept until they are added up
# As in `vlagents_ray.serve.scaling.rebalancer`: interval of its comparisons, s, and the tolerated
# excess of a load over the mean one.
_COMPARE_S = 3.0
_TOLERATED = 1.25
# Digits to which loads are rounded, and the tolerance with which they are compared.
_DIGITS, _EXACT = 9, 1e-6
# As in `vlagents_ray.serve.scaling.sibling_replicas`: replicas that one asks for their sessions.
_MOST_ASKED = 32


@dataclass(frozen=True)
class Behaviour:
    """What messages, batches and lost replicas take.

    Args:
        jitter: Standard deviation of the duration of a batch, as a share of it.
        transport_jitter_s: Mean of the time by which a message is late, s.
        slack: Whether robots state their slack, and the queue uses it.
        replan: Whether the server states when the next request of a robot is useful.
        weighs_robots: Whether sessions are placed and moved by the needs of their robots, else by
            their number.
        act_cpu_s: CPU time of a request in the process of a replica, which reads one at a time, s.
        broken_s: Time until a robot whose connection ends has sent its request to another replica.
        silent_s: The same for a replica whose machine is lost, so that nothing ends the connection.
        move_s: Time by which the first request at another replica comes later, as its session
            moves.
    """

    jitter: float = 0.03
    transport_jitter_s: float = 0.001
    slack: bool = True
    replan: bool = True
    weighs_robots: bool = True
    act_cpu_s: float = 0.0
    broken_s: float = 0.1
    silent_s: float = 3.0
    move_s: float = 0.02


USUAL = Behaviour()


class Tally:
    """Ticks in time and starved ones, by second, and the ages of the executed actions."""

    def __init__(self) -> None:
        self.in_time = 0
        self.starved = 0
        self._runs = array("d")  # runs of each run: its first tick, s, ticks, period, age or -1
        self._ages = np.zeros(_AGE_BINS, np.int64)
        self._seconds: dict[bool, np.ndarray] = {
            True: np.zeros(64, np.int64),
            False: np.zeros(64, np.int64),
        }

    def add(self, first_s: float, ticks: int, period_s: float, age_s: float) -> None:
        """Add ticks in a row.

        Args:
            first_s: The time of the first one, s.
            ticks: Their number.
            period_s: The time between two of them, s.
            age_s: The age of the action at the first one, s; -1 if they had none.
        """
        if age_s < 0:
            self.starved += ticks
        else:
            self.in_time += ticks
        self._runs.extend((first_s, ticks, period_s, age_s))
        if len(self._runs) >= 4 * _FLUSH:
            self._flush()

    @property
    def share(self) -> float:
        """The share of ticks that had an action in time; 1 without ticks."""
        ticks = self.in_time + self.starved
        return self.in_time / ticks if ticks else 1.0

    def age_s(self, quantile: float) -> float:
        """Return a quantile of the ages of executed actions, s; 0 without any."""
        self._flush()
        total = np.cumsum(self._ages)
        if not total[-1]:
            return 0.0
        return float(np.searchsorted(total, quantile * total[-1])) * _AGE_BIN_S

    def by_second(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the ticks in time, and the starved ones, of each second."""
        self._flush()
        return self._seconds[True], self._seconds[False]

    def _flush(self) -> None:
        runs = np.frombuffer(self._runs, float).reshape(-1, 4).copy()
        self._runs = array("d")
        if not len(runs):
            return
        ticks = runs[:, 1].astype(np.int64)
        of_run = np.repeat(np.arange(len(runs)), ticks)
        number = np.arange(len(of_run)) - np.repeat(np.cumsum(ticks) - ticks, ticks)
        since = number * runs[of_run, 2]
        seconds = (runs[of_run, 0] + since).astype(np.int64)
        executed = runs[of_run, 3] >= 0

        for is_in_time in (True, False):
            counts = np.bincount(seconds[executed == is_in_time])
            total = self._seconds[is_in_time]
            size = max(len(total), len(counts), len(self._seconds[not is_in_time]))
            self._seconds[is_in_time] = _longer(total, size) + _longer(counts, size)
            self._seconds[not is_in_time] = _longer(self._seconds[not is_in_time], size)

        bins = ((runs[of_run, 3] + since)[executed] / _AGE_BIN_S).astype(np.int64)
        self._ages += np.bincount(np.minimum(bins, _AGE_BINS - 1), minlength=_AGE_BINS)


def _longer(counts: np.ndarray, size: int) -> np.ndarray:
    return np.pad(counts, (0, size - len(counts)))


class _StreamRequest(PendingRequest):
    """The request of a stream: the same object each time, as a stream has one at a time."""

    __slots__ = ("stream",)

    stream: Stream


class Stream:
    """The use of one model by one robot: a plan of rows, and at most one request."""

    __slots__ = (
        "_asked",
        "_asked_at_s",
        "_asked_row",
        "_begun",
        "_captured_s",
        "_delay_s",
        "_executed",
        "_left",
        "_period_s",
        "_phase_s",
        "_tick",
        "asks",
        "late",
        "need",
        "plan",
        "replica",
        "request",
        "session_id",
        "slack_s",
        "starved",
        "tally",
        "ticks",
        "transport_s",
        "weight",
        "world",
    )

    def __init__(
        self,
        world: World,
        session_id: str,
        need: RobotNeed,
        transport_s: float,
        start_s: float,
        tally: Tally,
    ) -> None:
        self.world = world
        self.session_id = session_id
        self.need = need
        self.plan = RobotPlan(need, is_stated=True)
        self.request = _StreamRequest(session_id, _ACT, _MESSAGE, Priority.ROBOT, arrived=start_s)
        self.request.stream = self
        self.transport_s = transport_s
        self.tally = tally
        self.replica: Replica | None = None
        self.weight = 1.0  # at its replica
        self.ticks = 0
        self.starved = 0
        self.late: list[tuple[float, int]] = []  # first times, s, and numbers of starved ticks
        self.asks = 0  # numbers its requests, so that an answer to an abandoned one is known
        self.slack_s = 0.0  # the slack that the last request states
        self._period_s = 1 / need.hz
        self._phase_s = start_s
        self._tick = 0  # the next tick that is not counted yet
        self._executed = 0  # rows
        self._left = 0  # rows of the plan
        self._captured_s = 0.0  # capture time of the observation of the plan
        self._asked = 0  # the tick of the last request
        self._asked_row = 0  # rows that were executed before it
        self._asked_at_s = 0.0
        self._delay_s = 0.0  # by which its next message is late, s
        self._begun = False  # whether the first answer is there

    def begin(self) -> None:
        """Send the first request."""
        self._ask(0)

    def answered(self, arrives_s: float, replan_s: float, inference_s: float) -> None:
        """Take the answer to the last request, and plan the next one.

        Args:
            arrives_s: The time at which the answer arrives, s.
            replan_s: The time from then on at which the next request is useful, s; 0: at once.
            inference_s: The duration of its batch, s.
        """
        period_s = self._period_s
        tick = max(math.ceil((arrives_s - self._phase_s) / period_s), self._asked + 1)
        if not self._begun:
            # `reset` waits for the first answer, and the episode begins with it.
            self._begun = True
            self._tick = tick
        self._count_until(tick)

        rows = self._asked_row + self.need.rows - self._executed
        if rows == 0 and self._left == 0:
            rows = 1  # the last row may be executed one step late
        if rows > 0:
            self._left = rows
            self._captured_s = self._asked_at_s

        due = tick
        if replan_s > 0:
            allowed = math.ceil((arrives_s + replan_s - self._phase_s) / period_s)
            if allowed > tick:
                # It waits no longer than an urgent request can be answered in time.
                kept_rows = 2 + (inference_s + self.transport_s) / period_s
                due = max(tick, min(allowed, tick + math.ceil(self._left - kept_rows)))
        self._ask(due)

    def resend(self) -> None:
        """Send the last request to another replica."""
        self._send(self.world.now)

    def delay_next(self, delay_s: float) -> None:
        """Let the next message arrive later by this time, s."""
        self._delay_s = delay_s

    def finish(self) -> None:
        """Count the ticks until now."""
        if self._begun:
            tick = math.ceil((self.world.now - self._phase_s) / self._period_s)
            if tick > self._tick:
                self._count_until(tick)

    def in_time_from_s(self, share: float) -> float:
        """Return the time from which on at least that share of its ticks were in time, s; 0.0 if
        that is so from its first tick on.
        """
        late = 0
        for first_s, ticks in reversed(self.late):
            late += ticks
            if late > (1 - share) * (self.world.now - first_s) / self._period_s:
                return first_s + ticks * self._period_s
        return 0.0

    def _ask(self, tick: int) -> None:
        """Send a request with the observation of this tick, before its row is executed."""
        if self._begun and tick > self._tick:
            self._count_until(tick)
        self._asked = tick
        self._asked_row = self._executed
        self._asked_at_s = self._phase_s + tick * self._period_s
        self.slack_s = max(0.0, self._left * self._period_s - self.transport_s)
        self._send(self._asked_at_s)

    def _send(self, sent_s: float) -> None:
        world = self.world
        self.asks += 1
        way_s = self.transport_s / 2 + world.late_s() + self._delay_s
        self._delay_s = 0.0
        world.at(sent_s + way_s, world.arrive, self, self.asks)

    def _count_until(self, tick: int) -> None:
        """Execute the rows of the ticks before this one."""
        ticks = tick - self._tick
        if ticks <= 0:
            return
        left = self._left
        executed = min(ticks, left)
        first_s = self._phase_s + self._tick * self._period_s
        if executed:
            self.tally.add(first_s, executed, self._period_s, first_s - self._captured_s)
            self._executed += executed
            self._left = left - executed
        if executed < ticks:
            starved = ticks - executed
            first_s += executed * self._period_s
            self.tally.add(first_s, starved, self._period_s, -1.0)
            self.late.append((first_s, starved))
            self.starved += starved
        self._tick = tick
        self.ticks += ticks


class Replica:
    """A policy with its queue and the pace of its robots."""

    def __init__(
        self, world: World, model: str, costs: CostCurve, max_batch_size: int, node: int = 0
    ) -> None:
        self.world = world
        self.model = model
        self.node = node
        self.alive = True
        self.accepts = True  # whether new sessions may begin here
        self.streams: dict[Stream, None] = {}  # its sessions, the oldest first
        self.load = 0.0  # the sum of the weights of its sessions
        self.surplus = 0.0  # load that is asked to reconnect
        self.batches = 0
        self.requests = 0
        self.busy_s = 0.0
        self.queue = FairQueue()
        sizes = range(1, max_batch_size + 1)
        self.queue.costs_s = [0.0, *(costs.cost_s(size) for size in sizes)]
        self._detected_s = 0.0  # once it is lost: time until a robot notices it, s
        self._costs = costs
        self._largest = max_batch_size
        self._busy = False
        self._running: list[PendingRequest] = []
        self._taken_s = 0.0  # duration of the running batch
        self._read_s = 0.0  # time at which all requests that have arrived are read
        self._weights: dict[RobotNeed, float] = {}
        self._pace = ReplicaPace(self._curve, self._plans, max_batch_size, world.clock, self._depth)

    @property
    def sessions(self) -> int:
        """The number of its sessions."""
        return len(self.streams)

    def join(self, stream: Stream) -> None:
        """Begin a session."""
        stream.replica = self
        stream.plan.is_admitted = None
        stream.weight = self._weight_of(stream.need)
        self.load += stream.weight
        self.streams[stream] = None

    def leave(self, stream: Stream) -> None:
        """End a session."""
        stream.replica = None
        self.load -= stream.weight
        del self.streams[stream]

    def _weight_of(self, need: RobotNeed) -> float:
        """Return the load of one robot."""
        if not self.world.behaviour.weighs_robots:
            return 1.0
        if need not in self._weights:
            self._weights[need] = slo_load(self._costs, {need: 1}, self._largest)
        return self._weights[need]

    def needed_load(self) -> float:
        """Return what its robots need, as a share of a replica."""
        needs = Counter(stream.need for stream in self.streams)
        return slo_load(self._costs, needs, self._largest)

    def _curve(self) -> CostCurve:
        return self._costs

    def _plans(self) -> list[RobotPlan]:
        return [stream.plan for stream in self.streams]

    def _depth(self) -> int:
        return self.queue.depth[Priority.ROBOT]

    def receive(self, stream: Stream, number: int) -> None:
        """Read a request, after those that have arrived before it."""
        world = self.world
        cpu_s = world.behaviour.act_cpu_s
        if cpu_s > 0:
            self._read_s = max(self._read_s, world.now) + cpu_s
            world.at(self._read_s, self._queue, stream, number)
        else:
            self._queue(stream, number)

    def _queue(self, stream: Stream, number: int) -> None:
        if stream.asks != number:
            return
        if not self.alive:
            self.miss(stream, number)
            return
        now = self.world.now
        request = stream.request
        request.arrived = now
        request.begun = False
        if self.world.behaviour.slack:
            request.needed = now + stream.slack_s
            stream.plan.heard = now
            request.waits_behind_others = stream.plan.is_admitted is False
        self.queue.add(request)
        if not self._busy:
            self._take()

    def fail(self, detected_s: float) -> list[Stream]:
        """Lose the replica.

        Args:
            detected_s: Time until the robots whose requests are here notice it, s.

        Returns:
            Those robots.
        """
        self.alive = self.accepts = False
        self._detected_s = detected_s
        waiting = [_stream_of(request) for request in (*self._running, *self.queue.clear())]
        for stream in waiting:
            self.miss(stream, stream.asks)
        self._running = []
        return waiting

    def miss(self, stream: Stream, number: int) -> None:
        """Leave a request unanswered, which its robot notices after a time."""
        self.world.at(self.world.now + self._detected_s, self.world.resend, stream, number)

    def _take(self) -> None:
        world = self.world
        batch, _ = self.queue.take(self._largest, world.now, self._pace.most_with_others)
        if not batch:
            return
        self._busy = True
        self._running = batch
        self._taken_s = self.queue.costs_s[len(batch)] * world.factor()
        self.batches += 1
        self.requests += len(batch)
        self.busy_s += self._taken_s
        world.at(world.now + self._taken_s, self._end, None, 0)

    def _end(self, _: None, __: int) -> None:
        if not self.alive:
            return
        world = self.world
        now = world.now
        is_paced = world.behaviour.replan and world.behaviour.slack
        batch, self._running = self._running, []
        for request in batch:
            stream = _stream_of(request)
            replan_s = 0.0
            if is_paced:
                stream.plan.observe(stream.need.rows, request.arrived, request.needed, now)
                replan_s = self._pace.replan_s(stream.plan)
            if not self.accepts or stream.weight <= self.surplus + _EXACT:
                self.surplus -= stream.weight
                world.move(stream)
            arrives_s = now + stream.transport_s / 2 + world.late_s()
            stream.answered(arrives_s, replan_s, self._taken_s)
        self._busy = False
        if self.queue.size:
            self._take()


def _stream_of(request: PendingRequest) -> Stream:
    return cast(_StreamRequest, request).stream


Event = tuple[float, int, Callable[..., None], Any, int]


class World:
    """Robots, replicas and the time."""

    def __init__(
        self,
        seed: int = 0,
        behaviour: Behaviour = USUAL,
        transport_s: float = 0.005,
        least_loaded: bool = True,
    ) -> None:
        """Begin at time 0.

        Args:
            seed: Of all random numbers.
            behaviour: What messages and faults take.
            transport_s: The time of a request and its answer on the way, for the arithmetic of the
                server.
            least_loaded: Whether a session begins at the replica with the least load of those that
                one replica asks; else at one by the hash of its id, as those of clients that know
                HTTP alone.
        """
        self.now = 0.0
        self.behaviour = behaviour
        self.transport_s = transport_s
        self.least_loaded = least_loaded
        self.replicas: dict[str, list[Replica]] = {}
        self.streams: list[Stream] = []
        self.events = 0
        self.moves = 0
        self._draw = random.Random(seed)
        self._delays_s = [
            self._draw.expovariate(1.0) * behaviour.transport_jitter_s for _ in range(_DRAWN)
        ]
        self._messages = 0
        self._due: list[Event] = []
        self._count = 0

    def clock(self) -> float:
        """Return the time, s."""
        return self.now

    def late_s(self) -> float:
        """Return the time by which the next message is late, s."""
        self._messages += 1
        return self._delays_s[self._messages % _DRAWN]

    def factor(self) -> float:
        """Draw the duration of a batch, as a multiple of its cost."""
        return max(0.5, self._draw.gauss(1.0, self.behaviour.jitter))

    def at(self, when: float, call: Callable[..., None], subject: Any, number: int) -> None:
        """Call `call(subject, number)` at that time."""
        self._count += 1
        heapq.heappush(self._due, (when, self._count, call, subject, number))

    def run(self, until: float) -> None:
        """Let the time pass until then, s."""
        due = self._due
        while due and due[0][0] <= until:
            self.now, _, call, subject, number = heapq.heappop(due)
            self.events += 1
            call(subject, number)
        self.now = until

    def add_replica(
        self, model: str, costs: CostCurve, max_batch_size: int, node: int = 0
    ) -> Replica:
        """Start a replica."""
        replica = Replica(self, model, costs, max_batch_size, node)
        self.replicas.setdefault(model, []).append(replica)
        return replica

    def add_stream(
        self, model: str, need: RobotNeed, transport_s: float, start_s: float, tally: Tally
    ) -> Stream:
        """Add the use of a model by a robot, whose episode begins at `start_s`."""
        stream = Stream(self, f"{model}/{len(self.streams)}", need, transport_s, start_s, tally)
        self.streams.append(stream)
        self.at(start_s, self._begin, (stream, model), 0)
        return stream

    def _begin(self, subject: tuple[Stream, str], _: int) -> None:
        stream, model = subject
        replica = self.choose(model)
        if replica is None:  # it asks again
            self.at(self.now + 1.0, self._begin, subject, 0)
            return
        replica.join(stream)
        stream.begin()

    def choose(self, model: str) -> Replica | None:
        """Choose the replica of a new session; None if there is none."""
        accepting = [replica for replica in self.replicas[model] if replica.accepts]
        if not accepting:
            return None
        if self.least_loaded:
            if len(accepting) > _MOST_ASKED + 1:
                accepting = self._draw.sample(accepting, _MOST_ASKED + 1)
            return min(accepting, key=_load_of)
        return self._draw.choice(accepting)

    def arrive(self, stream: Stream, number: int) -> None:
        """Take a request of a robot, at its replica."""
        if stream.asks != number:
            return
        replica = stream.replica
        if replica is None:
            self.resend(stream, number)
        elif replica.alive:
            replica.receive(stream, number)
        else:
            replica.miss(stream, number)

    def resend(self, stream: Stream, number: int) -> None:
        """Send a request whose replica was lost to another one."""
        if stream.asks != number:
            return
        if not self.move(stream):
            self.at(self.now + 1.0, self.resend, stream, number)
            return
        stream.resend()

    def move(self, stream: Stream) -> bool:
        """Move a session to another replica; return False if there is none."""
        old = stream.replica
        model = stream.session_id.rpartition("/")[0]
        replica = self.choose(model)
        if replica is None:
            return False
        if old is not None:
            old.leave(stream)
        replica.join(stream)
        stream.delay_next(self.behaviour.move_s)
        self.moves += 1
        return True

    def compare(self, model: str, _: int = 0) -> None:
        """Ask the robots of replicas with a clearly too large load to reconnect, and again after
        each interval.
        """
        accepting = [replica for replica in self.replicas[model] if replica.accepts]
        mean = sum(replica.load for replica in accepting) / max(1, len(accepting))
        for replica in accepting:
            mean_robot = replica.load / max(1, replica.sessions)
            excess = round(replica.load - mean, _DIGITS)
            is_uneven = excess > round(max(mean_robot, (_TOLERATED - 1) * mean), _DIGITS)
            replica.surplus = excess if is_uneven else 0.0
        self.at(self.now + _COMPARE_S, self.compare, model, 0)

    def finish(self) -> None:
        """Count the ticks of all robots until now."""
        for stream in self.streams:
            stream.finish()


def _load_of(replica: Replica) -> float:
    return round(replica.load, _DIGITS)


def starved_streams(streams: Iterable[Stream], share: float) -> Sequence[Stream]:
    """Return those with a smaller share of ticks in time."""
    return [
        stream for stream in streams if stream.ticks and 1 - stream.starved / stream.ticks < share
    ]
