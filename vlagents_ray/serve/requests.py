"""Requests in flight: the message that contained them, and each request from the endpoint to its
answer.

An endpoint creates an `IncomingMessage` when the last byte has arrived, decodes it, and passes its
requests to a `Sender`, which creates a `PendingRequest` for each. The decoded `Request` is not
modified on the way: the server's decisions are in the `PendingRequest`. Only the observations are
removed after use, since their memory may belong to the sender.

An answer is a value, a request with its reply. A request has a reference to its message, and the
message to its receiver: the connection that it arrived on, or the caller that waits for it.
`PendingRequest.finish` stores a reply in the message, once; the message with its last reply is
delivered to the receiver, which encodes all replies together (`vlagents_ray.serve.endpoints`).

Requests arrive on the thread that reads the connections (the policy's own, or a reader while a
batch runs) or on an event loop. The policy's thread runs batches and finishes their requests;
another thread may send the answers to simulations. Requests that reach no batch are finished by
other threads: the event loop at a deadline or if a call hangs, the thread that loads a checkpoint,
or the one that closes the engine.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import DecodedFiles, Priority, Reply, Request
from vlagents_ray.serve.queue.preparation import Preparation
from vlagents_ray.slo import Slo

if TYPE_CHECKING:
    from vlagents_ray.serve.access.api_keys import Caller
    from vlagents_ray.serve.access.charges import Charge
    from vlagents_ray.serve.engine.admission import MessageAdmission

logger = logging.getLogger(__name__)

HasLeft: TypeAlias = Callable[[], bool]
"""Returns whether a client has left: closed its connection, which the thread that reads the
connection may not know yet. Called on any thread.
"""

CERTAIN_S = 1e-3
"""Wait of a request, s, up to which its client is not asked whether it has left: a client waits
longer, and to ask takes about 2 us.
"""


@dataclass(frozen=True, slots=True)
class CheckpointChoice:
    """The checkpoint that a session requested: by default the deployment's own."""

    # Name of one of the deployment's `choices`; None for the deployment's own.
    name: str | None = None
    # Training step of the checkpoint; None for the step that the settings name.
    step: int | None = None

    def __str__(self) -> str:
        if self == DEFAULT:
            return "the deployment's own checkpoint"
        parts = []
        if self.name is not None:
            parts.append(repr(self.name))
        if self.step is not None:
            parts.append(f"step {self.step}")
        return f"checkpoint {' at '.join(parts)}"


DEFAULT = CheckpointChoice()


@dataclass(slots=True, eq=False)
class Origin:
    """The origin of one sender's requests."""

    transport: str = ""  # transport, for the metrics
    owner: str = ""  # connection with which its sessions end; empty if there is none
    # The sender, whose requests share one turn in the queue; if empty, each session has a turn.
    # It starts with the prefix, so that callers with different keys never share a turn.
    connection: str = ""
    caller: Caller | None = None  # None if no key is required
    prefix: str = ""  # prefix of the session ids of the caller's key
    # The owner's sessions, by their ids in the engine: the step at which the episode began that the
    # owner last reset or acted in; None if it has done neither.
    sessions: dict[str, int | None] = field(default_factory=dict)
    opened: float = 0.0  # time at which the connection was opened, s, of the engine's clock
    # Whether the connection has ended, so that its waiting requests do nothing more.
    ended: bool = False
    # Whether the client connects to another replica if a reply asks for it.
    can_move: bool = False


NOWHERE = Origin()


@dataclass(frozen=True, slots=True)
class Opening:
    """The server's decisions about the episode that a reset begins."""

    choice: CheckpointChoice
    kwargs: dict[str, Any]  # the options of the request that are for the policy
    follows: bool  # whether the episode takes the newest version of the weights
    first: int  # step at which the episode begins
    # First step of the connection's previous episode, which continues if the reset is undone; None
    # if there is none.
    previous: int | None
    slo: Slo | None = None  # what the robot needs, if its reset or the deployment states it


@dataclass(slots=True, eq=False)
class ReservedAct:
    """The reservation of an act: its session and episode, and what was done in advance."""

    session: Any  # the `Session` at its arrival
    model: Any  # the `LoadedModel` whose contract it was checked against, or None
    # Step at which the episode began that it was sent in; None for the session's latest one.
    episode: int | None
    preparation: Preparation | None  # preparation of its observation, on another thread


