"""From a door to the batch queue and back: whose requests they are, and their replies as one."""

from __future__ import annotations

import asyncio
import threading
import uuid
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from vlagents_ray.errors import DeadlineExceeded, NotReset, UnknownSession, VLAgentsError
from vlagents_ray.serve.auth import Caller, current_caller
from vlagents_ray.serve.batching import Ticket
from vlagents_ray.wire.messages import Reply, Request

if TYPE_CHECKING:
    from vlagents_ray.serve.engine import Engine

Done = Callable[[list[Reply]], None]


class Sender:
    """Whoever sends requests: a connection, with which its sessions end, or a caller without one.

    A request names its session, or means `session_id`, the sender's own. Where the server has keys, the sessions
    of one are out of reach for all others: the key's name is part of what the engine calls them.
    """

    def __init__(
        self,
        engine: Engine,
        transport: str,
        session_id: str = "",
        *,
        connected: bool = True,
        counted: bool | None = None,
        caller: Caller | None = None,
    ) -> None:
        """`caller` is whose key it is, by default that of the task that this is called in.

        `counted`: was each first request counted for the key when it came? By default those without a connection.
        """
        self._engine = engine
        self._transport = transport
        self._session_id = session_id or uuid.uuid4().hex
        self._owner = uuid.uuid4().hex if connected else ""
        self._sessions: set[str] = set()
        self._counted = not connected if counted is None else counted
        self._told = False  # to connect anew, and that its sessions follow
        self._caller = caller or current_caller()

    def send(self, items: Sequence[Request | Reply], done: Done) -> Round:
        """Queue the requests of a frame. `done` gets all replies at once, in order, on whatever thread is last.

        A `Reply` among `items` is the answer to a request that could not be read.
        """
        round_ = Round(items, done, self._shall_leave)
        ready: list[Ticket] = []
        for index, item in enumerate(items):
            if isinstance(item, Reply):
                round_.put(index, item)
                continue
            try:
                if self._caller is not None:
                    self._admit(self._caller, item, index)
                ready.append(self._ticket(round_, index, item))
            except VLAgentsError as error:
                strays = self._engine.strays if isinstance(error, UnknownSession) and item.op == "act" else None
                if strays is None or not strays.fetch(self._session(item), self._later(round_, index, item, error)):
                    round_.put(index, Reply(item.request_id, error=error))
        self._put(ready)
        return round_

    async def ask(self, items: Sequence[Request | Reply]) -> list[Reply]:
        """`send`, and wait for the replies, each no longer than its request's deadline.

        A caller that stops waiting (deadline, disconnect) takes its requests out of the queue, unless
        their batch is under way.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[list[Reply]] = loop.create_future()
        round_ = self.send(items, lambda replies: _tell(loop, future, replies))
        deadlines = [item.deadline_ms for item in items if isinstance(item, Request)]
        timer = None
        if None not in deadlines and deadlines:
            timer = loop.call_later(max(deadlines) / 1e3, round_.expire)  # type: ignore[type-var, operator]
        try:
            return await future
        finally:
            round_.cancel()
            if timer is not None:
                timer.cancel()

    def release(self, *, for_good: bool = False) -> None:
        """The connection is gone, and its sessions with it, unless it was told to go elsewhere: those are fetched.

        `for_good`: never, as its protocol has no words for that.
        """
        if self._owner and (for_good or not (self._told or self._engine.draining)):
            self._engine.sessions.close_owned(self._owner, tuple(self._sessions))  # a thread of Strays may add one

    def _shall_leave(self) -> bool:
        """Is the client to connect anew, which takes its sessions to another replica?"""
        if self._engine.leavers.tell(self._session_id):
            self._told = True
        return self._engine.draining or self._told

    @property
    def session_id(self) -> str:
        """What the engine calls the sender's own session."""
        return self._named(self._session_id)

    def _session(self, request: Request) -> str:
        return self._named(request.session or self._session_id)

    def _named(self, session_id: str) -> str:
        return session_id if self._caller is None else f"{self._caller.name}/{session_id}"

    def _admit(self, caller: Caller, request: Request, index: int) -> None:
        """What the caller's key says to it. The first of an HTTP request was counted by the guard; to close is free."""
        caller.admit(free=request.op == "close" or (index == 0 and self._counted))
        if caller.rank == "simulation":
            request.rank = "simulation"

    def _ticket(self, round_: Round, index: int, request: Request) -> Ticket:
        session_id = self._session(request)
        if request.op == "act" and self._owner and not request.session and session_id not in self._sessions:
            raise NotReset("act before reset: this connection has no session yet; reset first")
        ticket = self._engine.ticket(
            session_id,
            request,
            lambda reply: round_.put(index, reply),
            owner=self._owner,
            turn=self._session_id,
            transport=self._transport,
            quota=None if self._caller is None else (f"{self._caller.name}/", self._caller.sessions),
        )
        if self._owner:
            if request.op == "close":
                self._sessions.discard(session_id)
            else:
                self._sessions.add(session_id)
        round_.tickets.append(ticket)
        return ticket

    def _put(self, tickets: list[Ticket]) -> None:
        try:
            self._engine.queue.put(*tickets)
        except VLAgentsError as error:  # it is closed
            for ticket in tickets:
                ticket.answer(Reply(ticket.request.request_id, error=error))

    def _later(self, round_: Round, index: int, request: Request, error: VLAgentsError) -> Callable[[], None]:
        """What to do once the session was fetched from where it is, or was not found: `error` again."""

        def go_on() -> None:
            try:
                self._put([self._ticket(round_, index, request)])
            except VLAgentsError as again:
                round_.put(index, Reply(request.request_id, error=error if type(again) is type(error) else again))

        return go_on


class Round:
    """The replies to the requests of one frame, as they come; `done` gets them once, when none is missing."""

    __slots__ = ("_done", "_items", "_leave", "_left", "_lock", "_replies", "tickets")

    def __init__(self, items: Sequence[Request | Reply], done: Done, leave: Callable[[], bool]) -> None:
        """`leave` says whether the replies ask their client to connect anew."""
        self.tickets: list[Ticket] = []
        self._items = items
        self._replies: list[Reply | None] = [None] * len(items)
        self._left = len(items)
        self._done = done
        self._leave = leave
        self._lock = threading.Lock()

    def put(self, index: int, reply: Reply) -> None:
        """The reply to one of the requests; a second one is too late."""
        with self._lock:
            if self._replies[index] is not None:
                return
            self._replies[index] = reply
            self._left -= 1
            if self._left:
                return
        self.tickets.clear()  # each holds this: a ring, which the garbage collector would stop the policy for
        leave = self._leave()
        for each in self._replies:
            each.draining = leave  # type: ignore[union-attr]
        self._done(self._replies)  # type: ignore[arg-type]

    def expire(self) -> None:
        """Answer what is missing: its deadline is over."""
        self.cancel()
        for index, item in enumerate(self._items):
            if isinstance(item, Request) and self._replies[index] is None:
                late = DeadlineExceeded(f"no action within {item.deadline_ms:g} ms")
                self.put(index, Reply(item.request_id, error=late))

    def cancel(self) -> None:
        """Nobody waits for the replies any more."""
        for ticket in self.tickets:
            ticket.cancelled = True


def _tell(loop: asyncio.AbstractEventLoop, future: asyncio.Future[list[Reply]], replies: list[Reply]) -> None:
    loop.call_soon_threadsafe(_settle, future, replies)


def _settle(future: asyncio.Future[list[Reply]], replies: list[Reply]) -> None:
    if not future.done():
        future.set_result(replies)
