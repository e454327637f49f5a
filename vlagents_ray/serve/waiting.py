"""Who waits for the policy, and whose turn it is. No threads, no clocks but the tickets' own.

Robots go before simulations. Within a class the turn goes round the *owners*: a connection that
brought 512 observations at once gets one slot, then it is the next owner's turn, and so on until the
batch is full. So a client with much to ask delays the others of its class by no more than a batch,
and alone it fills the batch. A session (one robot, one env) has at most one request in a batch, and
its requests keep their order.

Robots may take all that the policy can do. Simulations are then let in slowly: once the one whose
turn it is has waited for longer than `PATIENCE_S`, it gets a slot in every second batch.
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

from vlagents_ray.serve.checkpoints import OWN, Wish
from vlagents_ray.wire.messages import Reply, Request

logger = logging.getLogger(__name__)

PATIENCE_S = 1.0  # of a simulation behind a stream of robots that never ends


class Rank(IntEnum):
    """Classes of requests, the more urgent first."""

    ROBOT = 0
    SIMULATION = 1


@dataclass(slots=True)
class Ticket:
    """A request on its way through the queue. `done` is called once, on a thread of the queue's."""

    session_id: str
    request: Request
    done: Callable[[Reply], None]
    rank: Rank = Rank.ROBOT
    arrived: float = field(default_factory=time.perf_counter)  # s
    cancelled: bool = False  # answered, or nobody waits for the answer any more
    owner: str = ""  # the connection that it came by; the session, unless one connection carries several
    connection: str = ""  # that its session ends with
    transport: str = ""  # for the metrics
    wish: Wish = OWN  # of a reset: by which checkpoint its episode shall act
    loaded: float | None = None  # s, when that was there, if it had to wait for it
    return_s: float | None = None  # how long its session lately took from an answer to the next request, if known

    def __post_init__(self) -> None:
        if not self.owner:
            self.owner = self.session_id

    def answer(self, reply: Reply) -> None:
        """Deliver the reply, once; a caller that is gone gets none."""
        if self.cancelled:
            return
        self.cancelled = True
        try:
            self.done(reply)
        except Exception:
            logger.exception("request %s: its caller could not take the reply", self.request.request_id)

    def expired(self, now: float) -> bool:
        """Is the deadline over?"""
        deadline_ms = self.request.deadline_ms
        return deadline_ms is not None and (now - self.arrived) * 1e3 > deadline_ms


_Lane = deque[Ticket]  # the requests of one session, in order; never empty while it waits


class _Ring:
    """The owners of one class, each with the sessions that wait, in turn."""

    __slots__ = ("lanes", "turns")

    def __init__(self) -> None:
        self.turns: deque[str] = deque()
        self.lanes: dict[str, deque[_Lane]] = {}

    def add(self, owner: str, lane: _Lane) -> None:
        lanes = self.lanes.get(owner)
        if lanes is None:
            self.lanes[owner] = deque((lane,))
            self.turns.append(owner)
        else:
            lanes.append(lane)

    def clear(self) -> None:
        self.turns.clear()
        self.lanes.clear()

    def next(self) -> _Lane:
        """A session of the owner whose turn it is, who then goes to the end."""
        owner = self.turns.popleft()
        lanes = self.lanes[owner]
        lane = lanes.popleft()
        if lanes:
            self.turns.append(owner)
        else:
            del self.lanes[owner]
        return lane

    def impatient(self, now: float) -> bool:
        """Has the one whose turn it is waited for longer than `PATIENCE_S`?"""
        return bool(self.turns) and now - self.lanes[self.turns[0]][0][0].arrived > PATIENCE_S


class Waiting:
    """Tickets that wait. Adding and taking one takes constant time, whoever else waits. Not thread-safe."""

    def __init__(self) -> None:
        self._rings = [_Ring() for _ in Rank]
        self._sessions: dict[str, _Lane] = {}
        self._yielded = False  # did the batch before this one hold a slot for an impatient simulation?
        self.depth = [0] * len(Rank)  # tickets that wait, by rank, those included that nobody waits for any more
        self.size = 0  # of all ranks

    def __contains__(self, session_id: str) -> bool:
        return session_id in self._sessions

    @property
    def sessions(self) -> int:
        """Those with tickets that wait."""
        return len(self._sessions)

    def heads(self) -> list[Ticket]:
        """The next ticket of each session."""
        return [lane[0] for lane in self._sessions.values()]

    def add(self, ticket: Ticket) -> None:
        """Behind what its session has asked already."""
        self.depth[ticket.rank] += 1
        self.size += 1
        lane = self._sessions.get(ticket.session_id)
        if lane is not None:
            lane.append(ticket)
            return
        lane = self._sessions[ticket.session_id] = deque((ticket,))
        self._rings[ticket.rank].add(ticket.owner, lane)

    def take(self, size: int, now: float) -> tuple[list[Ticket], list[Ticket]]:
        """The next batch, `size` at most, and what was found expired on the way; cancelled ones vanish."""
        if self.size == 1 and (lone := self._lone(now)) is not None:
            return [lone], []
        batch: list[Ticket] = []
        expired: list[Ticket] = []
        again: list[_Lane] = []
        robots, simulations = self._rings
        yields = bool(robots.turns) and not self._yielded and simulations.impatient(now)
        self._yielded = yields
        if yields:
            self._pick(simulations.next(), now, batch, expired, again)
        for ring in self._rings:
            while ring.turns and len(batch) < size:
                self._pick(ring.next(), now, batch, expired, again)
        for lane in again:
            self._rings[lane[0].rank].add(lane[0].owner, lane)
        return batch, expired

    def _lone(self, now: float) -> Ticket | None:
        """The only ticket, taken as the loops of `take` would; None if it is not one to be run."""
        [lane] = self._sessions.values()
        ticket = lane[0]
        if ticket.cancelled or ticket.expired(now):
            return None
        self._sessions.clear()
        self._rings[ticket.rank].clear()
        self.depth[ticket.rank] = self.size = 0
        self._yielded = False
        return ticket

    def clear(self) -> list[Ticket]:
        """Everything, which then no longer waits."""
        left = [ticket for lane in self._sessions.values() for ticket in lane]
        self._sessions.clear()
        self._rings = [_Ring() for _ in Rank]
        self.depth = [0] * len(Rank)
        self.size = 0
        return left

    def _pick(self, lane: _Lane, now: float, batch: list[Ticket], expired: list[Ticket], again: list[_Lane]) -> None:
        """Move the session's first live ticket to the batch, and those before it out of the way."""
        session_id = lane[0].session_id
        while lane:
            ticket = lane.popleft()
            self.depth[ticket.rank] -= 1
            self.size -= 1
            if ticket.loaded is None:  # else its session holds a checkpoint, which is let go of when it runs
                if ticket.cancelled:
                    continue
                if ticket.expired(now):
                    expired.append(ticket)
                    continue
            batch.append(ticket)
            break
        if lane:
            again.append(lane)
        else:
            del self._sessions[session_id]
