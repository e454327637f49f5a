"""Submission of decoded messages to the engine, with the sessions and the key of their sender."""

from __future__ import annotations

import asyncio
import uuid
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

from vlagents_ray.errors import DeadlineExceeded, OutcomeUnknown, TooManyRequests, VLAgentsError
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import PRIORITIES, MessageLimits, Priority, Reply
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey
from vlagents_ray.serve.engine.admission import REQUEST_BYTES, MessageAdmission
from vlagents_ray.serve.requests import IncomingMessage, Origin, PendingRequest, Receiver

if TYPE_CHECKING:
    from vlagents_ray.serve.engine.engine import Engine

T = TypeVar("T")

# Number of consecutive messages over the rate of the key after which a connection ends.
REFUSALS = 8
REFUSED = f"over the rate of its key {REFUSALS} times in a row; send less, or raise the rate"


class Sender:
    """Submits the requests of a connection, whose end also ends its sessions, or of a caller
    without a connection.

    A request names its session; if it does not, it is for `session_id`, the sender's own session.
    If the server has API keys, a caller cannot reach sessions of other keys: the key's name is part
    of the session ids in the engine.

    Each message is charged to the key before it is parsed, and each further request in it before it
    is submitted. The charge for HTTP is made by the guard on arrival, then by the `admission`; for
    frames, by the `admission` alone; for the compact form of shared memory, by `count_message`,
    then by `send`; for batches of a dialect, by the `admission` of its gate, then by `count`.
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
        """Create a sender.

        Args:
            session_id: Name of the sender's own session; a random one by default.
            caller: The authenticated caller, or the reason why none is needed. It has no default,
                so that an endpoint without authentication fails.
            connected: Whether the sender has a connection, whose end also ends its sessions.
            counted: Whether the first request of each message was charged to the key on arrival, as
                it is by default for senders without a connection. Further requests of messages
                without an admission are charged by `count`.

        Raises:
            TypeError: `caller` is neither a `Caller` nor a `NoKey`.
        """
        if not isinstance(caller, Caller | NoKey):
            raise TypeError(
                f"caller: expected a Caller, or a NoKey where no key is needed, got {caller!r}"
            )

        self._engine = engine
        self._session_id = session_id or uuid.uuid4().hex
        self._counted = not connected if counted is None else counted
        # Whether the client has to reconnect, so that its sessions move.
        self._asked_to_reconnect = False
        self._caller = caller if isinstance(caller, Caller) else None
        self.rated = self._caller is not None  # whether its key may be over a rate
        # Whether a message without an admission, and with it its first request, was counted.
        self._paid = False
        self._refused = 0  # number of consecutive refused messages

        # Prefix of the sender's session ids.
        self._prefix = f"{caller.name}/" if isinstance(caller, Caller) else ""
        # Id of the sender's own session in the engine.
        self.session_id = self._prefix + self._session_id
        owner = uuid.uuid4().hex if connected else ""
        self._origin = Origin(
            transport, owner, self.session_id, self._caller, self._prefix, opened=engine.clock()
        )

    def message(self, op: str = "unknown", priority: str = "robot") -> IncomingMessage:
        """Return a message that has just arrived from the sender, see `IncomingMessage`."""
        return IncomingMessage(self._origin.transport, op, priority)

    def admission(
        self, limits: MessageLimits, size: int = 0, priority: str = "robot"
    ) -> MessageAdmission:
        """Return the admission of a message of `size` bytes, which charges its requests to the
        key; see `counted`.
        """
        robot, caller, counted = priority != "simulation", self._caller, self._counted
        keep = self._engine.observers.any
        if caller is None:
            return MessageAdmission(
                self._engine.admission, limits, None, size, robot=robot, keep_files=keep
            )

        def admit(op: object) -> bool:
            """Charge a message or a request to the key; see `MessageAdmission`."""
            nonlocal counted
            is_free, counted = counted, False
            if op == "message" and not is_free:
                return self._count_message(caller)
            return self._count(caller, op, is_free)

        return MessageAdmission(
            self._engine.admission,
            limits,
            admit,
            size,
            robot=robot,
            keep_files=keep,
            key=caller.name,
        )

    def count(self, requests: int) -> None:
        """Charge requests to the key before they are sent; raise `TooManyRequests` over its
        rate.
        """
        if self._caller is not None:
            for _ in range(requests):
                self._count(self._caller, "act", counted=False)

    def count_message(self) -> None:
        """Charge a message without an admission to the key before it is parsed; raise
        `TooManyRequests`.
        """
        if self._caller is not None:
            self._paid = False
            self._count_message(self._caller)
            self._paid = True

    def throttled_s(self) -> float:
        """Return for how long the server must not read from the sender, s; 0 if the key is within
        its rate.

        The pause slows down senders of a key whose messages are refused in any case.
        """
        return 0.0 if self._caller is None else self._caller.throttled_s()

    async def wait_unthrottled(self) -> None:
        """Wait until the server may read from the sender."""
        wait_s = self.throttled_s()
        while wait_s > 0:
            await asyncio.sleep(wait_s)
            wait_s = self.throttled_s()

    @property
    def refused_too_often(self) -> bool:
        """Return whether so many consecutive messages were refused that the connection has to
        end.
        """
        return self._refused >= REFUSALS

    def send(
        self,
        message: IncomingMessage,
        decoded: Decoded,
        receiver: Receiver,
        *,
        admission: MessageAdmission | None = None,
        waited_s: float = 0.0,
    ) -> list[PendingRequest]:
        """Submit the requests of a message.

        Args:
            receiver: Takes the message with all its replies, on the thread of the last one.
            admission: Admission of the message, which has already charged the requests to the key.
            waited_s: Time that the message waited before it was read, s, which counts towards the
                deadlines.
        """
        engine, (requests, refused) = self._engine, decoded
        now = engine.clock()
        is_observed = engine.observers.any
        sent: list[PendingRequest] = []

        size = REQUEST_BYTES * len(requests)
        overloaded = None
        try:
            if admission is not None:
                admission.grow(size)
            elif requests:
                is_robot = requests[0].priority == "robot" and (
                    self._caller is None or self._caller.priority != "simulation"
                )
                engine.admission.hold(size, is_robot, 0)
                # The bytes are also released if the requests are dropped without an answer, as
                # those of an ended connection.
                reference = weakref.ref(message, engine.admission.release_with)
                engine.admission.messages[reference] = size
        except VLAgentsError as error:
            overloaded = error

        message.admission = admission
        if is_observed:
            message.observed = sent
        message.expect(len(requests) + len(refused), receiver, self)

        index = 0
        for request in requests:
            while index in refused:
                index += 1
            pending = PendingRequest(
                self._prefix + (request.session or self._session_id),
                request,
                message,
                PRIORITIES[request.priority],
                now,
                origin=self._origin,
                index=index,
            )
            if request.deadline_ms is not None:
                pending.deadline = now + request.deadline_ms / 1e3 - waited_s
            sent.append(pending)
            index += 1

        if is_observed:
            for pending in sent:
                pending.files, pending.observer_data = (admission and admission.files) or {}, {}
                engine.observers.on_request(pending)

        if overloaded is not None:
            for pending in sent:
                pending.fail(overloaded)
        elif self._caller is None:
            engine.intake.submit(sent)
        else:
            engine.intake.submit(
                self._admitted(self._caller, sent, admission is not None or self._counted)
            )

        for index, reply in refused.items():
            message.answer(index, reply)
        return sent

    def _admitted(
        self, caller: Caller, requests: list[PendingRequest], counted: bool
    ) -> list[PendingRequest]:
        """Return the requests that the caller's key allows, with its priority; finish the others
        with their errors.

        The guard of the HTTP server has already counted the first request of a message.
        """
        allowed = []
        for pending in requests:
            request = pending.request
            try:
                if not self._count(caller, request.op, counted or self._paid):
                    pending.priority = Priority.SIMULATION
            except VLAgentsError as error:
                pending.fail(error)
                continue
            if request.op == "reset":
                caller.note("reset session", repr(request.session or self._session_id))
            self._paid = False
            allowed.append(pending)
        return allowed

    def deliver(self, message: IncomingMessage) -> None:
        """Pass a message with all its replies on to its receiver, between the calls of the
        observers.

        The memory of the message is released, and its client is requested to reconnect if the
        replica drains.
        """
        engine = self._engine
        if engine.drain_list.ask(self.session_id):
            self._asked_to_reconnect = True
        if self._asked_to_reconnect or engine.drain_list.draining:
            for reply in message.replies:
                # The client reconnects, and its sessions move to another replica.
                reply.draining = True
        if message.admission is not None:
            message.admission.release()

        # The requests refer to the message.
        observed, message.observed = message.observed, ()
        for pending in observed:
            engine.observers.before_answer(pending, message.replies[pending.index])
        message.receiver.deliver(message)
        for pending in observed:
            engine.observers.on_answer(pending, message.replies[pending.index])

    async def ask(
        self, message: IncomingMessage, decoded: Decoded, admission: MessageAdmission | None = None
    ) -> list[Reply]:
        """Submit the requests of a message, and wait for the replies until the requests' deadlines.

        If a pause of the process delayed a request, the delay counts towards its deadline. When the
        caller stops waiting (deadline, disconnect), its requests that no batch has taken are
        withdrawn.
        """
        loop = asyncio.get_running_loop()
        waiting = WaitingTask()
        waited_s = self._engine.pauses.waited_s()
        sent = self.send(message, decoded, waiting, admission=admission, waited_s=waited_s)

        timer = None
        if sent and all(request.deadline_ms is not None for request in decoded.requests):
            last_s = max(pending.deadline for pending in sent) - sent[0].arrived
            timer = loop.call_later(last_s, self._expire, message, sent)

        try:
            return await waiting.replies
        finally:
            unanswered = [pending for pending in sent if not pending.over]
            if unanswered:
                self._engine.intake.withdraw(*unanswered)
            if timer is not None:
                timer.cancel()

    def _expire(self, message: IncomingMessage, sent: Sequence[PendingRequest]) -> None:
        """Answer the unanswered requests, whose deadlines have passed; withdraw those that have
        not begun.
        """
        self._engine.intake.withdraw(*sent)
        for pending in sent:
            after = f"no action within {pending.request.deadline_ms:g} ms"
            late: VLAgentsError = DeadlineExceeded(f"{after}: not acted on, and never will be")
            if pending.begun:
                late = OutcomeUnknown(
                    f"{after}, but the policy is at work on it; it may need longer (allow more "
                    "time) or hang in a call (the server's log then names the line)"
                )
            # Ignored if the request has been answered.
            message.answer(pending.index, Reply(pending.request.request_id, error=late))

    def release(self, *, for_good: bool = False) -> None:
        """End the sessions of a closed connection, unless its client has to reconnect elsewhere.

        Its requests that no batch has taken are answered with an error, and are never executed or
        searched for.

        The sessions of such a client are kept, for another replica to fetch. `for_good` ends them
        in any case, for protocols without a request to reconnect.
        """
        self._origin.ended = True
        owner = self._origin.owner
        if owner and (
            for_good or not (self._asked_to_reconnect or self._engine.drain_list.draining)
        ):
            # The sessions are copied, since a migrator's thread may add one.
            self._engine.sessions.close_owned(owner, tuple(self._origin.sessions))

    def _count(self, caller: Caller, op: object, counted: bool) -> bool:
        """Charge a request to the key unless it is `counted` or a close; return False if the key
        is for simulations.
        """
        caller.admit(free=counted or op == "close")
        return caller.priority != "simulation"

    def _count_message(self, caller: Caller) -> bool:
        try:
            caller.admit()
        except TooManyRequests:
            self._refused += 1
            raise
        self._refused = 0
        return caller.priority != "simulation"


class WaitingTask:
    """The receiver of a message for whose replies a task waits; created on the task's loop."""

    def __init__(self) -> None:
        self.replies: asyncio.Future[list[Reply]] = asyncio.get_running_loop().create_future()

    def deliver(self, message: IncomingMessage) -> None:
        """Set the replies, from any thread."""
        settle(self.replies, message.replies)


def settle(future: asyncio.Future[T], result: T) -> None:
    """Set the result of a future, from any thread, unless its caller no longer waits."""
    future.get_loop().call_soon_threadsafe(_set_result, future, result)


def _set_result(future: asyncio.Future[T], result: T) -> None:
    if not future.done():
        future.set_result(result)