@dataclass(slots=True, eq=False)
class PendingRequest:
    """One request in flight, from its message to its answer."""

    session_id: str  # the id in the engine
    request: Request
    message: IncomingMessage  # the message that contained it, which gets its reply
    priority: Priority = Priority.ROBOT
    # Time of arrival, s, of the engine's clock, which is this one by default.
    arrived: float = field(default_factory=time.perf_counter)
    deadline: float = math.inf  # time after which an answer is of no use, s, of the engine's clock
    # Time at which the robot needs the answer, s, of the engine's clock; 0.0 if it states no slack:
    # as soon as possible.
    needed: float = 0.0
    # Whether the requests of other robots go first, as the replica cannot serve all in time.
    waits_behind_others: bool = False
    origin: Origin = NOWHERE
    has_left: HasLeft | None = None  # of its client; None if that cannot be asked
    # Time until which its client has certainly not left, s, of the engine's clock.
    certain_until: float = math.inf
    over: bool = False  # whether it was answered, or its caller no longer waits
    begun: bool = False  # whether a batch has taken it for the policy; set under the queue's lock
    sought: bool = False  # whether other replicas were searched for its session
    # What was reserved for an act or a reset before it was queued; see `Intake.reserve`.
    reserved: ReservedAct | Opening | None = None
    # If a reset had to wait for its checkpoint: the time at which that was loaded, s. Such a reset
    # runs even if it is over, to release the checkpoint.
    loaded: float | None = None
    # Recent time from an answer to the session's next request, s, if known.
    return_s: float | None = None
    index: int = 0  # index among the requests of its message
    # For observers: the image files of its message, and the observers' own data until the answer.
    files: DecodedFiles = None  # type: ignore[assignment]
    observer_data: dict[Any, Any] = None  # type: ignore[assignment]

    def finish(self, reply: Reply) -> None:
        """Store the reply in the message, unless the request is over; called on any thread.

        If it is the last reply of its message, the message is delivered. An error of its receiver
        is logged, and affects no other request.
        """
        if self.over:
            return
        self.over = True
        reserved = self.reserved
        if isinstance(reserved, ReservedAct) and reserved.preparation is not None:
            self.drop_preparation()
        try:
            self.message.answer(self.index, reply)
        except Exception:
            logger.exception(
                "request %s: its caller could not accept the reply", self.request.request_id
            )

    def drop_preparation(self) -> None:
        """Cancel the preparation of the observation, unless it has begun."""
        reserved = self.reserved
        if isinstance(reserved, ReservedAct):
            preparation, reserved.preparation = reserved.preparation, None
            if preparation is not None:
                preparation.future.cancel()

    def fail(self, error: VLAgentsError) -> None:
        """Deliver an error, unless the request is over."""
        self.finish(Reply(self.request.request_id, error=error))

    @property
    def latest_begin(self) -> float:
        """Latest time at which the episode of an act can have begun if the connection has not used
        that episode before, s.

        A client that continues an episode has begun it before it opened the connection. A later
        episode may have begun after the client sent the act, since requests of several connections
        arrive in any order.
        """
        return self.origin.opened if self.origin.owner else self.arrived

    def expired(self, now: float) -> bool:
        """Return whether the deadline has passed at `now`, s."""
        return now > self.deadline

    def is_useless(self, now: float) -> bool:
        """Return whether the deadline has passed at `now`, s, or the client has left.

        The queue asks this of each request before a batch takes it, whatever its way to the queue:
        a client leaves a frozen replica, and its session continues at another one. When the replica
        continues, it may execute what has waited before it reads that the client has left.
        """
        if self.origin.ended or now > self.deadline:
            return True
        return now > self.certain_until and self.has_left is not None and self.has_left()

    @property
    def is_abandoned(self) -> bool:
        """Whether the request is over, or its client has left."""
        return self.over or self.origin.ended or (self.has_left is not None and self.has_left())


Answer: TypeAlias = tuple[PendingRequest, Reply]
"""The answer to a request: what a call of the policy returns, before it is delivered."""


