"""WebSockets of an ASGI application, whose connections one thread of the process reads.

uvicorn receives and answers the handshake. Then its socket becomes a `WebSocketConnection`, which
has the limits, the time-outs and the end of all other WebSockets of the replica. The application
receives and sends messages as specified by ASGI; or an endpoint that needs no event loop accepts
the WebSocket with a `MessageHandler` of its own.

The policy's thread cannot do this, since it would answer no ping during an unexpectedly long call:
clients of other systems end a connection after 20 s without an answer.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import socket
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import ClassVar

from starlette.types import ASGIApp, Message, Receive, Scope, Send
from websockets.protocol import State

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.messages import STREAM_BYTES
from vlagents_ray.serve.access.api_keys import Caller, Identity
from vlagents_ray.serve.access.charges import Charge
from vlagents_ray.serve.endpoints.client_socket import ClientSocket
from vlagents_ray.serve.endpoints.connection import (
    ANSWERS_S,
    INTERNAL_ERROR,
    SERVICE_RESTART,
    ConnectionOwner,
    enable_timestamps,
)
from vlagents_ray.serve.endpoints.message_connection import TRY_AGAIN_LATER
from vlagents_ray.serve.endpoints.shutdown import STOPPING, Shutdown
from vlagents_ray.serve.endpoints.websocket_connection import (
    MessageHandler,
    WebSocketConnection,
)
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.periodic import each_half_second
from vlagents_ray.serve.queue.poller import Poller

SCOPE_KEY = "vlagents_ray.websocket"  # key of the `AsgiWebSocket` in the ASGI scope
_WAITING_MESSAGES = 16  # maximum number of messages that the application has not received
_WAITING_BYTES = 4 * STREAM_BYTES  # maximum total size of those messages
# Number of bytes that a client has not read, above which the application may not send the next
# message, and the period at which this number is checked, s.
_UNSENT_BYTES = 2**16
_UNSENT_S = 0.01
_NORMAL = 1000  # close code
_POLL_S = 60.0  # maximum duration of one wait of the polling thread, s

MakeHandler = Callable[[WebSocketConnection], MessageHandler]


class AsgiWebSockets(ConnectionOwner["TakenConnection"]):
    """The WebSockets of one ASGI application.

    Args:
        admission: The in-flight memory of the replica; None without a replica.
        slow_s: Maximum time that a message may take to arrive, s.
        idle_s: Maximum time that a WebSocket may be silent, s.
        shutdown: The end of the replica.
    """

    name: ClassVar[str] = "websocket"

    def __init__(
        self,
        admission: Admission | None,
        slow_s: float,
        idle_s: float,
        shutdown: Shutdown,
    ) -> None:
        super().__init__(_own_poller())
        self.admission = admission
        self.slow_s = slow_s
        self.idle_s = idle_s
        self.shutdown = shutdown

    def serve(self, client: TakenConnection, connection: socket.socket) -> None:
        """Begin to read a client's connection; called on the polling thread."""
        super().serve(client, connection)
        if len(self._clients) == 1:
            self.open()

    def close(self) -> None:
        """End all connections; the polling thread, which continues, closes them."""
        clients = list(self._clients)
        for client in clients:
            client.end(STOPPING, SERVICE_RESTART)
        until = time.monotonic() + ANSWERS_S
        for client in clients:
            client.wait_answered(until)

    def remove(self, client: TakenConnection) -> None:
        """Remove a client whose connection is closed."""
        super().remove(client)
        if not self._clients:
            each_half_second.remove(self.close_overdue)


class TakenConnection(WebSocketConnection):
    """A WebSocket whose handshake uvicorn has answered."""

    def __init__(
        self,
        owner: AsgiWebSockets,
        connection: socket.socket,
        caller: Identity,
        on_end: Callable[[], None],
    ) -> None:
        """Create the connection of an accepted WebSocket; `on_end` is called when it has ended."""
        super().__init__(
            owner,
            connection,
            owner.admission,
            slow_s=owner.slow_s,
            idle_s=owner.idle_s,
            pings=True,
        )
        self.account.identify(caller)
        self._shutdown = owner.shutdown
        self._on_end = on_end
        self._protocol.state = State.OPEN

    def _end_sessions(self) -> None:
        super()._end_sessions()
        self._on_end()

    def overdue(
        self, now: float, refusal: Callable[[Caller], str | None]
    ) -> tuple[str, int] | None:
        """Return a reason and a close code, as in `WebSocketConnection`; when the replica stops,
        end the connection after its answers.
        """
        cause = super().overdue(now, refusal)
        if cause is None and self._shutdown.is_due(self.silent_s(now)):
            self.finish(STOPPING, SERVICE_RESTART)
        return cause


