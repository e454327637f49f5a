"""The order in which waiting requests enter batches. The module uses no threads, and no clock
except the requests' arrival times.

Robots are served before simulations. Among requests of the same priority the *sources* take turns
(round-robin): a connection that sends 512 observations at once gets one slot, then the next source
gets one, and so on until the batch is full. A client with many requests therefore delays the other
clients of its priority by at most one batch, and a single client can fill the batch. A session (one
robot, one env) has at most one request in a batch, and its requests keep their order.

A robot that executes an action chunk can send its slack: the time until its rows run out
(`PendingRequest.needed`). A robot with a long slack waits behind *urgent* robots, which need their
answers within the duration of two full batches or send no slack. Urgent robots take turns. The
other robots follow in the order in which they need their answers, and become urgent as that time
approaches. A client therefore gains nothing if it sends less slack than it has. No request that can
wait, and no simulation, is added to a batch if its row alone would make the most urgent answer
late.

If the robots need more than the replica can compute, the robots of the newest episodes
(`PendingRequest.waits_behind_others`) wait behind all other robots, but at most for
`BEHIND_OTHERS_S`.

Robots may use the whole throughput of the policy. Simulations then advance slowly: once the request
of the next simulation has waited for longer than `PATIENCE_S`, it gets a slot in every second
batch.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections import deque
from collections.abc import Sequence

from vlagents_ray.protocol.messages import Priority
from vlagents_ray.serve.requests import PendingRequest

# Time after which a simulation gets a slot although robots' requests keep arriving, s.
PATIENCE_S = 1.0
# Maximum time for which the request of a robot waits behind the requests of other robots, s.
BEHIND_OTHERS_S = 60.0

# Requests of one session, in order; never empty while the session waits.
_SessionQueue = deque[PendingRequest]


class _SourceQueue:
    """The sources of one priority in round-robin order, each with its waiting sessions."""

    __slots__ = ("queues", "sources")

    def __init__(self) -> None:
        self.sources: deque[str] = deque()
        self.queues: dict[str, deque[_SessionQueue]] = {}

    def add(self, queue: _SessionQueue) -> None:
        """Add the queue of a session that did not wait before, behind all other sessions of its
        source.
        """
        source = queue[0].origin.connection or queue[0].session_id
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
        source = self.sources.popleft()
        queues = self.queues[source]
        queue = queues.popleft()

        if queues:
            self.sources.append(source)
        else:
            del self.queues[source]
        return queue

    def is_impatient(self, now: float) -> bool:
        """Return whether the next request has waited for longer than `PATIENCE_S`."""
        if not self.sources:
            return False
        next_queue = self.queues[self.sources[0]][0]
        return now - next_queue[0].arrived > PATIENCE_S


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
        heapq.heappush(self._heap, (_needed(queue[0]), next(self._numbers), queue))

    def next(self) -> _SessionQueue:
        """Remove and return the session whose answer is needed first."""
        return heapq.heappop(self._heap)[2]

    def is_behind_others(self) -> bool:
        """Return whether the next session waits behind other robots."""
        return bool(self._heap) and self._heap[0][2][0].waits_behind_others

    def first_needed(self) -> float:
        """Return the time at which the first answer is needed, s; `inf` if no session waits."""
        return self._heap[0][0] if self._heap else math.inf


def _needed(pending: PendingRequest) -> float:
    """Return the time before which a robot's request should be answered, s."""
    if pending.waits_behind_others:
        return pending.arrived + BEHIND_OTHERS_S
    return pending.needed


class FairQueue:
    """The waiting requests. Adding or removing a request takes constant time regardless of the
    number of requests, or logarithmic time for requests with slack. Not thread-safe.
    """

    costs_s: Sequence[float] = ()
    """The duration of a batch by its number of requests, s, from 0 to the largest number. It is
    empty if the durations are unknown; all robots are then urgent.
    """

    def __init__(self) -> None:
        self._queues_by_priority = [_SourceQueue() for _ in Priority]
        self._patient = _PatientQueue()
        self._sessions: dict[str, _SessionQueue] = {}
        # The waiting request if there is only one; it is not in a session's queue.
        self._lone: PendingRequest | None = None
        self._yielded = False  # whether the last batch had a slot for an impatient simulation
        # Number of waiting requests by priority, including requests that are over.
        self.depth = [0] * len(Priority)
        self.size = 0  # number of waiting requests of all priorities

    def __contains__(self, session_id: str) -> bool:
        self._enqueue_lone()
        return session_id in self._sessions

    @property
    def sessions(self) -> int:
        """Number of sessions with waiting requests."""
        return len(self._sessions) + (self._lone is not None)

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
        # For a request without slack, the time is 0.0.
        can_wait = head.priority is Priority.ROBOT and _needed(head) > now + self._urgent_s()
        if can_wait:
            self._patient.add(queue)
        else:
            self._queues_by_priority[head.priority].add(queue)

    def _urgent_s(self) -> float:
        """Return the slack up to which a robot is urgent, s: the duration of two full batches, the
        batch that may be running and the next one.
        """
        return 2 * self.costs_s[-1] if self.costs_s else math.inf

    def take(
        self, size: int, now: float, most_with_others: float = math.inf
    ) -> tuple[list[PendingRequest], list[PendingRequest]]:
        """Take the next batch of at most `size` requests.

        Args:
            size: The largest batch.
            now: The time, s.
            most_with_others: The size up to which the batch is filled with requests that wait
                behind the requests of other robots.

        Returns:
            The batch, and the requests whose deadlines have passed or whose clients have left,
            which are removed. Finished requests are dropped.
        """
        lone = self._lone
        if (
            lone is not None
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

        robots, simulations = self._queues_by_priority
        urgent = now + self._urgent_s()
        while self._patient and self._patient.first_needed() <= urgent:
            robots.add(self._patient.next())
        if (
            (robots.sources or self._patient)
            and not self._yielded
            and simulations.is_impatient(now)
        ):
            self._pick(simulations.next(), now, batch, expired, still_waiting)
        # The batch has no slot for a simulation if all requests of that session are over or have
        # expired.
        self._yielded = bool(batch)

        while robots.sources and len(batch) < size:
            self._pick(robots.next(), now, batch, expired, still_waiting)
        size = self._size_in_time(batch, size, now)
        while self._patient and len(batch) < size:
            if len(batch) >= most_with_others and self._patient.is_behind_others():
                break
            self._pick(self._patient.next(), now, batch, expired, still_waiting)
        while simulations.sources and len(batch) < size:
            self._pick(simulations.next(), now, batch, expired, still_waiting)

        for queue in still_waiting:
            self._enqueue(queue, now)
        return batch, expired

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
        self._queues_by_priority = [_SourceQueue() for _ in Priority]
        self._patient = _PatientQueue()
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
