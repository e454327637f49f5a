"""Access control of a replica's HTTP paths and WebSockets: API keys, time limits for slow clients,
and the end of connections.

The middleware wraps an ASGI application, so that all of its paths, including the dialects, are
protected in the same way. Some paths require no key: `/healthz` reports only whether the policy is
ready, or the step of loading that it has reached, and `public` ones are pages without data. A
WebSocket is refused before it is accepted.

When the client of a WebSocket leaves, the task that serves it is cancelled, as Serve cancels
requests over HTTP. None of the client's waiting requests is executed then. When the replica stops
(`Shutdown`), the messages that have arrived are answered before a WebSocket ends.
"""

from __future__ import annotations

import asyncio
import logging
import time
import uuid
from collections.abc import Awaitable, Callable, Collection
from contextlib import suppress

from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vlagents_ray.errors import MalformedMessage, PolicyUnavailable, Unauthorized, VLAgentsError
from vlagents_ray.protocol.messages import REQUEST_ID_HEADER
from vlagents_ray.serve.access.api_keys import Caller, Identity, Keys, NoKey, on_behalf_of, token_of
from vlagents_ray.serve.access.origin_check import require_own_page
from vlagents_ray.serve.endpoints.http_messages import (
    headers_of,
    problem_response,
    valid_request_id,
)
from vlagents_ray.serve.endpoints.incoming_frames import SCOPE_KEY, IncomingFrames
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.pauses import note_connection

logger = logging.getLogger(__name__)

_HEALTH = "/healthz"

_TICK_S = 0.5  # period at which a WebSocket's key and time limits are checked
_DROPPED_BYTES = 2**20  # a connection is closed after a refused request with a longer body
_GOING_AWAY, _POLICY_VIOLATION, _SERVICE_RESTART = 1001, 1008, 1012  # WebSocket close codes
_TIMEOUT = 408
_QUIET_S = 1.0  # time after which a silent connection ends when its replica stops
_STOPPING = "the replica is stopping; connect again"


