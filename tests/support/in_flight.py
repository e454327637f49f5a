"""Functions that send requests to an engine directly, without an endpoint."""

from __future__ import annotations

import asyncio
import contextlib
import queue
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from eval_fakes import wait_for

from vlagents_ray.protocol.frames import Decoded, decode_requests
from vlagents_ray.protocol.messages import PRIORITIES, MessageLimits, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.access.charges import Account
from vlagents_ray.serve.endpoints.connection import STAMP_SPACE, enable_timestamps, time_in_socket_s
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import NOWHERE, IncomingMessage, Origin, PendingRequest
from vlagents_ray.serve.sessions import Session, SessionTable

Done = Callable[[Reply], Any]


@dataclass(frozen=True)
class Calls:
    """The receiver of a message; it calls a function with the replies."""

    function: Callable[[list[Reply]], Any]

    def deliver(self, message: IncomingMessage) -> None:
        """Call the function."""
        self.function(message.replies)


@dataclass(frozen=True)
class CallsWithOne:
    """The receiver of a message with one request; it calls a function with the reply."""

    function: Done

    def deliver(self, message: IncomingMessage) -> None:
        """Call the function."""
        [reply] = message.replies
        self.function(reply)


class AnySession:
    """A table of sessions in which every session exists."""

    def __contains__(self, session_id: object) -> bool:
        return True


def ignore(_: object) -> None:
    """Drop a reply."""


def message_of_one(done: Done = ignore) -> IncomingMessage:
    """Return a message with one request; `done` is called with its reply."""
    message = IncomingMessage("test")
    message.expect(1, CallsWithOne(done))
    return message


def pending(
    session_id: str, request: Request, done: Done = ignore, **fields: Any
) -> PendingRequest:
    """Return a request in flight, with its own priority and deadline."""
    priority = PRIORITIES[request.priority]
    one = PendingRequest(session_id, request, message_of_one(done), priority, **fields)
    if request.deadline_ms is not None:
        one.deadline = one.arrived + request.deadline_ms / 1e3
    return one


def opened(
    table: SessionTable[Any], session_id: str, origin: Origin = NOWHERE, **fields: Any
) -> Session[Any]:
    """Return the session, in which a reset has begun an episode; `fields` are fields of the
    request.
    """
    reset = pending(session_id, Request("reset", **fields), origin=origin)
    return table.begin(session_id, table.reserve(reset, {}, follows=True))


def checked(engine: Engine, session_id: str, request: Request, done: Done) -> PendingRequest:
    """Return a request that the engine has checked but not queued. Errors of the check are
    raised.
    """
    one = pending(session_id, request, done)
    one.reserved = engine.intake.reserve(one)
    return one


def submit(engine: Engine, session_id: str, request: Request, done: Done) -> PendingRequest:
    """Queue a request; errors of its check are raised here."""
    one = checked(engine, session_id, request, done)
    engine.queue.put(one)
    return one


def asked(engine: Engine, session_id: str, request: Request) -> queue.SimpleQueue[Reply]:
    """Queue a request, and return the queue that will contain the reply."""
    replies: queue.SimpleQueue[Reply] = queue.SimpleQueue()
    submit(engine, session_id, request, replies.put)
    return replies


def answered(engine: Engine, session_id: str, request: Request) -> Reply:
    """Queue a request, wait for the reply, and return it."""
    return asked(engine, session_id, request).get(timeout=30)


def arrived(sender: Sender) -> IncomingMessage:
    """Return a message that has just arrived from a sender and is charged to its key."""
    return sender.message(Account(sender._caller or NoKey.OPEN).charge())


def send(
    sender: Sender, requests: Sequence[Request], done: Callable[[list[Reply]], Any]
) -> list[PendingRequest]:
    """Send the requests of a message; `done` is called with all replies."""
    message, decoded = arrived(sender), Decoded(list(requests), {})
    message.decoded(decoded)
    return sender.send(message, decoded, Calls(done))


async def ask(sender: Sender, requests: Sequence[Request]) -> list[Reply]:
    """Send the requests of a message, wait for the replies, and return them."""
    return await sender.ask(arrived(sender), Decoded(list(requests), {}))


def in_order(decoded: Decoded) -> list[Request | Reply]:
    """Return the requests of a message in order, with an error reply in the place of each
    unreadable request.
    """
    found: list[Request | Reply] = list(decoded.requests)
    for place in sorted(decoded.refused):
        found.insert(place, decoded.refused[place])
    return found


def read_requests(*arguments: Any) -> list[Request | Reply]:
    """Return the requests that `decode_requests` reads, in order."""
    return in_order(decode_requests(*arguments))


def answer_to_frame(engine: Engine, limits: MessageLimits, session_id: str, frame: bytes) -> bytes:
    """Return the answer to a frame that arrives over a Serve handle."""
    from vlagents_ray.serve.replica.replica import answer_frame

    pause = 0.0
    while True:
        answer = asyncio.run(answer_frame(engine, limits, session_id, frame, pause))
        if isinstance(answer, bytes):
            return answer
        pause = answer


@contextlib.contextmanager
def kernel_timestamps() -> Iterator[None]:
    """Let the kernel add timestamps to data that arrives over TCP within this context. The kernel
    begins shortly after the first connection enables them.
    """
    with (
        socket.create_server(("127.0.0.1", 0)) as listener,
        socket.create_connection(listener.getsockname()) as sender,
    ):
        receiver, _ = listener.accept()
        with receiver:
            enable_timestamps(receiver)

            def is_stamped() -> bool:
                sender.send(b"x")
                time.sleep(0.01)
                return time_in_socket_s(receiver.recvmsg(1, STAMP_SPACE)[1]) > 0

            wait_for(is_stamped)
            yield
