"""A WebSocket of `websockets` that ends if a message takes longer to send than its time limit.

That package sends without a limit, and the kernel's own limit is not enough: it begins again
whenever the peer has taken a few bytes, and Python repeats an operation of TLS that has reached it.
A server that hangs, or reads a byte now and then, would block a robot for minutes.
"""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any, cast

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

_PERIOD_S = 0.1  # period at which the limits are checked


class OpeningLimit:
    """Ends a connection whose opening handshake takes longer than its time limit.

    That of `websockets` is not enough with TLS: the server's session ticket makes its thread read,
    which then waits until the server sends something, and a frozen one behind a proxy does not.
    Use it as a context manager around `connect`, with its `open_timeout_s` and `create_connection`.
    """

    def __init__(self, timeout_s: float) -> None:
        """Begin; the handshake is to be over in `timeout_s`."""
        self._timeout_s = timeout_s
        self._deadline = time.monotonic() + timeout_s
        self._timers: list[threading.Timer] = []
        self._is_late = False  # whether the connection was ended since the limit was over

    @property
    def open_timeout_s(self) -> float:
        """The `open_timeout` of `connect`, s: a little more, as it closes the socket, which then
        can no longer be ended.
        """
        return self._timeout_s + _PERIOD_S

    @property
    def create_connection(self) -> type[ClientConnection]:
        """The `create_connection` of `connect`, which needs no more of a class than its call."""
        return cast("type[ClientConnection]", self._begin_handshake)

    def _begin_handshake(self, sock: socket.socket, *args: Any, **options: Any) -> ClientConnection:
        """Return a connection for a connected socket, whose handshake begins now."""
        left_s = max(0.0, self._deadline - time.monotonic())
        timer = threading.Timer(left_s, self._end, [sock])
        timer.daemon = True
        timer.start()
        self._timers.append(timer)
        return ClientConnection(sock, *args, **options)

    def __enter__(self) -> OpeningLimit:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: object) -> None:
        for timer in self._timers:
            timer.cancel()
        if kind is not None and self._is_late:
            raise TimeoutError(f"no opening handshake within {self._timeout_s:g} s")

    def _end(self, sock: socket.socket) -> None:
        self._is_late = True
        _shut_down(sock)


def _shut_down(connection: socket.socket) -> None:
    """End both directions of a connection; another thread may be reading it."""
    with contextlib.suppress(OSError):  # it is closed already
        # The method of a TLS socket would also discard its state, which another thread uses.
        socket.socket.shutdown(connection, socket.SHUT_RDWR)


class LimitedWebSocket:
    """An open connection; a thread ends it when the limit of an operation is over."""

    def __init__(self, connection: ClientConnection) -> None:
        """Limit what is sent over a connection, until `close`."""
        self.connection = connection
        # Of the operations in progress, s, of `time.monotonic`.
        self._deadlines: set[float] = set()
        self._is_late = False  # whether the connection was ended since a limit was over
        self._closed = threading.Event()
        threading.Thread(target=self._watch, name="websocket-limit", daemon=True).start()

    def send(self, message: str | bytes, timeout_s: float) -> None:
        """Send a message, a text if it is a `str`.

        Raises:
            ConnectionClosed: The connection is closed.
            OSError: The connection broke, or the server has not taken the message in time, which
                ends the connection.
        """
        with self._limited(timeout_s):
            self.connection.send(message)

    def close(self, timeout_s: float) -> None:
        """Close the connection; its closing handshake takes at most `timeout_s`."""
        with contextlib.suppress(ConnectionClosed, OSError), self._limited(timeout_s):
            self.connection.close()
        self._closed.set()

    @contextlib.contextmanager
    def _limited(self, timeout_s: float) -> Iterator[None]:
        """End the connection if what is done within this context takes longer than `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        self._deadlines.add(deadline)
        try:
            yield
        except (ConnectionClosed, OSError) as error:
            if not self._is_late:
                raise
            late = f"the server took no message within {timeout_s:g} s"
            raise ConnectionAbortedError(late) from error
        finally:
            self._deadlines.discard(deadline)

    def _watch(self) -> None:
        """End the connection when a limit is over; runs on its own thread."""
        while not self._closed.wait(_PERIOD_S):
            now = time.monotonic()
            if any(deadline < now for deadline in tuple(self._deadlines)):
                self._is_late = True
                self.shut_down()
                return

    def shut_down(self) -> None:
        """End the connection at once, without the closing handshake; may be called on any
        thread.
        """
        self._closed.set()
        _shut_down(self.connection.socket)
