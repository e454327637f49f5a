"""The guard before a replica's HTTP paths and WebSockets: keys, and patience with slow clients.

An ASGI application around another one, so that whatever is behind it, every dialect too, is guarded alike.
`/healthz` alone asks for no key; it tells nothing but ready or not. A WebSocket is refused before it is accepted.
"""

from __future__ import annotations

import asyncio
import logging
import uuid
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vlagents_ray.errors import MalformedMessage, TooManyRequests, Unauthorized, VLAgentsError
from vlagents_ray.serve.auth import Caller, Keys, on_behalf_of, token_of
from vlagents_ray.serve.origin import require_own_page
from vlagents_ray.serve.problems import problem_response
from vlagents_ray.wire.messages import REQUEST_ID_HEADER

logger = logging.getLogger(__name__)

_TICK_S = 1.0  # how often a WebSocket's key and patience are looked at
_GOING_AWAY, _POLICY_VIOLATION = 1001, 1008  # WebSocket close codes
_TIMEOUT = 408


class Guard:
    """Lets in whoever has a key, or everybody if there are none; cuts off who keeps the server waiting."""

    def __init__(
        self, app: ASGIApp, keys: Keys | None, name: str, *, slow_s: float = 30.0, idle_s: float = 600.0
    ) -> None:
        """`name` is that of the Serve application.

        `slow_s` is how long a request may take to arrive, or a WebSocket's message to be taken by its client;
        `idle_s` how long a WebSocket may be silent.
        """
        self._app = app
        self._keys = keys
        self._name = name
        self._slow_s = slow_s
        self._idle_s = idle_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """As ASGI has it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        caller: Caller | None = None
        try:
            if self._keys is None:
                require_own_page(headers)  # on loopback, which any page that the robot's user opens reaches
            elif not _asks_for_health(scope):
                caller = self._keys.check(token_of(headers), self._name)
                if scope["type"] == "http":
                    caller.admit()
        except VLAgentsError as error:
            await _refuse(error, headers.get(REQUEST_ID_HEADER) or uuid.uuid4().hex, scope, receive, send)
            return
        with on_behalf_of(caller):
            if scope["type"] == "websocket":
                await _Watched(caller, self._slow_s, self._idle_s, receive, send).run(self._app, scope)
            elif headers.get("content-length", "0") != "0" or "transfer-encoding" in headers:
                await _Upload(self._slow_s, send).run(self._app, scope, receive)
            else:
                await self._app(scope, receive, send)


def _asks_for_health(scope: Scope) -> bool:
    path: str = scope["path"]
    root: str = scope.get("root_path", "")
    return scope["type"] == "http" and scope["method"] in ("GET", "HEAD") and path in ("/healthz", f"{root}/healthz")


async def _refuse(error: VLAgentsError, request_id: str, scope: Scope, receive: Receive, send: Send) -> None:
    answer = problem_response(error, request_id)
    if isinstance(error, Unauthorized):
        answer.headers["www-authenticate"] = 'Bearer realm="vlagents_ray"'
    if isinstance(error, TooManyRequests):
        answer.headers["retry-after"] = str(max(1, round(error.retry_after_s)))
    if scope["type"] == "websocket":
        await receive()  # its "connect"
        if "websocket.http.response" not in scope.get("extensions", {}):
            await send({"type": "websocket.close", "code": _POLICY_VIOLATION})  # before accepting: HTTP 403
            return
    await answer(scope, receive, send)


class _Upload:
    """An HTTP request whose body has to be here in time."""

    def __init__(self, slow_s: float, send: Send) -> None:
        self._slow_s = slow_s
        self._send = send
        self._late = False
        self._answering = False

    async def run(self, app: ASGIApp, scope: Scope, receive: Receive) -> None:
        task = asyncio.current_task()

        def cut() -> None:
            self._late = True
            if task is not None:
                task.cancel()

        timer = asyncio.get_running_loop().call_later(self._slow_s, cut)

        async def timed() -> Message:
            message = await receive()
            if message["type"] == "http.disconnect" or not message.get("more_body", False):
                timer.cancel()
            return message

        async def answer(message: Message) -> None:
            timer.cancel()  # whatever is left of the body is not waited for
            self._answering = True
            await self._send(message)

        try:
            await app(scope, timed, answer)
        except asyncio.CancelledError:
            if not self._late or self._answering:
                raise
            _uncancel(task)
            late = MalformedMessage(f"body: not here within {self._slow_s:g} s; is the connection that slow?")
            response = problem_response(late, uuid.uuid4().hex, _TIMEOUT)
            response.headers["connection"] = "close"
            await response(scope, receive, self._send)
        finally:
            timer.cancel()


class _Watched:
    """A WebSocket as long as it lasts. It ends when its key does, and when its client is silent or does not listen."""

    def __init__(self, caller: Caller | None, slow_s: float, idle_s: float, receive: Receive, send: Send) -> None:
        self._caller = caller
        self._slow_s = slow_s
        self._idle_s = idle_s
        self._receive = receive
        self._send = send
        self._loop = asyncio.get_running_loop()
        self._silent_since: float | None = None  # while its next message is waited for
        self._sending_since: float | None = None  # while it is to take a message
        self._end: tuple[int, str] | None = None  # close code and reason, once it is to end

    async def run(self, app: ASGIApp, scope: Scope) -> None:
        task = asyncio.current_task()

        def tick() -> None:
            self._end = self._verdict()
            if self._end is None:
                self._timer = self._loop.call_later(_TICK_S, tick)
            elif task is not None:
                task.cancel()

        self._timer = self._loop.call_later(_TICK_S, tick)
        try:
            await app(scope, self._listen, self._say)
        except asyncio.CancelledError:
            if self._end is None:
                raise
            _uncancel(task)
            await self._hang_up(*self._end)
        finally:
            self._timer.cancel()

    async def _listen(self) -> Message:
        self._silent_since = self._loop.time()
        message = await self._receive()
        self._silent_since = None
        return message

    async def _say(self, message: Message) -> None:
        self._sending_since = self._loop.time()
        await self._send(message)
        self._sending_since = None

    def _verdict(self) -> tuple[int, str] | None:
        now = self._loop.time()
        if self._sending_since is not None and now - self._sending_since > self._slow_s:
            return _POLICY_VIOLATION, "replies are not taken"
        if self._silent_since is not None and now - self._silent_since > self._idle_s:
            return _GOING_AWAY, "silent for too long"
        try:
            if self._caller is not None:
                self._caller.admit(free=True)
        except VLAgentsError as error:
            return _POLICY_VIOLATION, str(error)
        return None

    async def _hang_up(self, code: int, reason: str) -> None:
        logger.info("a WebSocket is closed: %s", reason)
        with suppress(asyncio.TimeoutError, RuntimeError):  # it does not listen, or has been closed meanwhile
            closing = self._send({"type": "websocket.close", "code": code, "reason": reason[:120]})
            await asyncio.wait_for(closing, _TICK_S)


def _uncancel(task: asyncio.Task[object] | None) -> None:
    """The cancellation was ours, and is over."""
    if task is not None and hasattr(task, "uncancel"):  # since Python 3.11
        task.uncancel()