class AsgiWebSocket:
    """One WebSocket, for the application that serves it."""

    def __init__(
        self,
        owner: AsgiWebSockets,
        client: ClientSocket,
        caller: Identity,
        receive: Receive,
        send: Send,
    ) -> None:
        """Prepare to run an application; `receive` and `send` come from uvicorn."""
        self._owner = owner
        self._client = client
        self._caller = caller
        self._receive_first = receive
        self._send_first = send
        self._loop = asyncio.get_running_loop()
        self._task = asyncio.current_task()
        self._connection: TakenConnection | None = None  # None before the WebSocket is accepted
        self._messages: _AsgiMessages | None = None  # None if another handler receives the messages
        self._over = asyncio.Event()  # set when the connection has ended
        self._is_cancelled = False  # whether the application's task was cancelled
        self._has_left = False  # whether the client left before the WebSocket was accepted

    async def run(self, app: ASGIApp, scope: Scope) -> None:
        """Run the application until it returns or the WebSocket has to end."""
        code, reason = _NORMAL, ""
        try:
            await app({**scope, SCOPE_KEY: self}, self._receive, self._send)
        except asyncio.CancelledError:
            if not self._is_cancelled:
                raise
            uncancel(asyncio.current_task())
        except OSError:
            if not self._has_left:
                raise
        except BaseException:
            code, reason = INTERNAL_ERROR, "internal error"
            raise
        finally:
            self._task = None  # the end of the connection must not cancel the code after this line
            if self._messages is not None and self._messages.ending is not None:
                reason, code = self._messages.ending
            if self._connection is not None:
                self._connection.end(reason, code)

    def has_left(self) -> bool:
        """Return whether the client has closed the connection; may be called on any thread."""
        return self._connection is not None and self._connection.has_left()

    async def serve(self, make_handler: MakeHandler) -> None:
        """Accept the WebSocket, serve its messages with a handler, and wait for its end."""
        await self._receive_first()  # the "websocket.connect" message
        await self._accept({"type": "websocket.accept"}, make_handler)
        await self._over.wait()

    def _on_end(self) -> None:
        """Cancel the application, since the connection has ended; called on the polling thread."""
        self._client.ended()
        with contextlib.suppress(RuntimeError):  # the event loop is closed
            self._loop.call_soon_threadsafe(self._cancel)

    def _cancel(self) -> None:
        self._over.set()
        if self._messages is not None and self._task is not None:
            self._is_cancelled = True
            self._task.cancel()

    async def _accept(self, message: Message, make_handler: MakeHandler) -> None:
        """Accept the WebSocket, and take its connection from uvicorn.

        Raises:
            OSError: The client has closed the connection.
        """
        self._client.claim()
        await self._send_first(message)
        taken = await self._client.take()
        if taken is None:
            self._has_left = True
            raise OSError("the client has closed the connection")

        enable_timestamps(taken)
        connection = TakenConnection(self._owner, taken, self._caller, self._on_end)
        connection.accepted(make_handler(connection))
        self._connection = connection
        self._owner.poller.call_soon(partial(self._owner.serve, connection, taken))

    def _make_messages(self, connection: WebSocketConnection) -> MessageHandler:
        self._messages = _AsgiMessages(connection, self._loop)
        return self._messages

    async def _receive(self) -> Message:
        if self._messages is None:
            return await self._receive_first()
        return await self._messages.next()

    async def _send(self, message: Message) -> None:
        connection = self._connection
        if connection is None and message["type"] == "websocket.accept":
            await self._accept(message, self._make_messages)
        elif connection is None:  # the WebSocket is rejected
            await self._send_first(message)
        elif message["type"] == "websocket.close":
            connection.end(message.get("reason") or "", message.get("code", _NORMAL))
        else:
            # An application waits for a client that reads slowly.
            while connection.unsent_bytes > _UNSENT_BYTES and not self._over.is_set():
                await asyncio.sleep(_UNSENT_S)
            if self._over.is_set():
                raise OSError("the connection has ended")
            data = message.get("bytes")
            connection.send(message["text"] if data is None else data)


