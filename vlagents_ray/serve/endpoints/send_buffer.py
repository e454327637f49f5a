"""The unsent bytes of a connection whose client may read slowly."""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import threading
import time
from collections.abc import Callable

logger = logging.getLogger(__name__)

# Maximum time without progress for a client that does not read all replies immediately.
_SLOW_S = 10.0


class SendBuffer:
    """The unsent bytes of one connection.

    Call the methods with the connection's lock held; the thread that sends to a slow client
    acquires the same lock.
    """

    def __init__(
        self,
        connection: socket.socket,
        lock: threading.Lock,
        limit: int,
        lost: Callable[[], None],
    ) -> None:
        """Create an empty buffer; a client is cut off if more than `limit` bytes wait, or it
        reads none for 10 s.

        `lost` is called, with the lock held, if the client has ended the connection: its unread
        requests must then have no effect.
        """
        self._connection = connection
        self._lock = lock
        self._limit = limit
        self._lost = lost
        self._unsent = bytearray()
        self._thread: threading.Thread | None = None  # sends unsent bytes to a slow client
        self._slow = False  # whether the thread is sending unsent bytes
        self._last = False  # whether no further bytes may be sent on the connection
        self._closed = False

    def send(self, data: bytes, *, last: bool = False) -> None:
        """Send as many bytes as the connection accepts now; a thread sends the remaining bytes
        later.

        After the `last` bytes the client reads the end of the connection, which stays open for
        reading.
        """
        if self._closed:
            return
        self._last = self._last or last
        self._unsent += data
        if not self._slow:
            self._send_now()
            if self._unsent:
                self._slow = True
                self._thread = threading.Thread(
                    target=self._send_rest, name="send-slowly", daemon=True
                )
                self._thread.start()
        elif len(self._unsent) > self._limit:
            self._disconnect()

    @property
    def unsent_bytes(self) -> int:
        """Number of unsent bytes; may be read without the lock."""
        return len(self._unsent)

    def wait_sent(self, until: float) -> None:
        """Wait until the kernel has all bytes, but at most until a time of `time.monotonic`, s;
        call this without the lock.
        """
        if self._thread is not None:
            self._thread.join(max(0.0, until - time.monotonic()))

    def close(self) -> None:
        """Stop sending; call this before the connection is closed."""
        self._closed = True

    def _send_now(self) -> None:
        try:
            sent = self._connection.send(self._unsent) if self._unsent else 0
        except BlockingIOError:
            return
        except OSError as error:
            logger.info("client: %s", error)
            sent = len(self._unsent)
            self._lost()
        del self._unsent[:sent]

        if self._last and not self._unsent:
            with contextlib.suppress(OSError):
                self._connection.shutdown(socket.SHUT_WR)

    def _send_rest(self) -> None:
        poller = select.poll()
        poller.register(self._connection, select.POLLOUT)
        while True:
            writable = poller.poll(_SLOW_S * 1e3)
            with self._lock:
                if self._closed:
                    return
                if not writable:
                    self._disconnect()
                self._send_now()
                if not self._unsent:
                    self._slow = False
                    return

    def _disconnect(self) -> None:
        logger.warning("client: does not read its replies; cut off")
        self._unsent.clear()
        with contextlib.suppress(OSError):  # the client has already closed the connection
            self._connection.shutdown(socket.SHUT_RDWR)
