"""Replies from a policy's results and errors: checked, bounded, and collected for the frame that holds them."""

from __future__ import annotations

import logging
import sysconfig
import threading
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    DeadlineExceeded,
    InvalidInput,
    MessageTooLarge,
    OutcomeUnknown,
    PolicyFailed,
    VLAgentsError,
)
from vlagents_ray.images.codecs import DecodedFiles
from vlagents_ray.interface import Act
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Reply, Request
from vlagents_ray.protocol.values import ValueWriter
from vlagents_ray.serve.models.loaded_model import LoadedModel
from vlagents_ray.serve.queue.batch_queue import PendingRequest
from vlagents_ray.serve.sessions import Session
from vlagents_ray.validation import check_action

logger = logging.getLogger(__name__)

Done = Callable[[list[Reply]], None]
_LIBRARIES = (str(Path(__file__).parents[2]), sysconfig.get_path("stdlib"))  # this package's own, and Python's


class Watcher(Protocol):
    """Sees messages and their answers: `vlagents_ray.serve.observers.base`."""

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        """Return `done`, or a function that calls it with the answers.

        Args:
            sessions: The session of each of `items`, as the engine names it.
            items: The requests of a message, and the replies to unreadable ones.
            files: The files of its images.
            done: Sends the answers.
        """
        ...


class Watchers:
    """The watchers of an engine, which are themselves one. Thread-safe."""

    def __init__(self) -> None:
        self.one: Watcher | None = None  # sees all messages; None while nobody watches, which costs one comparison
        self._all: tuple[Watcher, ...] = ()
        self._lock = threading.Lock()

    def add(self, watcher: Watcher) -> None:
        """Let it see the messages from now on."""
        with self._lock:
            self._set((*self._all, watcher))

    def remove(self, watcher: Watcher) -> None:
        """Let it see no further messages; does nothing if it was not added."""
        with self._lock:
            self._set(tuple(one for one in self._all if one is not watcher))

    def note(self, sessions: Sequence[str], items: Sequence[Request | Reply], files: DecodedFiles, done: Done) -> Done:
        """See `Watcher`."""
        for watcher in self._all:
            done = watcher.note(sessions, items, files, done)
        return done

    def _set(self, watchers: tuple[Watcher, ...]) -> None:
        self._all = watchers
        self.one = watchers[0] if len(watchers) == 1 else self if watchers else None


def build_reply(
    ticket: PendingRequest,
    session: Session[LoadedModel],
    result: Act | Exception,
    contract: Contract | None,
    limit: int = DEFAULT_LIMITS.reply_bytes,
    policy: Mapping[str, Any] = MappingProxyType({}),
) -> Reply:
    """Build the reply to an act request, and count the step of its session if the result is valid.

    Args:
        ticket: The act request.
        session: Its session.
        result: The policy's result, or the error that it raised.
        contract: The policy's contract, if it has one; the action is checked against it.
        limit: Largest size of action and info together, bytes.
        policy: Version of the weights that acted, for the info, unless the policy itself names one (as a proxy does).

    Returns:
        The reply; with an error if the policy raised one, or if its result is invalid or too large.
    """
    request_id = ticket.request.request_id
    try:
        if isinstance(result, Exception):
            raise result
        if not isinstance(result, Act):
            raise PolicyFailed(f"act: the policy returned {type(result).__name__}, want an Act")
        if (size := getattr(result.action, "nbytes", 0)) > limit:  # before it is copied and checked
            raise PolicyFailed(_too_large("action", size, limit))
        act = Act(check_action(result.action, contract), bool(result.done), result.info)
        if act.action.nbytes > limit:  # the policy may return a list of numbers, which has no `nbytes`
            raise PolicyFailed(_too_large("action", act.action.nbytes, limit))
        if act.info:
            require_serializable(act.info, limit - act.action.nbytes)
        act.info = {**policy, **(act.info or {})}  # the session's own; policies without info may say None
    except Exception as error:  # noqa: BLE001 - becomes the reply
        return Reply(request_id, error=public_error(error, ticket))
    session.steps += 1
    return Reply(request_id, act=act, step=session.steps)


def public_error(error: Exception, ticket: PendingRequest) -> VLAgentsError:
    """Return the error for the caller; details of an error that the policy raised are only logged."""
    if isinstance(error, VLAgentsError):
        return error
    request = ticket.request
    logger.error(
        "%s failed (session %s, request %s)", request.op, ticket.session_id, request.request_id, exc_info=error
    )
    return PolicyFailed(
        f"{request.op}: the policy raised {type(error).__name__}{raised_at(error)}; "
        f"the server's log has the details under request id {request.request_id or '(none)'}"
    )


def raised_at(error: Exception) -> str:
    """Return the line of the user's own code that raised an error, " (my_policy.py:12)"; "" if none did."""
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if not frame.filename.startswith(_LIBRARIES) and "site-packages" not in frame.filename:
            return f" ({Path(frame.filename).name}:{frame.lineno})"
    return ""


