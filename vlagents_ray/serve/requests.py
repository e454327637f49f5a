"""Requests in flight: the message that contained them, and each request from the endpoint to its
answer.

An endpoint creates an `IncomingMessage` when the last byte has arrived, decodes it, and passes its
requests to a `Sender`, which creates a `PendingRequest` for each. The engine finishes each of these
once; when the last one is finished, the endpoint writes all answers of the message. The decoded
`Request` is not modified on the way: the server's decisions are in the `PendingRequest`. Only the
observations are removed after use, since their memory may belong to the sender.

Requests arrive on the thread that reads the connections (the policy's own, or a reader while a
batch runs) or on an event loop. The policy's thread runs batches and finishes their requests;
another thread may send the answers to simulations. Requests that reach no batch are finished by
other threads: the event loop at a deadline or if a call hangs, the thread that loads a checkpoint,
or the one that closes the engine.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, TypeVar

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.frames import Decoded, encode_replies
from vlagents_ray.protocol.json_messages import reply_to_json
from vlagents_ray.protocol.messages import DecodedFiles, Priority, Reply, Request
from vlagents_ray.protocol.shm_layout import write_answers
from vlagents_ray.serve.queue.preparation import Preparation

if TYPE_CHECKING:
    from vlagents_ray.serve.access.api_keys import Caller
    from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer

T = TypeVar("T")
Answered = Callable[["IncomingMessage"], None]

logger = logging.getLogger(__name__)

# Times of a reply's `timing`: the total, then the stages in the order of `STAGES`.
_TIMES = ("total_ms", "decode_ms", "queue_ms", "inference_ms", "encode_ms")
_NOT_MEASURED = (0.0,) * 4  # stages of a request that failed


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
    owner: str = ""  # connection with which its sessions end; empty without one
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


NOWHERE = Origin()


@dataclass(slots=True)
class Opening:
    """The server's settings for the episode that a reset begins."""

    choice: CheckpointChoice
    kwargs: dict[str, Any]  # the options of the request that are for the policy
    follows: bool  # whether the episode takes the newest version of the weights
    first: int = 0  # step at which the episode begins


@dataclass(slots=True, eq=False)
class PendingRequest:
    """One request in flight, from its message to its answer.

    `done` is called with the answer, on any thread: the policy's, one that detects a hanging
    policy, the one that reads the connection, or an event loop. If two threads answer at once,
    `done` ignores the second answer.
    """

    session_id: str  # the id in the engine
    request: Request
    done: Callable[[Reply], None]
    priority: Priority = Priority.ROBOT
    # Time of arrival, s, of the engine's clock, which is this one by default.
    arrived: float = field(default_factory=time.perf_counter)
    deadline: float = math.inf  # time after which an answer is of no use, s, of the engine's clock
    origin: Origin = NOWHERE
    over: bool = False  # whether it was answered, or its caller no longer waits
    begun: bool = False  # whether a batch has taken it for the policy; set under the queue's lock
    sought: bool = False  # whether other replicas were searched for its session
    session: Any = None  # the `Session` of an act at its arrival
    # For an act: the step at which the episode began that it was sent in, once that is known. For a
    # reset: the same of the connection's previous episode, which continues if the reset is undone.
    episode: int | None = None
    model: Any = None  # for an act: the `LoadedModel` whose contract it was checked against
    opening: Opening | None = None  # for a reset: the server's settings
    # If a reset had to wait for its checkpoint: the time at which that was loaded, s. Such a reset
    # runs even if it is over, to release the checkpoint.
    loaded: float | None = None
    preparation: Preparation | None = None  # preparation of its observation, on another thread
    # Recent time from an answer to the session's next request, s, if known.
    return_s: float | None = None
    index: int = 0  # index among the requests of its message
    # For observers: the image files of its message, and the observers' own data until the answer.
    files: DecodedFiles = None  # type: ignore[assignment]
    observer_data: dict[Any, Any] = None  # type: ignore[assignment]

    def finish(self, reply: Reply) -> None:
        """Deliver the answer, unless the request is over."""
        if self.over:
            return
        self.over = True
        if self.preparation is not None:
            self.drop_preparation()
        try:
            self.done(reply)
        except Exception:
            logger.exception(
                "request %s: its caller could not take the reply", self.request.request_id
            )

    def drop_preparation(self) -> None:
        """Cancel the preparation of the observation, unless it has begun."""
        preparation, self.preparation = self.preparation, None
        if preparation is not None:
            preparation.future.cancel()

    def fail(self, error: VLAgentsError) -> None:
        """Deliver an error, unless the request is over."""
        self.finish(Reply(self.request.request_id, error=error))

    @property
    def latest_begin(self) -> float:
        """Latest time at which the episode of an act can have begun that its connection has not
        been in before, s.

        A client that continues an episode has begun it before it opened the connection. A later
        episode may have begun after the client sent the act, since requests of several connections
        arrive in any order.
        """
        return self.origin.opened if self.origin.owner else self.arrived

    def expired(self, now: float) -> bool:
        """Return whether the deadline has passed at `now`, s."""
        return now > self.deadline

    def is_useless(self, now: float) -> bool:
        """Return whether the deadline has passed at `now`, s, or the connection that sent the
        request has ended.
        """
        return self.origin.ended or now > self.deadline

    @property
    def is_abandoned(self) -> bool:
        """Whether the request is over, or the connection that sent it has ended."""
        return self.over or self.origin.ended