class Shutdown:
    """The end of a replica, before which its WebSockets and incomplete uploads end; its methods are
    thread-safe.

    A WebSocket is a request for Serve, which ends a replica after its last request, and kills it
    after a time limit.
    """

    def __init__(self) -> None:
        self._begun = float("inf")  # time.monotonic(), s
        self._patience_s = 0.0

    def begin(self, patience_s: float = 0.0) -> None:
        """End the connections that are silent for a second, and after `patience_s` all of them."""
        self._begun, self._patience_s = time.monotonic(), patience_s

    def is_due(self, silent_s: float) -> bool:
        """Return whether a connection has to end whose client has been silent for `silent_s`."""
        stopping_s = time.monotonic() - self._begun
        return stopping_s >= self._patience_s or (stopping_s >= 0 and silent_s >= _QUIET_S)


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
            admission: The memory in flight of the replica, which also counts incomplete messages of
                WebSockets.
            shutdown: The end of the replica; by default it has none.
            public: The paths of pages without data, which need no key.
        """
        self._app = app
        self._keys = keys
        self._name = name

        self._slow_s = slow_s
        self._idle_s = idle_s
        self._hosts = hosts
        self._admission = admission
        self._shutdown = shutdown or Shutdown()
        self._public = frozenset({_HEALTH, *public})

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection as specified by ASGI."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return

        headers = headers_of(scope)
        if scope["type"] == "http":
            note_connection(scope)

        caller: Identity = NoKey.OPEN
        try:
            if _is_page(scope, self._public):
                pass
            elif self._keys is None:
                # A page that the robot's user opens can reach loopback.
                require_own_page(headers, self._hosts)
            else:
                key = caller = self._keys.check(token_of(headers), self._name)
                # The wait bounds how often the key's requests are refused.
                wait_s = key.throttled_s()
                if wait_s > 0:
                    await asyncio.sleep(wait_s)
                    key.require_unthrottled()
                if scope["type"] == "http":
                    key.admit()
                else:
                    key.hold()
                key.note("let in by", scope["type"])
        except VLAgentsError as error:
            request_id = valid_request_id(headers.get(REQUEST_ID_HEADER, ""))
            await _refuse(error, request_id, scope, receive, send)
            return

        with on_behalf_of(caller):
            if scope["type"] == "websocket":
                try:
                    await self._run_websocket(caller, scope, receive, send)
                finally:
                    if isinstance(caller, Caller):
                        caller.hold(-1)
            elif _has_body(scope):
                await _run_upload(self._app, scope, receive, send, self._slow_s, self._shutdown)
            else:
                await self._app(scope, receive, send)

    async def _run_websocket(
        self, caller: Identity, scope: Scope, receive: Receive, send: Send
    ) -> None:
        frames: IncomingFrames | None = scope.get(SCOPE_KEY)
        if frames is not None:
            frames.supervise(caller, self._admission)

        socket = _TimedWebSocket(
            caller, self._slow_s, self._idle_s, receive, send, frames, self._shutdown
        )
        await socket.run(self._app, scope)


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
    answer = problem_response(error, request_id)
    if isinstance(error, Unauthorized):
        answer.headers["www-authenticate"] = 'Bearer realm="vlagents_ray"'
    if scope["type"] == "http" and _has_body(scope, _DROPPED_BYTES):
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
                f"body: not here within {slow_s:g} s; is the connection that slow?"
            )
            refusal = problem_response(late, uuid.uuid4().hex, _TIMEOUT)
        elif shutdown.is_due(waited_s):
            refusal = problem_response(PolicyUnavailable(_STOPPING), uuid.uuid4().hex)
        else:
            timer = loop.call_later(min(_TICK_S, slow_s), check_time)
            return
        if task is not None:
            task.cancel()

    timer = loop.call_later(min(_TICK_S, slow_s), check_time)

    async def receive_in_time() -> Message:
        """Receive a message of the body; the last one ends the time limit."""
        _cancel_again(refusal is not None)
        message = await receive()
        if message["type"] == "http.disconnect" or not message.get("more_body", False):
            timer.cancel()
        return message

    async def answer(message: Message) -> None:
        """Send a message of the answer, which ends the time limit."""
        nonlocal answering
        timer.cancel()  # the rest of the body is no longer awaited
        answering = True
        await send(message)

    try:
        await app(scope, receive_in_time, answer)
    except asyncio.CancelledError:
        if refusal is None or answering:
            raise
        _uncancel(task)
        refusal.headers["connection"] = "close"
        await refusal(scope, receive, send)
    finally:
        timer.cancel()


class _TimedWebSocket:
    """A WebSocket that ends with its client and its replica, and if its key becomes invalid or its
    client is too slow.

    Messages are read ahead of the application, so that the end of the client is noticed while the
    application acts. `IncomingFrames` limits the number of messages that the application has not
    taken.
    """

    def __init__(
        self,
        caller: Identity,
        slow_s: float,
        idle_s: float,
        receive: Receive,
        send: Send,
        frames: IncomingFrames | None,
        shutdown: Shutdown,
    ) -> None:
        self._caller = caller
        self._slow_s = slow_s
        self._idle_s = idle_s
        self._receive = receive
        self._send = send
        self._frames = frames
        self._shutdown = shutdown
        self._loop = asyncio.get_running_loop()

        self._messages: asyncio.Queue[Message | Exception] = asyncio.Queue()  # read ahead
        # Start of the wait for the next message, s; None if there is no wait.
        self._silent_since: float | None = None
        # Start of the current sending, s; None if there is none.
        self._sending_since: float | None = None
        # Close code and reason, once the WebSocket has to end.
        self._end: tuple[int, str] | None = None
        self._is_cancelled = False  # whether the application's task was cancelled
        self._is_closed = False  # whether either side has closed the WebSocket

    async def run(self, app: ASGIApp, scope: Scope) -> None:
        """Run the application until it returns or the WebSocket has to end."""
        task = asyncio.current_task()

        def cancel() -> None:
            self._is_cancelled = True
            if task is not None:
                task.cancel()

        def tick() -> None:
            """End the WebSocket if that is due, and schedule the next check."""
            # The next check is scheduled first, so that an error below cannot stop the checks.
            self._timer = self._loop.call_later(_TICK_S, tick)
            cause = self._close_cause()
            if cause is not None:
                self._end = cause
                self._timer.cancel()
                cancel()
            elif self._end is None and self._shutdown.is_due(self._silent_s()):
                self._end = _SERVICE_RESTART, _STOPPING
                self._messages.put_nowait(
                    {"type": "websocket.disconnect", "code": _SERVICE_RESTART}
                )

        self._timer = self._loop.call_later(_TICK_S, tick)
        reading = self._loop.create_task(self._read_ahead(cancel))
        try:
            await app(scope, self._timed_receive, self._timed_send)
        except asyncio.CancelledError:
            if not self._is_cancelled:
                raise
            _uncancel(task)
        finally:
            self._timer.cancel()
            reading.cancel()

        if self._end is not None and not self._is_closed:
            await self._close(*self._end)

    async def _close(self, code: int, reason: str) -> None:
        logger.info("a WebSocket is closed: %s", reason)
        closing: Awaitable[None]
        if self._frames is not None and self._frames.arriving_s > 0:
            closing = self._frames.end(code, reason)
        else:
            closing = self._send({"type": "websocket.close", "code": code, "reason": reason[:120]})

        # These errors mean that the client does not read, or has closed the connection.
        with suppress(asyncio.TimeoutError, RuntimeError):
            await asyncio.wait_for(closing, _TICK_S)

    async def _read_ahead(self, client_left: Callable[[], None]) -> None:
        while True:
            try:
                message = await self._receive()
            except Exception as error:  # noqa: BLE001 - raised where the application receives
                self._messages.put_nowait(error)
                return
            self._messages.put_nowait(message)
            if message["type"] == "websocket.disconnect":
                if not self._is_closed:
                    self._is_closed = True
                    client_left()
                return

    async def _timed_receive(self) -> Message:
        _cancel_again(self._is_cancelled)
        self._silent_since = self._loop.time()
        message = await self._messages.get()
        self._silent_since = None

        if isinstance(message, Exception):
            raise message
        if self._frames is not None and message["type"] == "websocket.receive":
            self._frames.taken()
        return message

    async def _timed_send(self, message: Message) -> None:
        self._is_closed = self._is_closed or message["type"] == "websocket.close"
        self._sending_since = self._loop.time()
        await self._send(message)
        self._sending_since = None

    def _silent_s(self) -> float:
        """Return for how long the application has waited for a message, s; 0 while it acts."""
        return 0.0 if self._silent_since is None else self._loop.time() - self._silent_since

    def _close_cause(self) -> tuple[int, str] | None:
        """Return the close code and the reason if the WebSocket has to end at once."""
        if (
            self._sending_since is not None
            and self._loop.time() - self._sending_since > self._slow_s
        ):
            return _POLICY_VIOLATION, "replies are not taken"
        if self._frames is not None and self._frames.arriving_s > self._slow_s:
            return _POLICY_VIOLATION, f"a message took longer than {self._slow_s:g} s"
        if self._silent_s() > self._idle_s:
            return _GOING_AWAY, "silent for too long"
        refusal = self._caller.refusal() if isinstance(self._caller, Caller) else None
        return None if refusal is None else (_POLICY_VIOLATION, refusal)


def _cancel_again(over: bool) -> None:
    """Cancel the receiver again if it missed its cancellation.

    Before Python 3.12, `asyncio.wait_for` drops a cancellation that coincides with the awaited
    event, such as the message of a client whose key has just been revoked.
    """
    if over:
        raise asyncio.CancelledError


def _uncancel(task: asyncio.Task[object] | None) -> None:
    """Undo this module's cancellation of the task, after it was handled."""
    if task is not None and hasattr(task, "uncancel"):  # since Python 3.11
        task.uncancel()