def deliver(answers: Iterable[Answer]) -> None:
    """Deliver answers to the messages of their requests, in this order."""
    for pending, reply in answers:
        pending.finish(reply)


class Receiver(Protocol):
    """Receives messages with all their replies: a connection, or a caller that waits."""

    def deliver(self, message: IncomingMessage) -> None:
        """Take the replies of a message, on the thread of the last one."""


class IncomingMessage:
    """The requests of one message, from the arrival of its last byte until their replies are
    delivered.

    Args:
        transport: Transport, for the metrics.
        op: Operation of its only request, if that is known before decoding.
        priority: Priority of that request.
        charge: Charge of the message to its sender's key, if a `Sender` submits it.
    """

    __slots__ = (
        "__weakref__",
        "_lock",
        "_missing",
        "admission",
        "arrived",
        "charge",
        "decoded_at",
        "kinds",
        "observed",
        "receiver",
        "replies",
        "sender",
        "size",
        "transport",
    )

    def __init__(
        self,
        transport: str = "",
        op: str = "unknown",
        priority: str = "robot",
        charge: Charge | None = None,
    ) -> None:
        self.transport = transport
        self.charge = charge
        self.kinds: list[tuple[str, str]] = [(op, priority)]  # operation and priority by request
        self.arrived = self.decoded_at = time.perf_counter()  # s
        self.replies: list[Reply] = []  # complete when the message is delivered
        self.receiver: Receiver  # set by `expect`
        self.sender: Receiver | None = None  # see `expect`
        self.admission: MessageAdmission | None = None  # is released before the delivery
        self.observed: Sequence[PendingRequest] = ()  # the requests that observers have seen
        self.size = 0  # bytes that count as unanswered at its connection
        self._missing = 0
        self._lock = threading.Lock()

    def arrive(self) -> None:
        """Record that the last byte has arrived."""
        self.arrived = self.decoded_at = time.perf_counter()

    def decoded(self, decoded: Decoded) -> None:
        """Record that the requests are decoded, with their operations and priorities."""
        self.decoded_at = time.perf_counter()
        self.kinds = [(request.op, request.priority) for request in decoded.requests]
        for index in sorted(decoded.refused):
            self.kinds.insert(index, ("unknown", "robot"))

    def decoded_alike(self, requests: int = 1) -> None:
        """Record that `requests` requests, all of the message's own `op` and `priority`, are
        decoded.
        """
        self.decoded_at = time.perf_counter()
        self.kinds = [self.kinds[0]] * requests

    def expect(self, requests: int, receiver: Receiver, sender: Receiver | None = None) -> None:
        """Expect this number of replies, and deliver the message to `receiver` with the last one.

        Args:
            requests: Number of requests, including those that could not be decoded.
            receiver: Takes the replies.
            sender: The `Sender` of the message, if it has one: it gets the message first, and
                passes it on.
        """
        self.replies = [None] * requests  # type: ignore[list-item]  # replaced by `answer`
        self.receiver = receiver
        self.sender = sender
        self._missing = requests

    def answer(self, index: int, reply: Reply) -> None:
        """Store the reply to the request at that index; a second reply is ignored."""
        if reply.error is None:
            reply.timing["decode_ms"] = (self.decoded_at - self.arrived) * 1e3
        else:
            reply.error.__traceback__ = None  # its frames would retain this message and its bytes
        with self._lock:
            if self.replies[index] is not None:
                return
            self.replies[index] = reply
            self._missing -= 1
            if self._missing:
                return

        if self.sender is None:
            self.receiver.deliver(self)
        else:
            self.sender.deliver(self)

    def refuse(self, error: VLAgentsError, request_id: str = "") -> None:
        """Answer a message that cannot be read with one error."""
        error.__traceback__ = None  # as in `answer`
        self.replies = [Reply(request_id, error=error)]


@dataclass(frozen=True, slots=True, eq=False)
class AwaitedReplies:
    """The receiver of a message whose caller waits on another thread."""

    replies: Future[list[Reply]] = field(default_factory=Future)

    def deliver(self, message: IncomingMessage) -> None:
        """Set the result of the future."""
        self.replies.set_result(message.replies)
