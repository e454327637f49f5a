"""Access control of a replica's HTTP paths and WebSockets: API keys, time limits for slow clients,
and the end of connections.

The middleware wraps an ASGI application, so that all of its paths, including the dialects, are
protected in the same way. Some paths require no key: `/healthz` reports only whether the policy is
ready, or the step of loading that it has reached, and the `public` paths are pages without data. A
WebSocket is rejected before it is accepted.

When the client of a WebSocket leaves, the task that serves the WebSocket is cancelled, just as
Serve cancels requests over HTTP. None of the client's waiting requests is executed then. When the
replica stops (`Shutdown`), the messages that have arrived are answered before a WebSocket ends.
Both are done by `vlagents_ray.serve.endpoints.asgi_websocket`.
"""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import Collection, Mapping

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vlagents_ray.errors import (
    Forbidden,
    MalformedMessage,
    PolicyUnavailable,
    Unauthorized,
    VLAgentsError,
)
from vlagents_ray.protocol.messages import REQUEST_ID_HEADER
from vlagents_ray.serve.access.api_keys import Caller, Identity, Keys, NoKey, on_behalf_of, token_of
from vlagents_ray.serve.access.charges import Account, charged
from vlagents_ray.serve.access.origin_check import require_own_page
from vlagents_ray.serve.endpoints.asgi_websocket import (
    AsgiWebSocket,
    AsgiWebSockets,
    uncancel,
)
from vlagents_ray.serve.endpoints.client_socket import (
    HTTP_KEY,
    SCOPE_KEY,
    ClientSocket,
    HttpClient,
    connected_by,
)
from vlagents_ray.serve.endpoints.forwarded_websocket import ForwardedWebSocket, cancel_again
from vlagents_ray.serve.endpoints.http_messages import (
    DROPPED_BYTES,
    REFUSAL_S,
    headers_of,
    problem_response,
    valid_request_id,
)
from vlagents_ray.serve.endpoints.shutdown import STOPPING, Shutdown
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.pauses import note_connection
from vlagents_ray.serve.token_bucket import TokenBucket

logger = logging.getLogger(__name__)

_HEALTH = "/healthz"

# Rate of requests to the paths without a key, requests/s. Above it, the answer to each request is
# delayed like a rejection, since it costs as much.
_OPEN_PER_S = 20.0
_TICK_S = 0.5  # period at which the time limit of an upload is checked
_POLICY_VIOLATION = 1008  # WebSocket close code
_TIMEOUT = 408


class AccessMiddleware:
    """Accepts requests with a valid key, or all requests if the server has no keys; cuts off
    slow clients.
    """

    def __init__(
        self,
        app: ASGIApp,
        keys: Keys | None,
        name: str,
        *,
        slow_s: float = 30.0,
        idle_s: float = 600.0,
        hosts: Collection[str] = (),
        admission: Admission | None = None,
        shutdown: Shutdown | None = None,
        public: Collection[str] = (),
    ) -> None:
        """Protect `app`.

        Args:
            keys: The server's keys; None if it has none.
            name: The name of the application, for which a key must be valid.
            slow_s: Maximum time that a request may take to arrive, or a WebSocket's client to
                accept a message, s.
            idle_s: Maximum time that a WebSocket may be silent, s.
            hosts: Further host names of the server, see `require_own_page`.
            admission: The in-flight memory of the replica, which also counts incomplete messages of
                WebSockets.
            shutdown: The end of the replica; by default, the replica has no end.
            public: The paths of pages without data, which need no key.
        """
        self._app = app
        self._keys = keys
        self._name = name

        self._slow_s = slow_s
        self._hosts = hosts
        self._idle_s = idle_s
        self._shutdown = shutdown or Shutdown()
        self.websockets = AsgiWebSockets(admission, slow_s, idle_s, self._shutdown)
        self._public = frozenset({_HEALTH, *public})
        self._open_requests = TokenBucket(_OPEN_PER_S, time.monotonic())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection as specified by ASGI."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        headers = headers_of(scope)
        if scope["type"] == "http":
            note_connection(scope)

        try:
            caller = await self._identify(scope, headers)
            # A request is charged, and possibly rejected, before its body is read.
            charge = Account(caller).charge() if scope["type"] == "http" else None
            if charge is not None:
                charge.require()
        except VLAgentsError as error:
            request_id = valid_request_id(headers.get(REQUEST_ID_HEADER, ""))
            await _refuse(error, request_id, scope, receive, send)
            return
        if isinstance(caller, Caller):
            caller.note("let in by", scope["type"])

        with on_behalf_of(caller):
            if charge is None:
                try:
                    await self._run_websocket(caller, scope, receive, send)
                finally:
                    if isinstance(caller, Caller):
                        caller.hold(-1)
                return

            http_client: HttpClient | None = scope.get(HTTP_KEY) or HttpClient.below(receive)
            has_left = None if http_client is None else http_client.has_left
            with charged(charge), connected_by(has_left):
                if _has_body(scope):
                    await _run_upload(self._app, scope, receive, send, self._slow_s, self._shutdown)
                else:
                    await self._app(scope, receive, send)

    async def _identify(self, scope: Scope, headers: Mapping[str, str]) -> Identity:
        """Return the caller of a request or a WebSocket, which counts as a connection of its key.

        Raises:
            Unauthorized: The key is missing, unknown, revoked or expired.
            Forbidden: The key is for other applications, or the page is another site's.
            TooManyRequests: The key is over its rate, or has too many connections.
        """
        if _is_page(scope, self._public):
            if self._keys is not None and self._open_requests.take(time.monotonic()) > 0:
                await asyncio.sleep(REFUSAL_S)
            return NoKey.OPEN
        if self._keys is None:
            # A web page that the robot's user opens can send requests to loopback.
            require_own_page(headers, self._hosts)
            return NoKey.OPEN

        caller = self._keys.check(token_of(headers), self._name)
        # The wait bounds how often the key's requests are rejected.
        wait_s = caller.throttled_s()
        if wait_s > 0:
            await asyncio.sleep(wait_s)
            caller.require_unthrottled()
        if scope["type"] == "websocket":
            caller.hold()
        return caller

    async def _run_websocket(
        self, caller: Identity, scope: Scope, receive: Receive, send: Send
    ) -> None:
        client: ClientSocket | None = scope.get(SCOPE_KEY)
        if client is None:  # a server without the `FrontMiddleware`
            client = ClientSocket.below(receive)
            if client is not None:
                receive, send = client.receive, client.sending(send)
        if client is not None:
            websocket = AsgiWebSocket(self.websockets, client, caller, receive, send)
            with connected_by(websocket.has_left):
                await websocket.run(self._app, scope)
        else:
            forwarded = ForwardedWebSocket(
                caller, self._slow_s, self._idle_s, receive, send, self._shutdown
            )
            await forwarded.run(self._app, scope)


