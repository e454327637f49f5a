"""The order in which waiting requests enter batches. The module uses no threads, and no clock
except the requests' arrival times.

Robots are served before simulations. Among requests of the same class the *sources* take turns
(round-robin): a connection that sends 512 observations at once gets one slot, then the next source
gets one, and so on until the batch is full. A client with many requests therefore delays the other
clients of its class by at most one batch, and a single client can fill the batch. A session (one
robot, one env) has at most one request in a batch, and its requests keep their order.

A robot that executes an action chunk can send its slack: the time until its rows run out
(`PendingRequest.needed`). A robot with a long slack waits behind *urgent* robots, which need their
answers within the duration of two full batches. Urgent robots take turns. The other robots follow
in the order in which they need their answers, and become urgent as that time approaches. A client
therefore gains nothing if it sends less slack than it has. No request that can wait is added to a
batch if its row alone would make the most urgent answer late.

The other requests get what these robots leave. First come *displaced* robots: if the robots need
more than the replica can compute, the robots of the newest episodes wait behind all other robots
with slack (`PendingRequest.waits_behind_others`). Then come robots that send no slack, then
simulations. No request of a later class enters a batch from which a request of an earlier class is
left out. While the needs of robots are known, `FairQueue.room` limits the batches with requests of
later classes: the next request of a robot may arrive as soon as such a batch has begun, and then
waits for its end. If a batch of a single such request would make a robot late, these requests are
held until the robots leave, except for a few that are added to batches of robots
(`Room.held_s`).

There are two further exceptions, so that no class waits forever. The request of a robot becomes
urgent after `BEHIND_OTHERS_S`. Robots without slack may use the whole throughput that other robots
leave: once the next simulation has waited for longer than `PATIENCE_S`, it gets a slot before them
in every second batch.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import deque
from collections.abc import Sequence

from vlagents_ray.protocol.messages import Priority
from vlagents_ray.serve.queue.robots_load import Room
from vlagents_ray.serve.requests import PendingRequest

# Time after which a simulation gets a slot although requests of robots without slack keep arriving,
# s.
PATIENCE_S = 1.0
# Maximum time for which the request of a robot waits behind the requests of other robots, s.
BEHIND_OTHERS_S = 60.0
# Requests of one session, in order; never empty while the session waits.
_SessionQueue = deque[PendingRequest]


class _SourceQueue:
    """The sources of one class of requests in round-robin order, each with its waiting sessions."""

    __slots__ = ("_length", "queues", "sources")

    def __init__(self) -> None:
        self.sources: deque[str] = deque()
        self.queues: dict[str, deque[_SessionQueue]] = {}
        self._length = 0  # number of sessions

    def __len__(self) -> int:
        return self._length

    def add(self, queue: _SessionQueue) -> None:
        """Add the queue of a session that did not wait before, behind all other sessions of its
        source.
        """
        source = queue[0].origin.connection or queue[0].session_id
        self._length += 1
        queues = self.queues.get(source)
        if queues is None:
            self.queues[source] = deque((queue,))
            self.sources.append(source)
        else:
            queues.append(queue)

    def next(self) -> _SessionQueue:
        """Return the next session of the next source, and move that source to the end of the
        order.
        """
        self._length -= 1
        source = self.sources.popleft()
        queues = self.queues[source]
        queue = queues.popleft()

        if queues:
            self.sources.append(source)
        else:
            del self.queues[source]
        return queue

    def is_impatient(self, now: float, patience_s: float) -> bool:
        """Return whether the next request has waited for longer than `patience_s`."""
        if not self.sources:
            return False
        next_queue = self.queues[self.sources[0]][0]
        return now - next_queue[0].arrived > patience_s


class _PatientQueue:
    """The sessions of robots that can wait, by the time at which they need their answers."""

    __slots__ = ("_heap", "_numbers")

    def __init__(self) -> None:
        # The number keeps the order of arrival if two sessions need their answers at the same time.
        self._heap: list[tuple[float, int, _SessionQueue]] = []
        self._numbers = itertools.count()

    def __len__(self) -> int:
        return len(self._heap)

    def add(self, queue: _SessionQueue) -> None:
        """Add the queue of a session that did not wait before."""
        heapq.heappush(self._heap, (queue[0].needed, next(self._numbers), queue))

    def next(self) -> _SessionQueue:
        """Remove and return the session whose answer is needed first."""
        return heapq.heappop(self._heap)[2]

    def first_needed(self) -> float:
        """Return the time at which the first answer is needed, s; `inf` if no session waits."""
        return self._heap[0][0] if self._heap else math.inf


def _has_slack(pending: PendingRequest) -> bool:
    """Return whether a robot has sent its slack. The requests other than acts never contain it, and
    are urgent.
    """
    return pending.needed > 0.0 or pending.request.op != "act"


def _is_served_first(pending: PendingRequest) -> bool:
    """Return whether a request waits behind no other class of requests."""
    is_robot = pending.priority is Priority.ROBOT
    return is_robot and not pending.waits_behind_others and _has_slack(pending)


class FairQueue:
    """The waiting requests. Adding or removing a request takes constant time regardless of the
    number of requests, or logarithmic time for requests with slack. Not thread-safe.
    """

    costs_s: Sequence[float] = ()
    """The duration of a batch by its number of requests, s, from 0 to the largest number. It is
    empty if the durations are unknown; all robots with slack are then urgent.
    """
    room: Room | None = None
    """The largest batches with requests of the later classes with which the robots whose needs are
    known are in time; None if no robot has known needs.
    """

    def __init__(self) -> None:
        # The classes of requests, in the order in which they enter a batch.
        self._urgent = _SourceQueue()
        self._patient = _PatientQueue()
        self._displaced = _SourceQueue()
        self._without_slack = _SourceQueue()
        self._simulations = _SourceQueue()
        self._sessions: dict[str, _SessionQueue] = {}
        # The waiting request if there is only one; it is not in a session's queue.
        self._lone: PendingRequest | None = None
        self._yielded = False  # whether the last batch had a slot for an impatient simulation
        # Number of waiting requests by priority, including requests that are over.
        self.depth = [0] * len(Priority)
        self.size = 0  # number of waiting requests of all priorities
        # Whether a batch had robots without slack or simulations since `had_others`.
        self._had_others = False
        self._held_until = -math.inf  # time at which a held request is added to a batch, s

    def __contains__(self, session_id: str) -> bool:
        self._enqueue_lone()
        return session_id in self._sessions

    @property
    def sessions(self) -> int:
        """Number of sessions with waiting requests."""
        return len(self._sessions) + (self._lone is not None)

    @property
    def first(self) -> int:
        """Number of sessions of robots that wait behind no other class of requests."""
        self._enqueue_lone()
        return len(self._urgent) + len(self._patient)

    def had_others(self) -> bool:
        """Return whether there were requests of robots without slack or of simulations since the
        last call.
        """
        self._enqueue_lone()
        had_others = self._had_others or bool(self._without_slack or self._simulations)
        self._had_others = False
        return had_others

    def is_held(self, now: float) -> bool:
        """Return whether all waiting requests are held, since a batch of a single one would make a
        robot late.
        """
        if self.room is None or self.room.alone > 0:
            return False
        is_other = self.first == 0 and not self._displaced
        return is_other and not self._without_slack.is_impatient(now, BEHIND_OTHERS_S)

    def heads(self) -> list[PendingRequest]:
        """Return the next request of each session."""
        self._enqueue_lone()
        return [queue[0] for queue in self._sessions.values()]

    def add(self, pending: PendingRequest) -> None:
        """Add a request behind the other requests of its session."""
        self.depth[pending.priority] += 1
        self.size += 1
        if self.size == 1:
            self._lone = pending
            return
        self._enqueue_lone()
        self._append(pending)

    def _enqueue_lone(self) -> None:
        """Move the lone request to the queue of its session."""
        if self._lone is not None:
            lone, self._lone = self._lone, None
            self._append(lone)

    def _append(self, pending: PendingRequest) -> None:
        queue = self._sessions.get(pending.session_id)
        if queue is not None:
            queue.append(pending)
            return
        queue = self._sessions[pending.session_id] = deque((pending,))
        self._enqueue(queue, pending.arrived)

    def _enqueue(self, queue: _SessionQueue, now: float) -> None:
        """Add the queue of a session that did not wait before."""
        head = queue[0]
        if head.priority is Priority.SIMULATION:
            self._simulations.add(queue)
        elif not _has_slack(head):
            self._without_slack.add(queue)
        elif head.waits_behind_others:
            self._displaced.add(queue)
        elif head.needed > now + self._urgent_s():
            self._patient.add(queue)
        else:
            self._urgent.add(queue)

    def _urgent_s(self) -> float:
        """Return the slack up to which a robot is urgent, s: the duration of two full batches, the
        batch that may be running and the next one.
        """
        return 2 * self.costs_s[-1] if self.costs_s else math.inf

    def take(self, size: int, now: float) -> tuple[list[PendingRequest], list[PendingRequest]]:
        """Take the next batch of at most `size` requests.

        Args:
            size: The largest batch.
            now: The time, s.

        Returns:
            The batch, and the requests whose deadlines have passed or whose clients have left,
            which are removed. Finished requests are dropped.
        """
        lone = self._lone
        if (
            lone is not None
            and (self.room is None or _is_served_first(lone))
            and not (lone.over or lone.origin.ended)
            and now <= lone.deadline
            # For most requests, which are taken immediately, the second check makes no call.
            and (now <= lone.certain_until or not lone.is_useless(now))
        ):
            self._lone = None
            lone.begun = True
            self.depth[lone.priority] = self.size = 0
            self._yielded = False
            return [lone], []
        self._enqueue_lone()

        batch: list[PendingRequest] = []
        expired: list[PendingRequest] = []
        still_waiting: list[_SessionQueue] = []  # sessions with further requests

        urgent, patient, displaced = self._urgent, self._patient, self._displaced
        urgent_until = now + self._urgent_s()
        while patient and patient.first_needed() <= urgent_until:
            urgent.add(patient.next())
        for robots in (displaced, self._without_slack):
            while robots.is_impatient(now, BEHIND_OTHERS_S):
                urgent.add(robots.next())

        while urgent and len(batch) < size:
            self._pick(urgent.next(), now, batch, expired, still_waiting)
        size = self._size_in_time(batch, size, now)
        while patient and len(batch) < size:
            self._pick(patient.next(), now, batch, expired, still_waiting)

        if not (urgent or patient):
            most = size if self.room is None else min(size, self.room.displaced)
            while displaced and len(batch) < most:
                self._pick(displaced.next(), now, batch, expired, still_waiting)
        yielded = False
        if not (urgent or patient or displaced):
            most = self._most_with_others(batch, size, now)
            simulations = self._simulations
            is_turn = not self._yielded and simulations.is_impatient(now, PATIENCE_S)
            if is_turn and len(batch) < most:
                rows = len(batch)
                self._pick(simulations.next(), now, batch, expired, still_waiting)
                # The batch has no slot for a simulation if all requests of that session are over or
                # have expired.
                yielded = len(batch) > rows
            for others in (self._without_slack, simulations):
                while others and len(batch) < most:
                    self._had_others = True
                    self._pick(others.next(), now, batch, expired, still_waiting)
        self._yielded = yielded

        for queue in still_waiting:
            self._enqueue(queue, now)
        return batch, expired

    def _most_with_others(self, batch: Sequence[PendingRequest], size: int, now: float) -> int:
        """Return how many requests the batch may have, at most `size`, with requests of robots
        without slack and of simulations.
        """
        if self.room is None:
            return size
        most = min(size, self.room.beside if batch else self.room.alone)
        is_held = bool(self._without_slack or self._simulations) and len(batch) >= most
        if batch and is_held and len(batch) < size and now >= self._held_until:
            self._held_until = now + self.room.held_s
            return len(batch) + 1
        return most

    def _size_in_time(self, batch: Sequence[PendingRequest], size: int, now: float) -> int:
        """Return how many requests the batch may have, at most `size`, so that further requests
        make no answer late that is otherwise in time.
        """
        if not self.costs_s:
            return size
        in_time_s = now + self.costs_s[len(batch)]
        first_needed = min(
            (pending.needed for pending in batch if pending.needed >= in_time_s), default=math.inf
        )
        while size > len(batch) and now + self.costs_s[size] > first_needed:
            size -= 1
        return size

    def clear(self) -> list[PendingRequest]:
        """Remove and return all waiting requests."""
        self._enqueue_lone()
        waiting: list[PendingRequest] = []
        for queue in self._sessions.values():
            waiting.extend(queue)

        self._sessions.clear()
        self._urgent = _SourceQueue()
        self._patient = _PatientQueue()
        self._displaced = _SourceQueue()
        self._without_slack = _SourceQueue()
        self._simulations = _SourceQueue()
        self.depth = [0] * len(Priority)
        self.size = 0
        return waiting

    def _pick(
        self,
        queue: _SessionQueue,
        now: float,
        batch: list[PendingRequest],
        expired: list[PendingRequest],
        still_waiting: list[_SessionQueue],
    ) -> None:
        """Move the session's first live request to the batch, and drop finished and expired
        requests before it.

        A session with further requests is added to `still_waiting`.
        """
        session_id = queue[0].session_id
        while queue:
            pending = queue.popleft()
            self.depth[pending.priority] -= 1
            self.size -= 1

            if pending.over:
                continue
            if pending.is_useless(now):
                expired.append(pending)
                continue

            pending.begun = True
            batch.append(pending)
            break

        if queue:
            still_waiting.append(queue)
        else:
            del self._sessions[session_id]
