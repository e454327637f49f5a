"""Requests of robots over HTTP that bypass Serve's own code.

For each request, Serve chooses a route, counts, logs, watches the client, and passes each message
to another thread and back. This takes half of the server's time for a request that the policy
answers immediately. `FrontMiddleware`, which runs before that code in the process of the replica,
therefore passes `POST /v1/reset`, `/v1/act` and `/v1/close` directly to the replica's application,
on the event loop of the HTTP server.

Everything that Serve's code provides is kept: the engine measures load and sessions; when a replica
stops, Serve's HTTP server waits for these requests as for all others; and this module adds the
request id and ends a request whose client has left.
"""

from __future__ import annotations

import asyncio
import uuid
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vlagents_ray.protocol.messages import OPS, REQUEST_ID_HEADER
from vlagents_ray.serve.endpoints.asgi_websocket import uncancel

_PATHS = frozenset(f"/v1/{op}" for op in OPS)
_REQUEST_ID = REQUEST_ID_HEADER.encode()


class DirectRequests:
    """The requests to one application that bypass Serve, once the application has received a
    request through Serve.

    Args:
        app: The application with its access control. It is called on two event loops: the HTTP
            server's event loop for these requests, and Serve's event loop for all others.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._prefix: str | None = None  # prefix of the application's paths; None until it is known

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request that came through Serve, and read the prefix of the
        application from it.
        """
        if scope["type"] == "http":
            self._prefix = scope.get("root_path", "")
        await self._app(scope, receive, send)

    def takes(self, scope: Scope) -> bool:
        """Return whether a request may bypass Serve."""
        if self._prefix is None or scope["method"] != "POST":
            return False
        path: str = scope["path"]
        return path.startswith(self._prefix) and path[len(self._prefix) :] in _PATHS

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve a request, and cancel it if its client leaves. The policy then does not receive the
        request, unless a batch already contains it.
        """
        request_id = dict(scope["headers"]).get(_REQUEST_ID, b"") or uuid.uuid4().hex.encode()
        headers = [pair for pair in scope["headers"] if pair[0] != _REQUEST_ID]
        headers.append((_REQUEST_ID, request_id))
        client = _Client(receive)

        async def send_with_id(message: Message) -> None:
            """Send a message; the response has the id of the request."""
            if message["type"] == "http.response.start":
                # After the response, uvicorn always reports a disconnection, even if the client is
                # still connected.
                client.stop_watching()
                message["headers"] = [*message.get("headers", ()), (_REQUEST_ID, request_id)]
            await send(message)

        inner = {**scope, "root_path": self._prefix, "headers": headers}
        try:
            await self._app(inner, client.receive, send_with_id)
        except asyncio.CancelledError:
            if not client.has_left:
                raise
            uncancel(client.task)
        finally:
            client.stop_watching()


class _Client:
    """The client of one request. If the client leaves after it has sent the whole request, the
    request's task is cancelled.
    """

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._watch: asyncio.Task[None] | None = None
        self.task = asyncio.current_task()
        self.has_left = False

    async def receive(self) -> Message:
        """Receive a part of the body; with the last one, begin to watch the client."""
        if self._watch is not None:
            await asyncio.shield(self._watch)
            return {"type": "http.disconnect"}
        message = await self._receive()
        if message["type"] == "http.request" and not message.get("more_body", False):
            self._watch = asyncio.get_running_loop().create_task(self._wait_for_its_end())
        return message

    def stop_watching(self) -> None:
        """Stop watching the client, because the request has been answered."""
        if self._watch is not None:
            self._watch.cancel()

    async def _wait_for_its_end(self) -> None:
        with suppress(asyncio.CancelledError):
            message = await self._receive()
            if message["type"] == "http.disconnect" and self.task is not None:
                self.has_left = True
                self.task.cancel()


_of_this_replica: DirectRequests | None = None


def of_this_replica() -> DirectRequests | None:
    """Return the direct requests of this process; None if the process is not a replica of this
    package.
    """
    return _of_this_replica


def set_for_this_replica(requests: DirectRequests | None) -> None:
    """Let requests to the replica of this process bypass Serve."""
    global _of_this_replica  # noqa: PLW0603 - Serve creates the middleware, without arguments
    _of_this_replica = requests
