"""Middleware that a replica's server runs before Serve's own code, for each connection.

The variable `RAY_SERVE_HTTP_PROXY_CALLBACK_IMPORT_PATH` makes Serve load it: see
`vlagents_ray.serve.launch.haproxy`.
"""

from __future__ import annotations

from starlette.middleware import Middleware
from starlette.types import ASGIApp, Receive, Scope, Send

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.serve.endpoints.client_socket import HTTP_KEY, SCOPE_KEY, ClientSocket, HttpClient
from vlagents_ray.serve.endpoints.direct_requests import of_this_replica
from vlagents_ray.serve.endpoints.http_messages import problem_response


def middlewares() -> list[Middleware]:
    """Return the middleware, for Serve."""
    return [Middleware(FrontMiddleware)]


class FrontMiddleware:
    """Rejects headers that are not UTF-8, which Serve decodes.

    Lets requests of robots bypass Serve (see `DirectRequests`). Lets the application take the
    socket of a WebSocket (see `ClientSocket`), or check whether the client of a request has left
    (see `HttpClient`).
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection as specified by ASGI."""
        for name, value in scope.get("headers", ()):
            try:
                name.decode(), value.decode()
            except UnicodeDecodeError:
                if scope["type"] == "websocket":
                    await receive()  # the "websocket.connect" message
                refused = problem_response(
                    MalformedMessage(f"header {shown(name)}: expected UTF-8, got other bytes"), ""
                )
                await refused(scope, receive, send)
                return

        if scope["type"] == "websocket":
            client = ClientSocket.below(receive)
            if client is not None:
                await self._app({**scope, SCOPE_KEY: client}, client.receive, client.sending(send))
                return
        elif scope["type"] == "http":
            scope = {**scope, HTTP_KEY: HttpClient.below(receive)}
            direct = of_this_replica()
            if direct is not None and direct.takes(scope):
                await direct.serve(scope, receive, send)
                return
        await self._app(scope, receive, send)
