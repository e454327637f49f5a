"""Requests in flight: the message that contained them, and each request from the endpoint to its
answer.

An endpoint creates an `IncomingMessage` when the last byte has arrived, decodes it, and passes its
requests to a `Sender`, which creates a `PendingRequest` for each. The decoded `Request` is not
modified: the server's decisions are in the `PendingRequest`. Only the observations are removed
after use, since their memory may belong to the sender.

An answer is a value: a request and its reply. A request refers to its message, and the message
refers to its receiver: the connection on which it arrived, or the caller that waits for the
replies. `PendingRequest.finish` stores a reply in the message, once. After the last reply, the
message is delivered to the receiver, which encodes all replies together
(`vlagents_ray.serve.endpoints`).

Requests arrive on the thread that reads the connections (the policy's thread, or a reader thread
while a batch runs) or on an event loop. The policy's thread runs batches and finishes their
requests; another thread may send the answers to simulations. Requests that reach no batch are
finished by other threads: the event loop at a deadline or if a call hangs, the thread that loads a
checkpoint, or the thread that closes the engine.
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

from vlagents_ray.chunking.timeliness import counts_ticks
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import DecodedFiles, Priority, Reply, Request
from vlagents_ray.serve.queue.preparation import Preparation

if TYPE_CHECKING:
    from vlagents_ray.serve.access.api_keys import Caller
    from vlagents_ray.serve.access.charges import Charge
    from vlagents_ray.serve.engine.admission import MessageAdmission

logger = logging.getLogger(__name__)

HasLeft: TypeAlias = Callable[[], bool]
"""Returns whether a client has closed its connection, even if the thread that reads the connection
does not know this yet. Called on any thread.
"""

CERTAIN_S = 1e-3
"""Wait of a request, s, up to which it is not checked whether its client has left: a client waits
longer than that, and the check takes about 2 us.
"""


@dataclass(slots=True, eq=False)
class Origin:
    """The origin of one sender's requests."""

    transport: str = ""  # transport, for the metrics
    # Id of the connection whose end also ends its sessions; empty without a connection.
    owner: str = ""
    # Id of the sender, whose requests share one turn in the queue. If it is empty, each session has
    # its own turn. The id starts with the prefix, so that callers with different keys never share a
    # turn.
    connection: str = ""
    caller: Caller | None = None  # the holder of the key; None if no key is required
    prefix: str = ""  # prefix of the session ids of the caller's key
    # The sessions that executed a request of the connection, by their ids in the engine. The value
    # is the first step of the episode of its last reset or act; None if it was neither.
    sessions: dict[str, int | None] = field(default_factory=dict)
    opened: float = 0.0  # time at which the connection was opened, s, of the engine's clock
    # Whether the connection has ended; its waiting requests then have no effect.
    ended: bool = False
    # Whether the client connects to another replica if a reply requests it.
    can_move: bool = False


NOWHERE = Origin()


@dataclass(frozen=True, slots=True, eq=False)
class Opening:
    """An episode that a waiting reset will begin, see `SessionTable.reserve`."""

    kwargs: dict[str, Any]  # the request's options for the policy
    follows: bool  # whether the episode uses the newest version of the weights
    first: int  # step at which the episode begins
    arrived: float  # time at which the reset arrived, s, of the engine's clock
    origin: Origin  # origin of the reset


@dataclass(slots=True, eq=False)
class ReservedAct:
    """The session of an act, and the work that was done in advance."""

    session: Any  # the `Session` when the act arrived
    model: Any  # the `LoadedModel` with whose contract the act was compared, or None
    preparation: Preparation | None  # preparation of the act's observation, on another thread


