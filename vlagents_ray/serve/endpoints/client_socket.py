"""The connection below a request or a WebSocket of uvicorn.

ASGI exposes no connection; the protocol and the transport are attributes of uvicorn's bound method
`receive`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from collections.abc import Iterator
from contextvars import ContextVar
from typing import Any

from starlette.types import Message, Receive, Send

from vlagents_ray.serve.endpoints.connection import has_hung_up
from vlagents_ray.serve.requests import HasLeft

SCOPE_KEY = "vlagents_ray.client_socket"  # key of the `ClientSocket` in the ASGI scope
HTTP_KEY = "vlagents_ray.http_client"  # key of the `HttpClient` in the ASGI scope
_EXTENSIONS = "Sec-WebSocket-Extensions"

_current: ContextVar[HasLeft | None] = ContextVar("vlagents_ray_client", default=None)


def current_client() -> HasLeft | None:
    """Return a function that returns whether the client of the current request or WebSocket has
    left; None if another process reads the connection.
    """
    return _current.get()


@contextlib.contextmanager
def connected_by(has_left: HasLeft | None) -> Iterator[None]:
    """Set the result of `current_client` within this context."""
    token = _current.set(has_left)
    try:
        yield
    finally:
        _current.reset(token)


class HttpClient:
    """The connection of a request, which uvicorn reads on its event loop."""

    def __init__(self, transport: Any) -> None:
        self._transport = transport
        self._connection: socket.socket = transport.get_extra_info("socket")

    @classmethod
    def below(cls, receive: Receive) -> HttpClient | None:
        """Return the client of the request with this `receive`; None if it does not come from
        uvicorn.
        """
        transport = getattr(getattr(receive, "__self__", None), "transport", None)
        if transport is None or transport.get_extra_info("socket") is None:
            return None
        return cls(transport)

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Pickle as None: Serve's own proxy sends the scope to another process."""
        return type(None), ()

    def has_left(self) -> bool:
        """Return whether the client has closed the connection; may be called on any thread."""
        return bool(self._transport.is_closing()) or has_hung_up(self._connection)


class ClientSocket:
    """The socket of one WebSocket, whose handshake uvicorn has received.

    uvicorn reads nothing after the handshake until the WebSocket is accepted. If it is claimed by
    then, uvicorn reads nothing at all; it considers the connection open until `ended`.
    """

    def __init__(self, receive: Receive, protocol: Any) -> None:
        """Stop reading; called on uvicorn's event loop."""
        self._receive = receive
        self._transport = protocol.transport
        self._loop = asyncio.get_running_loop()
        self._is_claimed = False
        self._accepted = asyncio.Event()  # set when uvicorn has answered the handshake
        self._end = asyncio.Event()

        # Compressed messages would be inflated before any limit applies.
        protocol.conn.extensions = []
        if _EXTENSIONS in protocol.response.headers:
            del protocol.response.headers[_EXTENSIONS]
        self._transport.pause_reading()

    @classmethod
    def below(cls, receive: Receive) -> ClientSocket | None:
        """Return the socket of the WebSocket with this `receive`; None if it does not come from
        uvicorn.
        """
        protocol: Any = getattr(receive, "__self__", None)
        transport = getattr(protocol, "transport", None)
        if transport is None or transport.is_closing():
            return None
        return cls(receive, protocol)

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        """Pickle as None: Serve's own proxy sends the scope to another process."""
        return type(None), ()

    def claim(self) -> None:
        """Announce `take`, before the WebSocket is accepted; may be called on any thread."""
        self._is_claimed = True

    async def take(self) -> socket.socket | None:
        """Take the socket of the accepted WebSocket from uvicorn; may be called on any event loop.

        Returns:
            The non-blocking socket; None if the client has closed the connection.
        """
        taking = asyncio.run_coroutine_threadsafe(self._take(), self._loop)
        return await asyncio.wrap_future(taking)

    async def _take(self) -> socket.socket | None:
        # Serve forwards the application's messages on another thread.
        await self._accepted.wait()
        connection = self._transport.get_extra_info("socket")
        if self._transport.is_closing() or connection is None or connection.fileno() < 0:
            self._end.set()
            return None
        while self._transport.get_write_buffer_size():  # the answer to the handshake
            await asyncio.sleep(0.001)
        taken = socket.socket(fileno=os.dup(connection.fileno()))
        taken.setblocking(False)
        # Closing this socket keeps the connection open, since it was duplicated.
        self._transport.abort()
        return taken

    def ended(self) -> None:
        """Let uvicorn and Serve know that the connection has ended; may be called on any thread."""
        with contextlib.suppress(RuntimeError):  # the event loop is closed
            self._loop.call_soon_threadsafe(self._end.set)

    async def receive(self) -> Message:
        """Receive a message like uvicorn's `receive`; after `take`, receive only the end of the
        connection.

        uvicorn reports an end when the socket is taken.
        """
        message = await self._receive()
        if self._is_claimed and message["type"] == "websocket.disconnect":
            await self._end.wait()
        return message

    def sending(self, send: Send) -> Send:
        """Return a `send` after which uvicorn reads an accepted WebSocket that is not claimed."""

        async def send_and_read(message: Message) -> None:
            """Send a message as uvicorn's `send` does."""
            is_accepted = message["type"] == "websocket.accept"
            try:
                await send(message)
            finally:
                if is_accepted:  # also if the client has left: `take` then finds no connection
                    self._accepted.set()
            if is_accepted and not self._is_claimed and not self._transport.is_closing():
                self._transport.resume_reading()

        return send_and_read