class _AsgiMessages(MessageHandler):
    """The messages that an application receives; its event loop receives them in order."""

    most_unanswered = _WAITING_MESSAGES
    most_unanswered_bytes = _WAITING_BYTES

    def __init__(self, connection: WebSocketConnection, loop: asyncio.AbstractEventLoop) -> None:
        self._connection = connection
        self._loop = loop
        # Pairs of a message and its size.
        self._queue: asyncio.Queue[tuple[Message, int]] = asyncio.Queue()
        self._waiting = _WaitingBytes(connection)
        self._current = -1  # size of the message that the application serves; -1 if there is none
        self._is_over = False  # whether the application has received the end
        # Reason and close code with which the connection ends when the application returns.
        self.ending: tuple[str, int] | None = None

    def begin(self) -> Charge | None:
        return None

    def receive(self, message: bytes | str, arrived: float, charge: Charge | None) -> None:
        size = len(message)
        self._connection.add_unanswered(size)
        if self._waiting.add(size):
            field = "text" if isinstance(message, str) else "bytes"
            self._put({"type": "websocket.receive", field: message}, size)

    def ended(self, code: int) -> None:
        self._waiting.release()
        self._put({"type": "websocket.disconnect", "code": code}, 0)

    def finish(self, reason: str, code: int) -> None:
        self.ending = reason, code
        self._put({"type": "websocket.disconnect", "code": code}, 0)

    async def next(self) -> Message:
        """Wait for the next message, and return it. The application has served the message before
        it.
        """
        if self._is_over:
            # Before Python 3.12, `asyncio.wait_for` drops a cancellation that coincides with the
            # awaited event, such as the message of a client whose key has just been revoked.
            raise asyncio.CancelledError
        if self._current >= 0:
            self._connection.remove_unanswered(self._current)
            self._current = -1

        message, size = await self._queue.get()
        if message["type"] == "websocket.disconnect":
            self._is_over = True
        else:
            self._waiting.remove(size)
            self._current = size
        return message

    def _put(self, message: Message, size: int) -> None:
        with contextlib.suppress(RuntimeError):  # the event loop is closed
            self._loop.call_soon_threadsafe(self._queue.put_nowait, (message, size))


class _WaitingBytes:
    """The bytes of the messages that wait for an application, as part of the in-flight memory.
    Thread-safe.
    """

    def __init__(self, connection: WebSocketConnection) -> None:
        self._connection = connection
        self._lock = threading.Lock()
        self._size = 0
        self._memory = connection.count_bytes()

    def add(self, size: int) -> bool:
        """Count `size` more bytes; end the connection and return False if there is no room."""
        with self._lock:
            self._size += size
            try:
                self._resize()
            except VLAgentsError as error:
                self._connection.end(str(error), TRY_AGAIN_LATER)
                return False
        return True

    def remove(self, size: int) -> None:
        """Count `size` bytes as no longer waiting."""
        with self._lock:
            self._size = max(0, self._size - size)
            self._resize()

    def release(self) -> None:
        """Count all bytes as no longer waiting."""
        with self._lock:
            self._size = 0
            self._resize()

    def _resize(self) -> None:
        if self._memory is not None:
            self._memory.resize(self._size)


def uncancel(task: asyncio.Task[object] | None) -> None:
    """Undo this server's cancellation of a task, after it was handled."""
    if task is not None and hasattr(task, "uncancel"):  # since Python 3.11
        task.uncancel()


@functools.cache
def _own_poller() -> Poller:
    """Return the poller that all applications of this process share. It runs on a
    separate thread.
    """
    poller = Poller()

    def poll() -> None:
        """Run the callbacks of the poller for as long as the process runs."""
        while True:
            poller.poll(_POLL_S)

    threading.Thread(target=poll, name="websockets", daemon=True).start()
    return poller