@dataclass(slots=True, eq=False)
class PendingRequest:
    """One request in flight, from its message to its answer."""

    session_id: str  # id of the session in the engine
    request: Request
    message: IncomingMessage  # the message that contained the request, which stores the reply
    priority: Priority = Priority.ROBOT
    # Time of arrival, s, of the engine's clock, which is `time.perf_counter` by default.
    arrived: float = field(default_factory=time.perf_counter)
    deadline: float = math.inf  # time after which an answer is of no use, s, of the engine's clock
    # Time at which the robot needs the answer, s, of the engine's clock; 0.0 if the robot sends no
    # slack and needs the answer as soon as possible.
    needed: float = 0.0
    # Whether the requests of other robots are served first, since the replica cannot serve all
    # robots in time.
    waits_behind_others: bool = False
    origin: Origin = NOWHERE
    has_left: HasLeft | None = None  # whether the client has left; None if that cannot be checked
    # Time until which the client has certainly not left, s, of the engine's clock.
    certain_until: float = math.inf
    over: bool = False  # whether the request was answered, or its caller no longer waits
    begun: bool = False  # whether the request is in a batch; set under the queue's lock
    sought: bool = False  # whether other replicas were searched for the request's session
    # The reservation of an act or a reset, made before it was queued; see `Intake.reserve`.
    reserved: ReservedAct | Opening | None = None
    # First step of the episode of the connection when the request arrived; None without a
    # connection, or if the connection has not used the session.
    episode: int | None = None
    # Recent time from an answer to the session's next request, s; None if it is unknown.
    return_s: float | None = None
    index: int = 0  # index of the request in its message
    # For observers: the image files of its message, and the observers' own data until the answer.
    files: DecodedFiles = None  # type: ignore[assignment]
    observer_data: dict[Any, Any] = None  # type: ignore[assignment]

    def finish(self, reply: Reply) -> None:
        """Store the reply in the message, unless the request is over; called on any thread.

        The last reply of a message causes its delivery. An error of the receiver is logged, and
        affects no other request.
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

    def belongs_to(self, first: int, steps: int, began: float) -> bool:
        """Return whether an act or a close belongs to an episode.

        Without a step, it belongs to the episode of its connection. If the connection has none, it
        belongs to the episode that had begun when the connection was opened, or over HTTP, when the
        request arrived: a client that continues an episode began it before. A later episode may
        have begun after the client sent the request, since requests of several connections arrive
        in any order.

        Args:
            first: The step at which the episode began.
            steps: The step of the session now.
            began: The time at which the reset of the episode arrived, s, of the engine's clock.
        """
        step = self.request.step
        if step is not None:
            # A client may close a session although it does not know whether its last act was
            # executed.
            return step == steps or (self.request.op == "close" and first <= step < steps)
        if self.episode is not None:
            return self.episode == first
        return began <= (self.origin.opened if self.origin.owner else self.arrived)

    def expired(self, now: float) -> bool:
        """Return whether the deadline has passed at `now`, s."""
        return now > self.deadline

    def is_useless(self, now: float) -> bool:
        """Return whether the deadline has passed at `now`, s, or the client has left.

        The queue checks this for each request before it enters a batch, regardless of the request's
        transport. A client leaves a frozen replica, and its session continues at another replica.
        When the frozen replica continues, it might otherwise execute the waiting requests before it
        reads that the client has left.
        """
        if self.origin.ended or now > self.deadline:
            return True
        return now > self.certain_until and self.has_left is not None and self.has_left()

    @property
    def is_abandoned(self) -> bool:
        """Whether the request is over, or its client has left."""
        return self.over or self.origin.ended or (self.has_left is not None and self.has_left())


Answer: TypeAlias = tuple[PendingRequest, Reply]
"""The answer to a request: the request and its reply, which a call of the policy returns before the
delivery.
"""


def deliver(answers: Iterable[Answer]) -> None:
    """Store answers in the messages of their requests, in the given order."""
    for pending, reply in answers:
        pending.finish(reply)


class UncountedReport(Protocol):
    """A robot's report in a request that is not answered yet."""

    def executed_by(self, session: Any, tolerated_age_ms: float | None) -> None:
        """Record the `Session` that has executed the request, and the largest age of an action that
        its policy tolerates, ms; None if it is not known.
        """

    def count(self) -> None:
        """Add the report to the figures of its session and of the replica."""


class Receiver(Protocol):
    """Receives messages with all their replies: a connection, or a caller that waits."""

    def deliver(self, message: IncomingMessage) -> None:
        """Receive a message with all its replies, on the thread of the last reply."""


class IncomingMessage:
    """The requests of one message, from the arrival of its last byte until their replies are
    delivered.

    Args:
        transport: Transport, for the metrics.
        op: Operation of its only request, if the operation is known before decoding.
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
        "reports",
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
        # The robots' reports in unanswered requests, by their index.
        self.reports: dict[int, UncountedReport] = {}
        self.receiver: Receiver  # set by `expect`
        self.sender: Receiver | None = None  # see `expect`
        # Admission that is released before the delivery.
        self.admission: MessageAdmission | None = None
        self.observed: Sequence[PendingRequest] = ()  # requests that were passed to the observers
        self.size = 0  # number of bytes that count as unanswered at the connection
        self._missing = 0
        self._lock = threading.Lock()

    def arrive(self) -> None:
        """Record that the last byte has arrived."""
        self.arrived = self.decoded_at = time.perf_counter()

    def decoded(self, decoded: Decoded) -> None:
        """Record that the requests are decoded, with their operations and priorities."""
        self.decoded_at = time.perf_counter()
        self.kinds = []
        for request in decoded.requests:  # a comprehension is a function call in Python 3.11
            self.kinds.append((request.op, request.priority))
        for index in sorted(decoded.refused):
            self.kinds.insert(index, ("unknown", "robot"))

    def decoded_alike(self, requests: int = 1) -> None:
        """Record that `requests` requests are decoded, which all have the message's `op` and
        `priority`.
        """
        self.decoded_at = time.perf_counter()
        self.kinds = [self.kinds[0]] * requests

    def expect(self, requests: int, receiver: Receiver, sender: Receiver | None = None) -> None:
        """Expect a number of replies, and deliver the message to `receiver` with the last reply.

        Args:
            requests: Number of requests, including those that could not be decoded.
            receiver: Receives the message with its replies.
            sender: The `Sender` of the message, if any. It gets the message first, and passes it to
                `receiver`.
        """
        self.replies = [None] * requests  # type: ignore[list-item]  # replaced by `answer`
        self.receiver = receiver
        self.sender = sender
        self._missing = requests

    def answer(self, index: int, reply: Reply) -> None:
        """Store the reply to the request `index`; a second reply is ignored."""
        if reply.error is None:
            reply.timing["decode_ms"] = (self.decoded_at - self.arrived) * 1e3
        else:
            # The traceback's frames would keep this message and its bytes in memory.
            reply.error.__traceback__ = None
        with self._lock:
            if self.replies[index] is not None:
                return
            self.replies[index] = reply
            self._missing -= 1
            is_complete = self._missing == 0
            report = self.reports.pop(index, None)

        # Not when it arrives: a request that is not executed is sent again, with the same report.
        if report is not None and counts_ticks(reply.error):
            report.count()
        if not is_complete:
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
