"""The order in which waiting requests enter batches; uses no threads and no clock but the tickets' arrival times.

Robots go before simulations. Within a class the *sources* take turns (round-robin): a connection that sends 512
observations at once gets one slot, then the next source gets one, and so on until the batch is full. So a client with
many requests delays the others of its class by no more than one batch, and a client alone fills the batch. A session
(one robot, one env) has at most one request in a batch, and its requests keep their order.

Robots may use the whole throughput of the policy. Simulations then advance slowly: once the request of the next
simulation has waited for longer than `PATIENCE_S`, it gets a slot in every second batch.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.queue.preparation import Preparation

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class CheckpointChoice:
    """The checkpoint that a session asked for: by default the deployment's own."""

    name: str | None = None  # name of one of the deployment's `choices`; None for the deployment's own
    step: int | None = None  # training step of the checkpoint; None for the step that the settings name

    def __str__(self) -> str:
        if self == DEFAULT:
            return "the deployment's own checkpoint"
        step = "" if self.step is None else f"step {self.step}"
        return f"checkpoint {' at '.join(filter(None, ('' if self.name is None else repr(self.name), step)))}"


DEFAULT = CheckpointChoice()


PATIENCE_S = 1.0  # time after which a simulation gets a slot although robots' requests keep arriving


class Rank(IntEnum):
    """Classes of requests, the most urgent first."""

    ROBOT = 0
    SIMULATION = 1


@dataclass(slots=True)
class PendingRequest:
    """A queued request and its callbacks. `done` is called once, on one of the queue's threads."""

    session_id: str
    request: Request
    done: Callable[[Reply], None]
    rank: Rank = Rank.ROBOT
    arrived: float = field(default_factory=time.perf_counter)  # arrival time, s
    cancelled: bool = False  # whether it was answered, or its caller no longer waits
    connection: str = ""  # connection that carries several sessions, as the source of the turns; empty: the session
    owner: str = ""  # connection with which its session ends; empty if the caller has none
    transport: str = ""  # transport of the request, for the metrics
    choice: CheckpointChoice = DEFAULT  # checkpoint for the episode, if the request is a reset
    follows: bool = True  # whether the episode takes the newest version of the weights, if the request is a reset
    loaded: float | None = None  # time at which the checkpoint was loaded, s, if the reset had to wait for it
    begun: bool = False  # whether it is in a batch, so that the policy acts on it; guarded by the queue's lock
    first: int = 0  # step at which the episode begins, if the request is a reset
    preparation: Preparation | None = None  # of its observation, on another thread
    return_s: float | None = None  # recent time from an answer to the session's next request, s, if known
    part: Callable[[Reply], object] | None = (
        None  # receives the replies before the last, if the chunk may come in parts
    )

    def answer(self, reply: Reply) -> None:
        """Deliver the reply, unless the request was answered or cancelled already."""
        if self.cancelled:
            return
        self.cancelled = True
        if self.preparation is not None:
            self.preparation.cancel()
            self.preparation = None
        # The callback refers to this ticket: a reference cycle would make the garbage collector pause the policy.
        done, self.done = self.done, _ignore_reply
        self.part = None
        try:
            done(reply)
        except Exception:
            logger.exception("request %s: its caller could not take the reply", self.request.request_id)

    def answer_part(self, reply: Reply) -> None:
        """Deliver a part of the reply, unless the request was answered or cancelled already."""
        part = self.part
        if self.cancelled or part is None:
            return
        try:
            part(reply)
        except Exception:
            logger.exception("request %s: its caller could not take a part", self.request.request_id)

    def expired(self, now: float) -> bool:
        """Return whether the deadline has passed at `now`, s."""
        deadline_ms = self.request.deadline_ms
        return deadline_ms is not None and (now - self.arrived) * 1e3 > deadline_ms - self.request.waited_ms


def _ignore_reply(reply: Reply) -> None:
    """Ignore a second reply to a request."""


_SessionQueue = deque[PendingRequest]  # requests of one session, in order; never empty while the session waits


class _ClassQueue:
    """The sources of one class in round-robin order, each with its waiting sessions."""

    __slots__ = ("queues", "sources")

    def __init__(self) -> None:
        self.sources: deque[str] = deque()
        self.queues: dict[str, deque[_SessionQueue]] = {}

    def add(self, queue: _SessionQueue) -> None:
        source = queue[0].connection or queue[0].session_id
        queues = self.queues.get(source)
        if queues is None:
            self.queues[source] = deque((queue,))
            self.sources.append(source)
        else:
            queues.append(queue)

    def next(self) -> _SessionQueue:
        """Return the next session of the next source, and move that source to the end of the order."""
        source = self.sources.popleft()
        queues = self.queues[source]
        queue = queues.popleft()
        if queues:
            self.sources.append(source)
        else:
            del self.queues[source]
        return queue

    def impatient(self, now: float) -> bool:
        """Return whether the next request has waited for longer than `PATIENCE_S`."""
        return bool(self.sources) and now - self.queues[self.sources[0]][0][0].arrived > PATIENCE_S


