"""The path from an endpoint to the batch queue and back: sessions of the requests, and replies of a frame."""

from __future__ import annotations

import asyncio
import uuid
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

from vlagents_ray.errors import (
    NotReset,
    PolicyUnavailable,
    TooManyRequests,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.protocol.messages import Limits, Reply, Request
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.engine.arrival import count_wait
from vlagents_ray.serve.engine.responses import Done, ReplyCollector
from vlagents_ray.serve.queue.batch_queue import PendingRequest

if TYPE_CHECKING:
    from vlagents_ray.serve.engine.engine import Engine


REFUSALS = 8  # of messages over the rate of the sender's key, one after the other, after which a connection ends
REFUSED = f"over the rate of its key {REFUSALS} times in a row; send less, or raise the rate"


class Dispatcher:
    """Queues the requests of one sender: a connection, with which its sessions end, or a caller without one.

    A request names its session; without a name it is for `session_id`, the sender's own session. If the server has
    API keys, a caller cannot reach sessions of other keys: the key's name is part of the session ids in the engine.
    """

    def __init__(
        self,
        engine: Engine,
        transport: str,
        session_id: str = "",
        *,
        caller: Identity,
        connected: bool = True,
        counted: bool | None = None,
    ) -> None:
        """Create the dispatcher of one sender.

        Args:
            engine: The engine that serves the requests.
            transport: Name of the transport, for the metrics.
            session_id: Name of the sender's own session; a random one by default.
            caller: The authenticated caller, or the reason why none is needed. It has no default, so that an endpoint
                without authentication fails.
            connected: Whether the sender has a connection, with which its sessions end.
            counted: Whether the first request of each message was counted for the key on arrival, and the others, of
                a message that is sent without an admission, by `count`; by default for senders without a connection.

        Raises:
            TypeError: `caller` is neither a `Caller` nor a `NoKey`.
        """
        if not isinstance(caller, Caller | NoKey):
            raise TypeError(f"caller: got {caller!r}, want a Caller, or a NoKey where none is asked for")
        self._engine = engine
        self._transport = transport
        self._session_id = session_id or uuid.uuid4().hex
        self._owner = uuid.uuid4().hex if connected else ""
        self._sessions: set[str] = set()
        self._counted = not connected if counted is None else counted
        self._asked_to_reconnect = False  # whether the client was asked to reconnect, so that its sessions move
        self._caller = caller if isinstance(caller, Caller) else None
        self.rated = self._caller is not None  # whether its key may be over a rate
        self._paid = False  # whether a message without an admission was counted, and with it its first request
        self._refused = 0  # number of messages that were refused one after the other
        self._prefix = f"{caller.name}/" if isinstance(caller, Caller) else ""  # of its session ids in the engine

    def admission(self, limits: Limits, size: int = 0, rank: str = "robot") -> MessageAdmission:
        """Return the admission of a message of `size` bytes; its first request counts unless the sender's `counted`."""
        robot, caller, counted = rank != "simulation", self._caller, self._counted
        keep = self._engine.watchers.one is not None
        if caller is None:
            return MessageAdmission(self._engine.admission, limits, None, size, robot=robot, keep_files=keep)

        def admit(op: object) -> bool:
            nonlocal counted
            free, counted = counted, False
            return self._count_message(caller) if op == "message" and not free else self._count(caller, op, free)

        return MessageAdmission(self._engine.admission, limits, admit, size, robot=robot, keep_files=keep)

    def count(self, requests: int) -> None:
        """Count requests for the key before any of them is sent; raise `TooManyRequests` over its rate."""
        if self._caller is not None:
            for _ in range(requests):
                self._count(self._caller, "act", counted=False)

    def count_message(self) -> None:
        """Count a message that is sent without an admission, before it is parsed; raise `TooManyRequests`."""
        if self._caller is not None:
            self._paid = False
            self._count_message(self._caller)
            self._paid = True

    def throttled_s(self) -> float:
        """Return for how long the server must not read from the sender, s; 0 if its key kept within its rate limit.

        It slows down the senders of a key whose messages are refused anyway.
        """
        return 0.0 if self._caller is None else self._caller.throttled_s()

    async def wait_unthrottled(self) -> None:
        """Wait until the server may read from the sender."""
        while (wait_s := self.throttled_s()) > 0:
            await asyncio.sleep(wait_s)

    @property
    def refused_too_often(self) -> bool:
        """Whether so many messages were refused one after the other that the connection has to end."""
        return self._refused >= REFUSALS

    def send(
        self,
        items: Sequence[Request | Reply],
        done: Done,
        arrived: float | None = None,
        admission: MessageAdmission | None = None,
    ) -> ReplyCollector:
        """Queue the requests of a frame.

        Args:
            items: The requests; a `Reply` among them is the answer to a request that could not be read.
            done: Receives all replies at once, in order, on the thread that completes the last one.
            arrived: Time at which the deadlines begin, s of the engine's clock; by default now.
            admission: Admission of the message, which has already counted the requests for the key.
        """
        if (watcher := self._engine.watchers.one) is not None:
            sessions = ["" if isinstance(item, Reply) else self._session(item) for item in items]
            done = watcher.note(sessions, items, (admission and admission.files) or {}, done)
        if admission is not None and admission.holds:
            done = partial(_release, admission, done)
        collector = ReplyCollector(items, done, self._asks_to_reconnect, self._engine.withdraw)
        ready: list[PendingRequest] = []
        for index, item in enumerate(items):
            if isinstance(item, Reply):
                collector.put(index, item)
                continue
            try:
                if self._caller is not None:
                    self._admit(self._caller, item, counted=admission is not None or self._counted or self._paid)
                    self._paid = False
                ready.append(self._ticket(collector, index, item, arrived))
            except VLAgentsError as error:
                self._refuse(collector, index, item, error, arrived)
        self._put(ready)
        return collector

    async def ask(self, items: Sequence[Request | Reply], admission: MessageAdmission | None = None) -> list[Reply]:
        """Send requests, and wait for the replies until the requests' deadlines.

        The time that a request may have waited during a pause of the process counts towards its deadline.
        When the caller stops waiting (deadline, disconnect), its requests are cancelled, unless their batch is
        running.
        """
        if (waited_s := self._engine.pauses.waited_s()) > 0:
            count_wait(items, waited_s)
        loop = asyncio.get_running_loop()
        future: asyncio.Future[list[Reply]] = loop.create_future()
        collector = self.send(items, lambda replies: _deliver(loop, future, replies), admission=admission)
        requests = [item for item in items if isinstance(item, Request)]
        left_ms = [one.deadline_ms - one.waited_ms for one in requests if one.deadline_ms is not None]
        timer = None
        if left_ms and len(left_ms) == len(requests):
            timer = loop.call_later(max(left_ms) / 1e3, collector.expire)
        try:
            return await future
        finally:
            collector.cancel()
            if timer is not None:
                timer.cancel()

    def release(self, *, for_good: bool = False) -> None:
        """End the sessions of a closed connection, unless its client was asked to reconnect elsewhere.

        The sessions of such a client are kept, for another replica to fetch. `for_good` ends them in any case, for
        protocols that cannot ask a client to reconnect.
        """
        if self._owner and (for_good or not (self._asked_to_reconnect or self._engine.draining)):
            self._engine.sessions.close_owned(self._owner, tuple(self._sessions))  # a migrator's thread may add one

    def _asks_to_reconnect(self) -> bool:
        """Return whether the reply asks the client to reconnect, which moves its sessions to another replica."""
        if self._engine.drain_list.ask(self._session_id):
            self._asked_to_reconnect = True
        return self._engine.draining or self._asked_to_reconnect

    @property
    def session_id(self) -> str:
        """Id of the sender's own session in the engine."""
        return self._prefix + self._session_id

    def _session(self, request: Request) -> str:
        return self._prefix + (request.session or self._session_id)

    def _count(self, caller: Caller, op: object, counted: bool) -> bool:
        """Count a request for the key, unless it is `counted` or a close. False if the key has the simulation class."""
        caller.admit(free=counted or op == "close")
        return caller.rank != "simulation"

    def _count_message(self, caller: Caller) -> bool:
        try:
            caller.admit()
        except TooManyRequests:
            self._refused += 1
            raise
        self._refused = 0
        return caller.rank != "simulation"

    def _admit(self, caller: Caller, request: Request, *, counted: bool) -> None:
        """Apply the limits and the class of the caller's key to a request.

        The guard of the HTTP server has already counted the first request of a message.
        """
        if not self._count(caller, request.op, counted):
            request.rank = "simulation"
        if request.op == "reset":
            caller.note("reset session", repr(request.session or self._session_id))

    def _ticket(
        self, collector: ReplyCollector, index: int, request: Request, arrived: float | None, *, again: bool = False
    ) -> PendingRequest:
        session_id = self._session(request)
        if request.op == "act" and self._owner and not request.session and session_id not in self._sessions:
            raise NotReset("act before reset: this connection has no session yet; reset first")
        ticket = self._engine.ticket(
            session_id,
            request,
            lambda reply: (
                collector.put(index, reply)
                if reply.error is None or again
                else self._fail(collector, index, request, reply.error)
            ),
            owner=self._owner,
            connection=self._session_id,
            transport=self._transport,
            quota=None if self._caller is None else (self._prefix, self._caller.sessions),
            arrived=arrived,
        )
        if self._owner:
            if request.op == "close":
                self._sessions.discard(session_id)
            else:
                self._sessions.add(session_id)
        collector.tickets[id(request)] = ticket
        return ticket

    def _put(self, tickets: list[PendingRequest]) -> None:
        try:
            self._engine.queue.put(*tickets)
        except VLAgentsError as error:  # the queue is closed
            for ticket in tickets:
                ticket.answer(Reply(ticket.request.request_id, error=error))

    def _fail(self, collector: ReplyCollector, index: int, request: Request, error: VLAgentsError) -> None:
        """Answer a request with an error from the queue; retry it if its session has moved to another replica."""
        ticket = collector.tickets[id(request)]  # not through `done`, with which the ticket would refer to itself
        if not ticket.begun:
            self._engine.withdraw(ticket)
        if ticket.session_id in self._engine.sessions:
            collector.put(index, Reply(request.request_id, error=error))
        else:  # the session left this replica while the request waited
            self._refuse(collector, index, request, error, ticket.arrived)

    def _refuse(
        self, collector: ReplyCollector, index: int, request: Request, error: VLAgentsError, arrived: float | None
    ) -> None:
        """Answer with the error; but queue an act again once its session was fetched from another replica."""
        finder, arrival = self._engine.finder, self._engine.clock() if arrived is None else arrived

        def retry() -> None:
            try:
                ticket = self._ticket(collector, index, request, arrival, again=True)  # with the original deadline
                if not collector.over:  # if the caller stops waiting later, the collector cancels the ticket
                    self._put([ticket])
            except VLAgentsError as again:
                collector.put(index, Reply(request.request_id, error=error if type(again) is type(error) else again))

        if finder is not None and isinstance(error, UnknownSession) and request.op == "act":
            caller = self._owner if self._caller is None else self._caller.name
            if finder.fetch(self._session(request), retry, caller):
                return
            if self._engine.draining:  # the replica has handed over its sessions
                error = PolicyUnavailable("the replica is stopping; connect again, or send the same request again")
        collector.put(index, Reply(request.request_id, error=error))


def _release(admission: MessageAdmission, done: Done, replies: list[Reply]) -> None:
    admission.release()
    done(replies)


def _deliver(loop: asyncio.AbstractEventLoop, future: asyncio.Future[list[Reply]], replies: list[Reply]) -> None:
    loop.call_soon_threadsafe(_settle, future, replies)


def _settle(future: asyncio.Future[list[Reply]], replies: list[Reply]) -> None:
    if not future.done():
        future.set_result(replies)
