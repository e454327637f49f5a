"""A fleet in virtual time: robots that execute chunks, replicas with the batch queue of the server,
and their faults.

The order of the requests, their batches and the pace of the robots are those of the server's own
code, `FairQueue` and `ReplicaPace`. Everything else is arithmetic. A batch takes the time of the
cost curve, and a message the time of the transport. A robot follows the rules of the chunk player
in mode "async": it sends one request at a time with the newest observation, at a tick, and no
earlier than the server allows unless it would starve. Rows for ticks that have passed are skipped,
and a robot without a row holds still. Ticks are counted, not simulated, since only the number of
remaining rows changes between two answers. The same seed gives the same result.
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
# The message of all requests, since no answer is delivered.
_MESSAGE = IncomingMessage("simulation")
_DRAWN = 8192  # number of random delays, which are drawn once because each message needs one
_AGE_BIN_S = 0.001
_AGE_BINS = 120_000
_FLUSH = 200_000  # maximum number of runs of ticks that are kept before they are added up
# Interval of comparisons, s, and tolerated excess of a load over the mean load, as in
# `vlagents_ray.serve.scaling.rebalancer`.
_COMPARE_S = 3.0
_TOLERATED = 1.25
# The number of digits to which loads are rounded, and the tolerance with which they are compared.
_DIGITS, _EXACT = 9, 1e-6
# Maximum number of replicas that a replica asks for their sessions, as in
# `vlagents_ray.serve.scaling.sibling_replicas`.
_MOST_ASKED = 32


@dataclass(frozen=True)
class Behaviour:
    """The durations of messages, batches and lost replicas, and the abilities of the server.

    Args:
        jitter: Standard deviation of the duration of a batch, as a share of it.
        transport_jitter_s: Mean of the time by which a message is late, s.
        slack: Whether robots report their slack, and the queue uses it.
        replan: Whether the server tells robots when their next request is useful.
        weighs_robots: Whether sessions are placed and moved according to the needs of their robots;
            otherwise only their number counts.
        act_cpu_s: CPU time of a request in the process of a replica, which reads one request at a
            time, s.
        broken_s: Time until a robot whose connection ends has sent its request to another replica.
        silent_s: The same time, s, for a replica whose machine is lost, so that the connection does
            not end.
        move_s: Additional delay of the first request at another replica, since its session moves,
            s.
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
    """Counts of ticks in time and of starved ticks, by second, and of the ages of the executed
    actions.
    """

    def __init__(self) -> None:
        self.in_time = 0
        self.starved = 0
        # Runs of ticks: time of the first tick, s; number of ticks; period, s; age of its action,
        # s, or -1.
        self._runs = array("d")
        self._ages = np.zeros(_AGE_BINS, np.int64)
        self._seconds: dict[bool, np.ndarray] = {
            True: np.zeros(64, np.int64),
            False: np.zeros(64, np.int64),
        }

    def add(self, first_s: float, ticks: int, period_s: float, age_s: float) -> None:
        """Add a run of ticks.

        Args:
            first_s: The time of the first tick, s.
            ticks: The number of ticks.
            period_s: The time between two ticks, s.
            age_s: The age of the action at the first tick, s; -1 if the ticks had no action.
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
        """Return the number of ticks in time, and of starved ticks, in each second."""
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
    """The request of a stream. The same object is used each time, as a stream has only one request
    at a time.
    """

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
        self.weight = 1.0  # the stream's load on its replica
        self.ticks = 0
        self.starved = 0
        # Times of the first tick, s, and lengths of runs of starved ticks.
        self.late: list[tuple[float, int]] = []
        # Number of the last request, with which the answer to an abandoned request is recognised.
        self.asks = 0
        self.slack_s = 0.0  # the slack that the last request reports
        self._period_s = 1 / need.hz
        self._phase_s = start_s
        self._tick = 0  # the next tick that has not been counted
        self._executed = 0  # number of executed rows
        self._left = 0  # number of remaining rows of the plan
        self._captured_s = 0.0  # capture time of the plan's observation, s
        self._asked = 0  # the tick of the last request
        self._asked_row = 0  # number of rows that were executed before the last request
        self._asked_at_s = 0.0
        self._delay_s = 0.0  # additional delay of the next message, s
        self._begun = False  # whether the first answer has arrived

    def begin(self) -> None:
        """Send the first request."""
        self._ask(0)

    def answered(self, arrives_s: float, replan_s: float, inference_s: float) -> None:
        """Process the answer to the last request, and plan the next request.

        Args:
            arrives_s: The time at which the answer arrives, s.
            replan_s: The time after the arrival at which the next request is useful, s; 0 for
                immediately.
            inference_s: The duration of the answer's batch, s.
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
                # The robot waits no longer than an urgent request could still be answered in time.
                kept_rows = 2 + (inference_s + self.transport_s) / period_s
                due = max(tick, min(allowed, tick + math.ceil(self._left - kept_rows)))
        self._ask(due)

    def resend(self) -> None:
        """Send the last request to another replica."""
        self._send(self.world.now)

    def delay_next(self, delay_s: float) -> None:
        """Delay the next message by this time, s."""
        self._delay_s = delay_s

    def finish(self) -> None:
        """Count the ticks until the current time."""
        if self._begun:
            tick = math.ceil((self.world.now - self._phase_s) / self._period_s)
            if tick > self._tick:
                self._count_until(tick)

    def in_time_from_s(self, share: float) -> float:
        """Return the time since which at least this share of the stream's ticks were in time, s;
        0.0 if it was so since the first tick.
        """
        late = 0
        for first_s, ticks in reversed(self.late):
            late += ticks
            if late > (1 - share) * (self.world.now - first_s) / self._period_s:
                return first_s + ticks * self._period_s
        return 0.0

    def _ask(self, tick: int) -> None:
        """Send a request with the observation of this tick, before the row of the tick is
        executed.
        """
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
        self.accepts = True  # whether the replica accepts new sessions
        self.streams: dict[Stream, None] = {}  # the replica's sessions, the oldest first
        self.load = 0.0  # the sum of the weights of the sessions
        self.surplus = 0.0  # load of the sessions that are requested to reconnect
        self.batches = 0
        self.requests = 0
        self.busy_s = 0.0
        self.queue = FairQueue()
        sizes = range(1, max_batch_size + 1)
        self.queue.costs_s = [0.0, *(costs.cost_s(size) for size in sizes)]
        self._detected_s = 0.0  # time until a robot notices the loss of the replica, s
        self._costs = costs
        self._largest = max_batch_size
        self._busy = False
        self._running: list[PendingRequest] = []
        self._taken_s = 0.0  # duration of the running batch, s
        self._read_s = 0.0  # time at which all requests that have arrived will have been read, s
        self._weights: dict[RobotNeed, float] = {}
        self._pace = ReplicaPace(self._curve, self._plans, max_batch_size, world.clock, self._depth)

    @property
    def sessions(self) -> int:
        """The number of the replica's sessions."""
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
        """Return the load that the robots need, as a share of a replica."""
        needs = Counter(stream.need for stream in self.streams)
        return slo_load(self._costs, needs, self._largest)

    def _curve(self) -> CostCurve:
        return self._costs

    def _plans(self) -> list[RobotPlan]:
        return [stream.plan for stream in self.streams]

    def _depth(self) -> int:
        return self.queue.depth[Priority.ROBOT]

    def receive(self, stream: Stream, number: int) -> None:
        """Read a request, after all requests that have arrived earlier."""
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
            detected_s: Time until the robots with requests at the replica notice the loss, s.

        Returns:
            The streams of these robots.
        """
        self.alive = self.accepts = False
        self._detected_s = detected_s
        waiting = [_stream_of(request) for request in (*self._running, *self.queue.clear())]
        for stream in waiting:
            self.miss(stream, stream.asks)
        self._running = []
        return waiting

    def miss(self, stream: Stream, number: int) -> None:
        """Leave a request unanswered; its robot notices this after some time."""
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
    """The simulated robots and replicas, and the current time."""

    def __init__(
        self,
        seed: int = 0,
        behaviour: Behaviour = USUAL,
        transport_s: float = 0.005,
        least_loaded: bool = True,
    ) -> None:
        """Begin at time 0.

        Args:
            seed: The seed of all random numbers.
            behaviour: The durations of messages and faults.
            transport_s: The transport time of a request and its answer, for the arithmetic of the
                server, s.
            least_loaded: Whether a session begins at the replica with the least load among those
                that one replica asks. Otherwise the replica is random, as it is for clients that
                only use HTTP, whose replica depends on the hash of the session's id.
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
        """Schedule `call(subject, number)` for this time."""
        self._count += 1
        heapq.heappush(self._due, (when, self._count, call, subject, number))

    def run(self, until: float) -> None:
        """Advance the time to `until`, s."""
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
        if replica is None:  # the robot asks again later
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
        """Process the arrival of a robot's request at its replica."""
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
        """Move the session of a request whose replica was lost, and send the request again."""
        if stream.asks != number:
            return
        if not self.move(stream):
            self.at(self.now + 1.0, self.resend, stream, number)
            return
        stream.resend()

    def move(self, stream: Stream) -> bool:
        """Move a session to another replica; return False if no replica accepts it."""
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
        """Request the robots of replicas with a clearly excessive load to reconnect; repeat this
        after each interval.
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
        """Count the ticks of all robots until the current time."""
        for stream in self.streams:
            stream.finish()


def _load_of(replica: Replica) -> float:
    return round(replica.load, _DIGITS)


def starved_streams(streams: Iterable[Stream], share: float) -> Sequence[Stream]:
    """Return the streams with a smaller share of ticks in time."""
    return [
        stream for stream in streams if stream.ticks and 1 - stream.starved / stream.ticks < share
    ]