class FairQueue:
    """Waiting tickets. Adding and taking one takes constant time, whatever the number of others. Not thread-safe."""

    def __init__(self) -> None:
        self._rank_queues = [_ClassQueue() for _ in Rank]
        self._sessions: dict[str, _SessionQueue] = {}
        self._lone: PendingRequest | None = None  # the only waiting ticket, which is in no other queue
        self._yielded = False  # whether the last batch had a slot for an impatient simulation
        self.depth = [0] * len(Rank)  # waiting tickets by rank, including cancelled ones
        self.size = 0  # waiting tickets of all ranks

    def __contains__(self, session_id: str) -> bool:
        self._enqueue_lone()
        return session_id in self._sessions

    @property
    def sessions(self) -> int:
        """Number of sessions with waiting tickets."""
        return len(self._sessions) + (self._lone is not None)

    def heads(self) -> list[PendingRequest]:
        """Return the next ticket of each session."""
        self._enqueue_lone()
        return [queue[0] for queue in self._sessions.values()]

    def add(self, ticket: PendingRequest) -> None:
        """Add a ticket behind the other tickets of its session."""
        self.depth[ticket.rank] += 1
        self.size += 1
        if self.size == 1:
            self._lone = ticket
            return
        self._enqueue_lone()
        self._append(ticket)

    def _enqueue_lone(self) -> None:
        """Move the lone ticket to the queue of its session."""
        if self._lone is not None:
            lone, self._lone = self._lone, None
            self._append(lone)

    def _append(self, ticket: PendingRequest) -> None:
        queue = self._sessions.get(ticket.session_id)
        if queue is not None:
            queue.append(ticket)
            return
        queue = self._sessions[ticket.session_id] = deque((ticket,))
        self._rank_queues[ticket.rank].add(queue)

    def take(self, size: int, now: float) -> tuple[list[PendingRequest], list[PendingRequest]]:
        """Take the next batch of at most `size` tickets.

        Returns:
            The batch, and the expired tickets that were removed on the way. Cancelled tickets are dropped.
        """
        lone = self._lone
        if lone is not None and not lone.cancelled and not lone.expired(now):
            self._lone = None
            lone.begun = True
            self.depth[lone.rank] = self.size = 0
            self._yielded = False
            return [lone], []
        self._enqueue_lone()
        batch: list[PendingRequest] = []
        expired: list[PendingRequest] = []
        again: list[_SessionQueue] = []
        robots, simulations = self._rank_queues
        yields = bool(robots.sources) and not self._yielded and simulations.impatient(now)
        self._yielded = yields
        if yields:
            self._pick(simulations.next(), now, batch, expired, again)
        for rank_queue in self._rank_queues:
            while rank_queue.sources and len(batch) < size:
                self._pick(rank_queue.next(), now, batch, expired, again)
        for queue in again:
            self._rank_queues[queue[0].rank].add(queue)
        return batch, expired

    def clear(self) -> list[PendingRequest]:
        """Remove and return all waiting tickets."""
        self._enqueue_lone()
        left = [ticket for queue in self._sessions.values() for ticket in queue]
        self._sessions.clear()
        self._rank_queues = [_ClassQueue() for _ in Rank]
        self.depth = [0] * len(Rank)
        self.size = 0
        return left

    def _pick(
        self,
        queue: _SessionQueue,
        now: float,
        batch: list[PendingRequest],
        expired: list[PendingRequest],
        again: list[_SessionQueue],
    ) -> None:
        """Move the session's first live ticket to the batch, and drop cancelled and expired ones before it."""
        session_id = queue[0].session_id
        while queue:
            ticket = queue.popleft()
            self.depth[ticket.rank] -= 1
            self.size -= 1
            if ticket.loaded is None:  # otherwise it must run, to release the checkpoint that its session holds
                if ticket.cancelled:
                    continue
                if ticket.expired(now):
                    expired.append(ticket)
                    continue
            ticket.begun = True
            batch.append(ticket)
            break
        if queue:
            again.append(queue)
        else:
            del self._sessions[session_id]