class IncomingMessage:
    """The requests of one message, from the arrival of its last byte until their answers are
    written.

    A message collects the answers, encodes them with their times, and records them for the metrics.

    Args:
        op: Operation of its only request, if that is known before decoding.
        priority: Priority of that request.
    """

    __slots__ = (
        "__weakref__",
        "_asked",
        "_decoded",
        "_lock",
        "_missing",
        "_stats",
        "_then",
        "arrived",
        "replies",
        "transport",
    )

    def __init__(
        self, stats: MetricsBuffer, transport: str, op: str = "unknown", priority: str = "robot"
    ) -> None:
        self._stats = stats
        self._asked: list[tuple[str, str]] = [(op, priority)]
        self.transport = transport
        self.arrived = self._decoded = time.perf_counter()  # s
        self.replies: list[Reply] = []  # complete when `then` of `expect` is called
        self._missing = 0
        self._then: Answered | None = None
        self._lock = threading.Lock()

    def arrive(self) -> None:
        """Record that the last byte has arrived."""
        self.arrived = self._decoded = time.perf_counter()

    def decoded(self, decoded: Decoded) -> None:
        """Record that the requests are decoded, with their operations and priorities."""
        self._decoded = time.perf_counter()
        self._asked = [(request.op, request.priority) for request in decoded.requests]
        for index in sorted(decoded.refused):
            self._asked.insert(index, ("unknown", "robot"))

    def decoded_alike(self, requests: int = 1) -> None:
        """Record that `requests` requests, all of the message's own `op` and `priority`, are
        decoded.
        """
        self._decoded = time.perf_counter()
        self._asked = [self._asked[0]] * requests

    def expect(self, requests: int, then: Answered) -> None:
        """Expect this number of answers from `put`, and call `then` when the last one has
        arrived.
        """
        self.replies = [None] * requests  # type: ignore[list-item]  # replaced by `put`
        self._missing = requests
        self._then = then

    def put(self, index: int, reply: Reply) -> None:
        """Store the answer to the request at that index; a second answer is ignored."""
        if reply.error is None:
            reply.timing["decode_ms"] = (self._decoded - self.arrived) * 1e3
        else:
            reply.error.__traceback__ = None  # its frames would retain this message and its bytes
        with self._lock:
            if self.replies[index] is not None:
                return
            self.replies[index] = reply
            self._missing -= 1
            if self._missing:
                return

        # `then` may refer to the requests, which refer to this message.
        then, self._then = self._then, None
        if then is not None:
            then(self)

    def refuse(self, error: VLAgentsError, request_id: str = "") -> None:
        """Answer an unreadable message with one error."""
        error.__traceback__ = None  # as in `put`
        self.replies = [Reply(request_id, error=error)]

    def frame(self) -> bytes:
        """Encode and record the replies as a frame with complete `timing`."""
        data = encode_replies(self.replies, arrived=self.arrived)
        self.record()
        return data

    def packed(self) -> tuple[bytes, bool]:
        """Encode the replies with complete `timing`; call `record` after they are sent.

        Returns:
            The replies in compact form if they fit into that, otherwise as a frame; and whether
            they are compact.
        """
        compact = write_answers(self.replies, arrived=self.arrived)
        data = encode_replies(self.replies, arrived=self.arrived) if compact is None else compact
        return data, compact is not None

    def document(self) -> bytes:
        """Encode and record the only reply, which must not be an error, as JSON with complete
        `timing`.
        """
        begun = time.perf_counter()
        document = reply_to_json(self.replies[0])
        document.pop("timing")
        text = _json(document)
        self._written(begun)
        return f'{text[:-1]},"timing":{_json(self.replies[0].timing)}}}'.encode()

    def written(self, write: Callable[[], T]) -> T:
        """Encode the replies with `write` for a client of another system, and record them.

        The `timing` of a reply is complete only after this call.
        """
        begun = time.perf_counter()
        data = write()
        self._written(begun)
        return data

    def record_failure(self, code: str) -> None:
        """Record all requests as failed with this error code, even if the caller no longer
        waits.
        """
        total_ms = (time.perf_counter() - self.arrived) * 1e3
        for op, priority in self._asked:
            self._stats.handled((op, self.transport, priority, code), (total_ms, *_NOT_MEASURED))

    def _written(self, begun: float) -> None:
        ended = time.perf_counter()
        for reply in self.replies:
            reply.timing["encode_ms"] = (ended - begun) * 1e3
            reply.timing["total_ms"] = (ended - self.arrived) * 1e3
        self.record()

    def record(self) -> None:
        """Record the requests for the metrics. Call this after sending if possible, so that no
        client waits.
        """
        if len(self.replies) != len(self._asked):  # the message was unreadable as a whole
            self._asked = self._asked[:1]

        for (op, priority), reply in zip(self._asked, self.replies, strict=True):
            if reply.error is None:
                # Replies too large together are sent as errors, without times.
                times = tuple([reply.timing.get(name, 0.0) for name in _TIMES])
                self._stats.handled((op, self.transport, priority, "ok"), times)
            else:
                total_ms = (time.perf_counter() - self.arrived) * 1e3
                self._stats.handled(
                    (op, self.transport, priority, reply.error.code), (total_ms, *_NOT_MEASURED)
                )


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))
