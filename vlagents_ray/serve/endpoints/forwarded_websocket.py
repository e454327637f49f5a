"""WebSockets whose messages another process forwards, so that this process has no socket of the
client. This is the case behind Serve's own proxy, which a cluster uses without HAProxy. The proxy
receives whole messages of at most 16 MiB; here a WebSocket ends if its client is silent or reads
too slowly, if its key becomes invalid, and with its replica.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from contextlib import suppress

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from vlagents_ray.serve.access.api_keys import Caller, Identity
from vlagents_ray.serve.endpoints.asgi_websocket import uncancel
from vlagents_ray.serve.endpoints.shutdown import STOPPING, Shutdown

logger = logging.getLogger(__name__)

_TICK_S = 0.5  # period at which the key and the time limits are checked
_GOING_AWAY, _POLICY_VIOLATION, _SERVICE_RESTART = 1001, 1008, 1012  # WebSocket close codes


class ForwardedWebSocket:
    """A WebSocket that ends with its client and its replica, and if its key becomes invalid or its
    client is too slow.

    Messages are read before the application requests them, so that the end of the client is noticed
    while the application works.
    """

    def __init__(
        self,
        caller: Identity,
        slow_s: float,
        idle_s: float,
        receive: Receive,
        send: Send,
        shutdown: Shutdown,
    ) -> None:
        self._caller = caller
        self._slow_s = slow_s
        self._idle_s = idle_s
        self._receive = receive
        self._send = send
        self._shutdown = shutdown
        self._loop = asyncio.get_running_loop()

        # Messages that the application has not received yet.
        self._messages: asyncio.Queue[Message | Exception] = asyncio.Queue()
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
                self._end = _SERVICE_RESTART, STOPPING
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
            uncancel(task)
        finally:
            self._timer.cancel()
            reading.cancel()

        if self._end is not None and not self._is_closed:
            await self._close(*self._end)

    async def _close(self, code: int, reason: str) -> None:
        logger.info("a WebSocket is closed: %s", reason)
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
        cancel_again(self._is_cancelled)
        self._silent_since = self._loop.time()
        message = await self._messages.get()
        self._silent_since = None

        if isinstance(message, Exception):
            raise message
        return message

    async def _timed_send(self, message: Message) -> None:
        self._is_closed = self._is_closed or message["type"] == "websocket.close"
        self._sending_since = self._loop.time()
        await self._send(message)
        self._sending_since = None

    def _silent_s(self) -> float:
        """Return how long the application has waited for a message, s; 0 while it acts."""
        return 0.0 if self._silent_since is None else self._loop.time() - self._silent_since

    def _close_cause(self) -> tuple[int, str] | None:
        """Return the close code and the reason if the WebSocket has to end immediately."""
        if (
            self._sending_since is not None
            and self._loop.time() - self._sending_since > self._slow_s
        ):
            return _POLICY_VIOLATION, "the client does not read its replies"
        if self._silent_s() > self._idle_s:
            return _GOING_AWAY, "silent for too long"
        refusal = self._caller.refusal() if isinstance(self._caller, Caller) else None
        return None if refusal is None else (_POLICY_VIOLATION, refusal)


def cancel_again(over: bool) -> None:
    """Cancel the receiver again if it missed its cancellation.

    Before Python 3.12, `asyncio.wait_for` drops a cancellation that coincides with the awaited
    event, such as the message of a client whose key has just been revoked.
    """
    if over:
        raise asyncio.CancelledError
