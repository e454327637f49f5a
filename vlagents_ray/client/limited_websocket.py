"""A WebSocket of the package `websockets` whose connection ends if sending a message exceeds a time
limit.

The package sends without a limit, and the kernel's limit is not sufficient, since it restarts
whenever the peer has read a few bytes. A server that hangs, or reads a byte from time to time,
would block a robot for minutes.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from typing import Any, cast

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection

from vlagents_ray.client.shared_tls_socket import SharedTlsSocket
from vlagents_ray.errors import shown

_PERIOD_S = 0.1  # period at which the limits are checked


class SharedConnection(ClientConnection):
    """A connection with a TLS socket that several threads can use at the same time, for the
    argument `create_connection` of `connect`. With a plain TLS socket, the opening handshake may be
    lost, and exceed its time limit.

    A redirect is an error, which `connect` would follow: a server behind TLS could send a robot to
    any other address, also to one without TLS.
    """

    def __init__(self, sock: socket.socket, *args: Any, **options: Any) -> None:
        """Begin to read a connected socket; takes the arguments of `ClientConnection`."""
        shared = SharedTlsSocket(sock) if isinstance(sock, ssl.SSLSocket) else sock
        super().__init__(cast("socket.socket", shared), *args, **options)

    def handshake(self, *args: Any, **options: Any) -> None:
        """Perform the opening handshake; takes the arguments of `ClientConnection`.

        Raises:
            InvalidHandshake: The server does not accept the connection, or redirects it.
        """
        try:
            super().handshake(*args, **options)
        except InvalidStatus as error:
            target = error.response.headers.get("location")
            if target is None:
                raise
            raise InvalidHandshake(
                f"the server redirects to {shown(target)}, which no client follows; connect to "
                "that address if you trust it"
            ) from error


class LimitedWebSocket:
    """An open connection, which a thread ends when the time limit of an operation has passed."""

    def __init__(self, connection: ClientConnection) -> None:
        """Limit the duration of every send operation of a connection, until `close`."""
        self.connection = connection
        # Deadlines of the operations in progress, s of `time.monotonic`.
        self._deadlines: set[float] = set()
        self._is_late = False  # whether the connection was ended because a time limit had passed
        self._closed = threading.Event()
        threading.Thread(target=self._watch, name="websocket-limit", daemon=True).start()

    def send(self, message: str | bytes, timeout_s: float) -> None:
        """Send a message: a text message for a `str`, otherwise a binary message.

        Raises:
            ConnectionClosed: The connection is closed.
            OSError: The connection broke, or the server has not read the message in time, which
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
        """End the connection if this context lasts longer than `timeout_s`."""
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
        """End the connection when a time limit has passed; runs on its own thread."""
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
        with contextlib.suppress(OSError):  # the socket is already closed
            self.connection.socket.shutdown(socket.SHUT_RDWR)