def _is_page(scope: Scope, public: Collection[str]) -> bool:
    """Return whether a request reads one of the `public` paths."""
    path: str = scope["path"]
    path = path.removeprefix(scope.get("root_path", ""))
    return scope["type"] == "http" and scope["method"] in ("GET", "HEAD") and path in public


def _has_body(scope: Scope, max_bytes: int = 0) -> bool:
    """Return whether a body of more than `max_bytes`, or of unknown length, follows the headers."""
    headers = headers_of(scope)
    length = headers.get("content-length", "0")
    return "transfer-encoding" in headers or not length.isdecimal() or int(length) > max_bytes


async def _refuse(
    error: VLAgentsError, request_id: str, scope: Scope, receive: Receive, send: Send
) -> None:
    if isinstance(error, (Unauthorized, Forbidden)):
        await asyncio.sleep(REFUSAL_S)

    answer = problem_response(error, request_id)
    if isinstance(error, Unauthorized):
        answer.headers["www-authenticate"] = 'Bearer realm="vlagents_ray"'
    if scope["type"] == "http" and _has_body(scope, DROPPED_BYTES):
        answer.headers["connection"] = "close"  # the body is not read, not even to discard it

    if scope["type"] == "websocket":
        await receive()  # the "websocket.connect" message
        if "websocket.http.response" not in scope.get("extensions", {}):
            # Before acceptance, a close message means HTTP 403.
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION})
            return

    await answer(scope, receive, send)


async def _run_upload(
    app: ASGIApp, scope: Scope, receive: Receive, send: Send, slow_s: float, shutdown: Shutdown
) -> None:
    """Serve an HTTP request whose body must arrive within `slow_s`, and before the replica
    stops.
    """
    task = asyncio.current_task()
    loop = asyncio.get_running_loop()
    begun = loop.time()
    refusal: Response | None = None
    timer: asyncio.TimerHandle
    answering = False

    def check_time() -> None:
        """Cancel the application if the body is late or the replica stops; otherwise check
        again later.
        """
        nonlocal refusal, timer
        waited_s = loop.time() - begun
        if waited_s > slow_s:
            late = MalformedMessage(
                f"body: did not arrive within {slow_s:g} s; is the connection that slow?"
            )
            refusal = problem_response(late, uuid.uuid4().hex, _TIMEOUT)
        elif shutdown.is_due(waited_s):
            refusal = problem_response(PolicyUnavailable(STOPPING), uuid.uuid4().hex)
        else:
            timer = loop.call_later(min(_TICK_S, slow_s), check_time)
            return
        if task is not None:
            task.cancel()

    timer = loop.call_later(min(_TICK_S, slow_s), check_time)

    async def receive_in_time() -> Message:
        """Receive a message of the body; the last message ends the time limit."""
        cancel_again(refusal is not None)
        message = await receive()
        if message["type"] == "http.disconnect" or not message.get("more_body", False):
            timer.cancel()
        return message

    async def answer(message: Message) -> None:
        """Send a message of the answer, which ends the time limit."""
        nonlocal answering
        timer.cancel()  # the remaining body is no longer awaited
        answering = True
        await send(message)

    try:
        await app(scope, receive_in_time, answer)
    except asyncio.CancelledError:
        if refusal is None or answering:
            raise
        uncancel(task)
        refusal.headers["connection"] = "close"
        await refusal(scope, receive, send)
    finally:
        timer.cancel()
