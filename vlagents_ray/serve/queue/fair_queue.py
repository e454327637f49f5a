"""The order in which waiting requests enter batches; uses no threads and no clock but the requests'
arrival times.

Robots go before simulations. Among requests of the same priority the *sources* take turns
(round-robin): a connection that sends 512 observations at once gets one slot, then the next source
gets one, and so on until the batch is full. So a client with many requests delays the others of its
priority by no more than one batch, and a client alone fills the batch. A session (one robot, one
env) has at most one request in a batch, and its requests keep their order.

Robots may use the whole throughput of the policy. Simulations then advance slowly: once the request
of the next simulation has waited for longer than `PATIENCE_S`, it gets a slot in every second
batch.
"""

from __future__ import annotations

from collections import deque

from vlagents_ray.protocol.messages import Priority
from vlagents_ray.serve.requests import PendingRequest

# Time after which a simulation gets a slot although robots' requests keep arriving.
PATIENCE_S = 1.0

# Requests of one session, in order; never empty while the session waits.
_SessionQueue = deque[PendingRequest]


class _SourceQueue:
    """The sources of one priority in round-robin order, each with its waiting sessions."""

    __slots__ = ("queues", "sources")

    def __init__(self) -> None:
        self.sources: deque[str] = deque()
        self.queues: dict[str, deque[_SessionQueue]] = {}

    def add(self, queue: _SessionQueue) -> None:
        """Add the queue of a session that did not wait before, at the end of its source."""
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


class FairQueue:
    """The waiting requests. Adding or taking one takes constant time for any number of others.
    Not thread-safe.
    """

    def __init__(self) -> None:
        self._queues_by_priority = [_SourceQueue() for _ in Priority]
        self._sessions: dict[str, _SessionQueue] = {}
        # The only waiting request, which is not in a session's queue.
        self._lone: PendingRequest | None = None
        self._yielded = False  # whether the last batch had a slot for an impatient simulation
        # Waiting requests by priority, including those that are over.
        self.depth = [0] * len(Priority)
        self.size = 0  # waiting requests of all priorities

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
        """Add a request behind the others of its session."""
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
        self._queues_by_priority[pending.priority].add(queue)

    def take(self, size: int, now: float) -> tuple[list[PendingRequest], list[PendingRequest]]:
        """Take the next batch of at most `size` requests.

        Returns:
            The batch, and the requests whose deadlines have passed or whose connections have ended,
            which are removed. Finished requests are dropped.
        """
        lone = self._lone
        if lone is not None and not (lone.over or lone.origin.ended) and now <= lone.deadline:
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
        if robots.sources and not self._yielded and simulations.is_impatient(now):
            self._pick(simulations.next(), now, batch, expired, still_waiting)
        # It has not yielded if all requests of that session are over or have expired.
        self._yielded = bool(batch)

        for source_queue in self._queues_by_priority:
            while source_queue.sources and len(batch) < size:
                self._pick(source_queue.next(), now, batch, expired, still_waiting)

        for queue in still_waiting:
            self._queues_by_priority[queue[0].priority].add(queue)
        return batch, expired

    def clear(self) -> list[PendingRequest]:
        """Remove and return all waiting requests."""
        self._enqueue_lone()
        waiting: list[PendingRequest] = []
        for queue in self._sessions.values():
            waiting.extend(queue)

        self._sessions.clear()
        self._queues_by_priority = [_SourceQueue() for _ in Priority]
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

            # A reset whose checkpoint was loaded must run, to release that checkpoint.
            if pending.loaded is None:
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
