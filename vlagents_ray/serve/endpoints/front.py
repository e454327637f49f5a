"""Middleware before Serve's own code, which a replica's server runs for each connection.

Serve loads it by `RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH`: see `vlagents_ray.serve.launch.haproxy`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import time
from typing import Any

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.protocol.messages import STREAM_BYTES
from vlagents_ray.serve.endpoints.http_messages import problem_response

_MESSAGE_TOO_BIG = 1009  # WebSocket close code
_DRAINED_BYTES = 8 * STREAM_BYTES  # most bytes that are discarded after a message that was too large
_DRAINED_S = 5.0  # and the most time


def middlewares() -> list[Middleware]:
    """Return the middleware, for Serve."""
    return [Middleware(FrontMiddleware)]


class FrontMiddleware:
    """Refuses headers that are not UTF-8, which Serve decodes, and lets clients read why a message was too large."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._draining: set[asyncio.Task[None]] = set()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection as specified by ASGI."""
        for name, value in scope.get("headers", ()):
            try:
                name.decode(), value.decode()
            except UnicodeDecodeError:
                await _refuse(MalformedMessage(f"header {shown(name)}: want UTF-8"), scope, receive, send)
                return
        if scope["type"] != "websocket":
            await self._app(scope, receive, send)
            return

        async def received() -> Message:
            message = await receive()
            if message["type"] == "websocket.disconnect" and message.get("code") == _MESSAGE_TOO_BIG:
                self._drain(receive)
            return message

        await self._app(scope, received, send)

    def _drain(self, receive: Receive) -> None:
        """Discard what the client still sends: a socket that is closed with unread bytes resets the connection.

        The reset discards the close code on its way. uvicorn closes the socket after this callback; a duplicate keeps
        the connection open. ASGI does not name the socket, of which uvicorn's bound method `receive` has the transport.
        """
        transport: Any = getattr(getattr(receive, "__self__", None), "transport", None)
        connection = None if transport is None else transport.get_extra_info("socket")
        if connection is None or connection.fileno() < 0:
            return
        duplicate = socket.socket(fileno=os.dup(connection.fileno()))
        task = asyncio.get_running_loop().create_task(_discard(duplicate))
        self._draining.add(task)  # the loop holds only weak references
        task.add_done_callback(self._draining.discard)


async def _discard(connection: socket.socket) -> None:
    loop, end, left = asyncio.get_running_loop(), time.monotonic() + _DRAINED_S, _DRAINED_BYTES
    connection.setblocking(False)
    buffer = bytearray(2**18)
    await asyncio.sleep(0)  # uvicorn has stopped to read the socket, and has sent the close code
    with connection, contextlib.suppress(OSError, asyncio.TimeoutError):
        connection.shutdown(socket.SHUT_WR)
        while left > 0 and (wait_s := end - time.monotonic()) > 0:
            count = await asyncio.wait_for(loop.sock_recv_into(connection, buffer), wait_s)
            if not count:
                return
            left -= count


async def _refuse(error: MalformedMessage, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        await receive()  # the "websocket.connect" message
    await problem_response(error, "")(scope, receive, send)
