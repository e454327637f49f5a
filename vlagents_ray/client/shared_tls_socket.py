"""A TLS socket that one thread reads while others write.

OpenSSL does not permit this use, and Python 3.11 does not prevent it. While a read handles the
server's session ticket, OpenSSL puts the bytes that another thread writes into a buffer, which it
discards after the ticket. As a result, about 1 in 100 WebSockets to a server on the same machine
never sent the opening handshake, and the client waited for the answer until its time limit.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import ssl
import threading
import time
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from vlagents_ray.protocol.frame_layout import Buffer

T = TypeVar("T")
# The longest time, s, before a waiting thread checks again whether another thread has already read
# the expected bytes.
_WAIT_S = 1.0


class SharedTlsSocket:
    """Passes the calls of several threads to a connected TLS socket, one at a time.

    No call waits for the network while it has the lock. At most one thread may write at a time.
    """

    def __init__(self, tls: ssl.SSLSocket) -> None:
        """Take over a socket whose TLS handshake is complete; no other object may use the socket
        afterwards.
        """
        tls.setblocking(False)
        self._tls = tls
        self._timeout_s: float | None = None
        self._lock = threading.Lock()
        self._is_closed = False

    def __getattr__(self, name: str) -> Any:
        """Return any other attribute of the socket, such as its address."""
        return getattr(self._tls, name)

    def settimeout(self, timeout_s: float | None) -> None:
        """Set the time limit of each later call, s."""
        self._timeout_s = timeout_s

    def recv(self, size: int) -> bytes:
        """Return at most `size` bytes; none if the connection has ended.

        Raises:
            TimeoutError: No data arrived in time.
            OSError: The connection broke, or was closed.
        """
        return self._complete(partial(self._tls.recv, size), self._deadline())

    def sendall(self, data: Buffer) -> None:
        """Send bytes.

        Raises:
            TimeoutError: The peer has not read the bytes in time.
            OSError: The connection broke, or was closed.
        """
        deadline = self._deadline()
        unsent = memoryview(data).cast("B")
        while unsent:
            count = self._complete(partial(self._tls.send, unsent), deadline)
            unsent = unsent[count:]

    def shutdown(self, how: int) -> None:
        """Shut down one or both directions of the connection; wakes the waiting threads."""
        # `SSLSocket.shutdown` would also discard the TLS state, which another thread uses.
        socket.socket.shutdown(self._tls, how)

    def close(self) -> None:
        """Close the connection; calls of other threads end."""
        with contextlib.suppress(OSError):  # the connection has already ended
            self.shutdown(socket.SHUT_RDWR)
        with self._lock:
            self._is_closed = True
            self._tls.close()

    def _deadline(self) -> float:
        return float("inf") if self._timeout_s is None else time.monotonic() + self._timeout_s

    def _complete(self, call: Callable[[], T], deadline: float) -> T:
        """Repeat a non-blocking call until OpenSSL completes it."""
        while True:
            with self._lock:
                if self._is_closed:
                    raise OSError(errno.EBADF, os.strerror(errno.EBADF))
                try:
                    return call()
                except ssl.SSLWantReadError:
                    event = select.POLLIN
                except ssl.SSLWantWriteError:
                    event = select.POLLOUT
                poller = select.poll()
                poller.register(self._tls, event)

            left_s = min(_WAIT_S, deadline - time.monotonic())
            if left_s <= 0:
                raise TimeoutError("the TLS connection was not ready in time")
            poller.poll(left_s * 1e3)
