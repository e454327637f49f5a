"""Submission of decoded messages to the engine, with the sessions and the key of the sender."""

from __future__ import annotations

import asyncio
import math
import uuid
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

from vlagents_ray.errors import DeadlineExceeded, OutcomeUnknown, VLAgentsError
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import PRIORITIES, MessageLimits, Priority, Reply
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey
from vlagents_ray.serve.access.charges import Charge
from vlagents_ray.serve.engine.admission import REQUEST_BYTES, MessageAdmission
from vlagents_ray.serve.requests import (
    CERTAIN_S,
    HasLeft,
    IncomingMessage,
    Origin,
    PendingRequest,
    Receiver,
)

if TYPE_CHECKING:
    from vlagents_ray.serve.engine.engine import Engine

T = TypeVar("T")

# Wait of a message in a pause of the process, s, above which the client may have left unnoticed,
# and the time in which the event loop then notices that, s.
_LONG_WAIT_S, _NOTICE_S = 0.25, 0.1


class Sender:
    """Submits the requests of one sender: a connection, whose end also ends its sessions, or a
    caller without a connection.

    A request without a session id belongs to `session_id`, the sender's own session. If the server
    has API keys, a caller cannot reach sessions of other keys: the key's name is part of the
    session ids in the engine.

    Each message has the `Charge` that was made when it arrived. The sender completes this charge:
    it charges the requests that were not charged while they were decoded.
    """

    def __init__(
        self,
        engine: Engine,
        transport: str,
        session_id: str = "",
        *,
        caller: Identity,
        has_left: HasLeft | None,
        connected: bool = True,
        can_move: bool = False,
    ) -> None:
        """Create a sender.

        Args:
            session_id: Name of the sender's own session; a random one by default.
            caller: The authenticated caller, or the reason why no key is needed. It has no default,
                so that an endpoint without authentication fails.
            has_left: Returns whether the client has left, after which none of its requests is
                executed; None if this process cannot know. It has no default, so that no endpoint
                omits it.
            connected: Whether the sender has a connection, whose end also ends its sessions.
            can_move: Whether the client connects to another replica if a reply requests it.

        Raises:
            TypeError: `caller` is neither a `Caller` nor a `NoKey`.
        """
        if not isinstance(caller, Caller | NoKey):
            raise TypeError(
                f"caller: expected a Caller, or a NoKey where no key is needed, got {caller!r}"
            )

        self._engine = engine
        self._session_id = session_id or uuid.uuid4().hex
        # Whether the client has to reconnect, so that its sessions move.
        self._asked_to_reconnect = False
        self._caller = caller if isinstance(caller, Caller) else None
        self._has_left = has_left

        # Prefix of the sender's session ids.
        self._prefix = f"{caller.name}/" if isinstance(caller, Caller) else ""
        # Id of the sender's own session in the engine. It is stored, since HTTP creates a sender
        # for each request.
        self.session_id = self._prefix + self._session_id
        owner = uuid.uuid4().hex if connected else ""
        self._origin = Origin(
            transport,
            owner,
            self.session_id,
            self._caller,
            self._prefix,
            opened=engine.clock(),
            can_move=can_move,
        )

    def id_of(self, session_name: str) -> str:
        """Return the id in the engine of the session that the sender calls `session_name`."""
        return self._prefix + session_name

    def require_room(self, session_ids: Sequence[str]) -> None:
        """Raise the errors of `SessionTable.require_room` unless there is room for all of these
        sessions of the sender, by their ids in the engine.
        """
        self._engine.sessions.require_room(session_ids, self._origin)

    def discard(self, session_ids: Sequence[str]) -> None:
        """Close the sessions that a message of the sender has begun in vain."""
        self._engine.sessions.discard(session_ids, self._origin)

    def message(
        self, charge: Charge, op: str = "unknown", priority: str = "robot"
    ) -> IncomingMessage:
        """Return a message that has just arrived from the sender, see `IncomingMessage`."""
        return IncomingMessage(self._origin.transport, op, priority, charge)

    def send(
        self,
        message: IncomingMessage,
        decoded: Decoded,
        receiver: Receiver,
        *,
        admission: MessageAdmission | None = None,
        waited_s: float = 0.0,
        may_have_waited: bool = False,
    ) -> list[PendingRequest]:
        """Submit the requests of a message.

        Args:
            receiver: Receives the message with all its replies, on the thread of the last reply.
            admission: Admission of the message, if it was decoded with one.
            waited_s: Time that the message waited before it was read, s, which counts towards the
                deadlines.
            may_have_waited: Whether the message may have waited longer than `waited_s`.

        Raises:
            TypeError: The message has no charge, or its charge is for another key.
        """
        charge = message.charge
        if charge is None or not (charge.caller is self._caller or charge.caller == self._caller):
            raise TypeError(
                "message: expected a message that `Account.charge` has charged to its sender's "
                f"key, got one charged to {None if charge is None else charge.key!r}"
            )
        engine, (requests, refused) = self._engine, decoded
        now = engine.clock()
        certain_until = -math.inf if may_have_waited else now + CERTAIN_S - waited_s
        sent: list[PendingRequest] = []

        size = REQUEST_BYTES * len(requests)
        overloaded = None
        try:
            if admission is not None:
                admission.grow(size)
            elif requests:
                is_robot = requests[0].priority == "robot" and charge.is_robot
                engine.admission.hold(size, is_robot, 0)
                # The bytes are also released if the requests are dropped without an answer, as
                # after the end of a connection.
                reference = weakref.ref(message, engine.admission.release_with)
                engine.admission.messages[reference] = size
        except VLAgentsError as error:
            overloaded = error

        message.admission = admission
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
                has_left=self._has_left,
                certain_until=certain_until,
                index=index,
            )
            if request.deadline_ms is not None:
                pending.deadline = now + request.deadline_ms / 1e3 - waited_s
            sent.append(pending)
            index += 1

        if engine.observers.any:
            message.observed = sent
            for pending in sent:
                pending.files, pending.observer_data = (admission and admission.files) or {}, {}
                engine.observers.on_request(pending)

        if overloaded is not None:
            for pending in sent:
                pending.fail(overloaded)
        elif self._caller is None:
            engine.intake.submit(sent)
        else:
            engine.intake.submit(self._charged(self._caller, charge, sent))

        for index, reply in refused.items():
            message.answer(index, reply)
        return sent

    def _charged(
        self, caller: Caller, charge: Charge, requests: list[PendingRequest]
    ) -> list[PendingRequest]:
        """Return the requests that the caller's key allows, with its priority; finish all other
        requests with their errors.
        """
        allowed: list[PendingRequest] = []
        charged = 0  # number of requests to be charged
        for pending in requests:
            request = pending.request
            is_free = request.op == "close"
            try:
                # The key may have been revoked while the message arrived or was decoded.
                charge.require_valid()
                if not is_free:
                    charge.cover(charged + 1)
                    charged += 1
            except VLAgentsError as error:
                pending.fail(error)
                continue
            if not charge.is_robot:
                pending.priority = Priority.SIMULATION
            if request.op == "reset":
                caller.note("reset session", repr(request.session or self._session_id))
            allowed.append(pending)
        return allowed

    def deliver(self, message: IncomingMessage) -> None:
        """Pass a message with all its replies to its receiver, between the calls of the observers.

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

        If a pause of the process delayed a request, the delay counts towards its deadline. A busy
        event loop may also have delayed the request, by an unknown time. When the caller stops
        waiting (deadline, disconnect), its requests that are not in a batch yet are withdrawn.
        """
        loop = asyncio.get_running_loop()
        waiting = WaitingTask()
        waited_s = self._engine.pauses.waited_s()
        if self._has_left is None and waited_s > _LONG_WAIT_S:
            # The caller may have left during the pause; the sleep lets the event loop notice that,
            # and cancel this task.
            await asyncio.sleep(_NOTICE_S)
        sent = self.send(
            message,
            decoded,
            waiting,
            admission=admission,
            waited_s=waited_s,
            may_have_waited=True,
        )

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

        Its requests that are not in a batch yet are answered with an error. They are never
        executed, and their sessions are not searched for. The sessions of a client that has to
        reconnect are kept, so that another replica can fetch them. `for_good` ends them in any
        case, for protocols that cannot request a reconnection.
        """
        self._origin.ended = True
        if self._origin.owner and (
            for_good or not (self._asked_to_reconnect or self._engine.drain_list.draining)
        ):
            self._engine.sessions.close_owned(self._origin)


def message_admission(
    engine: Engine, charge: Charge, limits: MessageLimits, size: int = 0, priority: str = "robot"
) -> MessageAdmission:
    """Return the admission of a message of `size` bytes that has arrived at `engine`.

    Args:
        charge: The charge of the message.
        priority: The highest priority of its requests.
    """
    return MessageAdmission(
        engine.admission,
        limits,
        charge,
        size,
        robot=priority != "simulation",
        keep_files=engine.observers.any,
    )


class WaitingTask:
    """The receiver of a message if a task waits for the replies; created on the task's loop."""

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
