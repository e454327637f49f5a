"""Middleware that a replica's server runs before Serve's own code, for each connection.

Serve loads it by `RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH`: see
`vlagents_ray.serve.launch.haproxy`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import time
from functools import partial
from typing import Any

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.protocol.messages import STREAM_BYTES
from vlagents_ray.serve.endpoints.http_messages import problem_response
from vlagents_ray.serve.endpoints.incoming_frames import SCOPE_KEY, IncomingFrames
from vlagents_ray.serve.token_bucket import TokenBucket

_MESSAGE_TOO_BIG = 1009  # WebSocket close code
# Maximum number of bytes that are discarded after a message that was too large.
_DRAINED_BYTES = 8 * STREAM_BYTES
_DRAINED_S = 5.0  # maximum time of discarding
# Maximum rate of discarding, of all connections together: above it, a client waits. At full speed,
# 32 connections take a quarter of a core.
_DRAINED_BYTES_PER_S = 64 * 2**20
_READ_BYTES = 2**18


def middlewares() -> list[Middleware]:
    """Return the middleware, for Serve."""
    return [Middleware(FrontMiddleware)]


class FrontMiddleware:
    """Refuses headers that are not UTF-8, which Serve decodes; limits the frames of WebSockets, see
    `IncomingFrames`.

    A client can read the reason for a close code, although it is still sending.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._draining: set[asyncio.Task[None]] = set()
        self._discarder = _Discarder()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection as specified by ASGI."""
        for name, value in scope.get("headers", ()):
            try:
                name.decode(), value.decode()
            except UnicodeDecodeError:
                if scope["type"] == "websocket":
                    await receive()  # the "websocket.connect" message
                refused = problem_response(
                    MalformedMessage(f"header {shown(name)}: want UTF-8"), ""
                )
                await refused(scope, receive, send)
                return

        if scope["type"] != "websocket":
            await self._app(scope, receive, send)
            return

        async def receive_and_drain() -> Message:
            """Receive a message; begin to discard bytes if the client's message was too large."""
            message = await receive()
            if (
                message["type"] == "websocket.disconnect"
                and message.get("code") == _MESSAGE_TOO_BIG
            ):
                self._drain(receive)
            return message

        async def send_and_open(message: Message) -> None:
            """Send a message; begin to read frames once the WebSocket is accepted."""
            await send(message)
            if frames is not None and message["type"] == "websocket.accept":
                frames.open()

        frames = IncomingFrames.attach(receive, partial(self._drain, receive))
        await self._app({**scope, SCOPE_KEY: frames}, receive_and_drain, send_and_open)

    def _drain(self, receive: Receive) -> None:
        """Discard incoming bytes, since closing a socket with unread bytes resets the connection.

        The reset would discard the close code on its way. uvicorn closes the socket after this
        callback; a duplicate keeps the connection open. ASGI does not expose the socket; uvicorn's
        bound method `receive` has its transport.
        """
        transport: Any = getattr(getattr(receive, "__self__", None), "transport", None)
        connection = None if transport is None else transport.get_extra_info("socket")
        if connection is None or connection.fileno() < 0:
            return

        duplicate = socket.socket(fileno=os.dup(connection.fileno()))
        task = asyncio.get_running_loop().create_task(self._discarder.discard(duplicate))
        self._draining.add(task)  # the loop holds only weak references to tasks
        task.add_done_callback(self._draining.discard)


class _Discarder:
    """Discards the incoming bytes of connections, which share one rate."""

    def __init__(self) -> None:
        self._rate = TokenBucket(_DRAINED_BYTES_PER_S, time.monotonic(), capacity=_READ_BYTES)
        self._turn = asyncio.Lock()  # a connection at a time waits for the rate, in order

    async def discard(self, connection: socket.socket) -> None:
        """Discard until the client has closed the connection, or a limit is reached; close it."""
        loop = asyncio.get_running_loop()
        deadline = time.monotonic() + _DRAINED_S
        bytes_left = _DRAINED_BYTES
        connection.setblocking(False)
        buffer = bytearray(_READ_BYTES)

        await asyncio.sleep(0)  # by then uvicorn has stopped reading, and has sent the close code
        with connection, contextlib.suppress(OSError, asyncio.TimeoutError):
            connection.shutdown(socket.SHUT_WR)
            while bytes_left > 0 and (wait_s := deadline - time.monotonic()) > 0:
                count = await asyncio.wait_for(loop.sock_recv_into(connection, buffer), wait_s)
                if not count:
                    return
                bytes_left -= count
                await self._wait_for_rate(count)

    async def _wait_for_rate(self, count: int) -> None:
        async with self._turn:
            while (wait_s := self._rate.take(time.monotonic(), count)) > 0:
                await asyncio.sleep(wait_s)