def timing(arrived: float, began: float, ended: float) -> dict[str, Any]:
    """Return the stages of a request that the engine measures, ms: the wait for the policy's call, and the call.

    The arguments are times of the engine's clock, s: of the request's arrival, the call's begin, and its end.
    """
    return {"queue_ms": (began - arrived) * 1e3, "inference_ms": (ended - began) * 1e3}


def require_serializable(info: dict[str, Any], limit: int = DEFAULT_LIMITS.reply_bytes) -> None:
    """Check that the info of a reply can be sent, so that an invalid one only fails the session's own request.

    Arrays are not copied. An info of more than `limit` bytes, or of more values than the client accepts, is refused,
    since other replies would wait while it is sent.

    Raises:
        PolicyFailed: The info cannot be encoded, or is too large.
    """
    try:
        _BoundedWriter(limit).value(info)
    except InvalidInput as error:
        raise PolicyFailed(f"the policy's answer cannot be sent: {error}") from error


class _BoundedWriter(ValueWriter):
    """Encodes values within the limits that clients accept."""

    def __init__(self, limit: int) -> None:
        super().__init__()
        self._limit = limit
        self._bytes = self._values = self._depth = 0

    def value(self, value: Any) -> Any:
        """See `ValueWriter`; raises `MessageTooLarge` before a value is copied that exceeds the limits."""
        self._values += 1
        if self._values > DEFAULT_LIMITS.items:
            raise MessageTooLarge(f"info: more than {DEFAULT_LIMITS.items} values; send arrays instead of lists")
        if value is None or isinstance(value, (int, float)):
            return value  # first: the abstract classes below take five times as long
        if isinstance(value, (np.ndarray, memoryview)):
            self._bytes += value.nbytes
        elif isinstance(value, (str, bytes, bytearray)):
            self._bytes += len(value)
        elif isinstance(value, (Mapping, Sequence)):
            return self._nested(value)
        if self._bytes > self._limit:
            raise MessageTooLarge(_too_large("info", self._bytes, self._limit))
        return super().value(value)

    def _nested(self, value: Any) -> Any:
        if self._depth >= DEFAULT_LIMITS.depth:
            raise MessageTooLarge(f"info: nested deeper than {DEFAULT_LIMITS.depth}; flatten it")
        self._depth += 1
        written = super().value(value)
        self._depth -= 1
        return written


def _too_large(what: str, got: int, limit: int) -> str:
    return f"{what}: got {got} bytes, want {limit} at most (`limits.reply_bytes`); return less"


class ReplyCollector:
    """Collects the replies to the requests of one frame, and passes them to `done` once all are there."""

    __slots__ = (
        "_asks_to_reconnect",
        "_done",
        "_items",
        "_lock",
        "_missing",
        "_replies",
        "_withdraw",
        "over",
        "tickets",
    )

    def __init__(
        self,
        items: Sequence[Request | Reply],
        done: Done,
        asks_to_reconnect: Callable[[], bool],
        withdraw: Callable[..., None],
    ) -> None:
        """Create the collector of one frame.

        Args:
            items: The requests of the frame, and the replies to unreadable ones.
            done: Called once with all replies.
            asks_to_reconnect: Returns whether the replies ask the client to reconnect.
            withdraw: `Engine.withdraw`.
        """
        self.tickets: dict[int, PendingRequest] = {}  # the latest ticket of each request, by the request's identity
        self.over = False  # whether the caller no longer waits, so that nothing more is queued
        self._withdraw = withdraw
        self._items = items
        self._replies: list[Reply | None] = [None] * len(items)
        self._missing = len(items)
        self._done = done
        self._asks_to_reconnect = asks_to_reconnect
        self._lock = threading.Lock()

    def put(self, index: int, reply: Reply) -> None:
        """Store the reply to one of the requests; a second reply to it is ignored."""
        with self._lock:
            if self._replies[index] is not None:
                return
            self._replies[index] = reply
            self._missing -= 1
            if self._missing:
                return
        self.tickets.clear()  # each refers to this: a reference cycle would make the garbage collector pause the policy
        asks_to_reconnect = self._asks_to_reconnect()
        for each in self._replies:
            each.draining = asks_to_reconnect  # type: ignore[union-attr]
        self._done(self._replies)  # type: ignore[arg-type]

    def expire(self) -> None:
        """Answer the requests without a reply: their deadlines have passed, and those not begun are withdrawn."""
        self.over = True  # set before the tickets are copied: a concurrent new ticket is either copied, or not queued
        tickets = dict(self.tickets)
        self._withdraw(*tickets.values())
        for index, item in enumerate(self._items):
            if isinstance(item, Request) and self._replies[index] is None:
                late = DeadlineExceeded(f"no action within {item.deadline_ms:g} ms: not acted on, and never will be")
                if id(item) in tickets and tickets[id(item)].begun:
                    late = OutcomeUnknown(f"no action within {item.deadline_ms:g} ms, but the policy is at work on it")
                self.put(index, Reply(item.request_id, error=late))

    def cancel(self) -> None:
        """Cancel all requests, since the caller no longer waits for the replies."""
        self.over = True
        for ticket in list(self.tickets.values()):
            ticket.cancelled = True
