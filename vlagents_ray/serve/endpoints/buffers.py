"""Buffers of one connection: large messages are not copied, and a client that reads slowly delays no other client."""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import threading
from collections.abc import Generator

from websockets.protocol import Protocol
from websockets.streams import StreamReader

from vlagents_ray.serve.endpoints.connection import STAMP_SPACE, Control

logger = logging.getLogger(__name__)

READ_BYTES = 1024 * 1024  # room for a message with two or three raw images
_SMALL_BYTES = 1024  # parts of a frame up to this size are copied, since a view of them may outlast the buffer
_SLOW_S = 10.0  # maximum time without progress for a client that does not read all replies at once


class _ReadBuffer(threading.local):
    """Memory that a thread reads into: reading into newly allocated memory costs as much as copying from here."""

    def __init__(self) -> None:
        self.view = memoryview(bytearray(READ_BYTES))


_read_buffer = _ReadBuffer()


class ReceiveBuffer(StreamReader):
    """The bytes of WebSocket frames that one connection has received, until they are parsed.

    A message that arrives as a whole is parsed where it was read, and only copied when its mask is removed. The reader
    of `websockets` copies each message three times.
    """

    buffer: bytes | bytearray | memoryview  # type: ignore[assignment]

    def __init__(self) -> None:
        super().__init__()
        self._start = 0  # start of the unparsed bytes in `buffer`

    @property
    def size(self) -> int:
        """Number of unparsed bytes; on other threads than that of `parse`, only whether it is 0 is reliable."""
        return len(self.buffer) - self._start

    def attach(self, protocol: Protocol) -> None:
        """Become the reader of a protocol that has parsed all its bytes so far."""
        protocol.reader = self
        protocol.parser = Protocol.parse(protocol)  # the old parser reads from the old reader
        next(protocol.parser)
        self._protocol = protocol

    def parse(self, data: bytes | memoryview) -> None:
        """Parse bytes that `receive` returned, and copy the rest after the last complete frame."""
        self._protocol.receive_data(data)  # type: ignore[arg-type]
        if isinstance(self.buffer, bytearray):
            del self.buffer[: self._start]
        else:
            self.buffer = bytearray(self.buffer[self._start :])
        self._start = 0

    def feed_data(self, data: bytes | bytearray) -> None:
        """Add bytes, as the protocol's parser requires; raise `EOFError` after `feed_eof`."""
        if self.eof:
            raise EOFError("stream ended")
        if self.size:
            self.buffer += data  # type: ignore[operator]
        else:
            self.buffer, self._start = data, 0

    def read_exact(self, n: int) -> Generator[None, None, bytearray]:
        """Return the next `n` bytes once they have arrived; many bytes that `receive` has just read are a view."""
        while self.size < n:
            if self.eof:
                raise EOFError(f"stream ends after {self.size} bytes, expected {n} bytes")
            yield
        begin, self._start = self._start, self._start + n
        found = self.buffer[begin : self._start]
        return found if n > _SMALL_BYTES else bytearray(found)  # type: ignore[return-value]

    def at_eof(self) -> Generator[None, None, bool]:
        """Return whether the connection has ended, as soon as that is known; unparsed bytes mean that it has not."""
        while not self.size:
            if self.eof:
                return True
            yield
        return False

    def discard(self) -> None:
        """Drop the unparsed bytes."""
        self.buffer, self._start = bytearray(), 0


def receive(connection: socket.socket, size: int) -> tuple[bytes | memoryview, Control]:
    """Read at most `size` bytes from a connection that is readable.

    Returns:
        The bytes, none if the connection has ended, and their control data. The bytes are valid until this thread reads
        again.
    """
    view = _read_buffer.view
    count, control, _, _ = connection.recvmsg_into([view[:size]], STAMP_SPACE)
    return view[:count], control


class SendBuffer:
    """The unsent bytes of one connection.

    Call the methods with the connection's lock held; the thread that sends to a slow client acquires the same lock.
    """

    def __init__(self, connection: socket.socket, lock: threading.Lock, limit: int) -> None:
        """Create an empty buffer; a client is cut off if more than `limit` bytes wait, or it reads none for 10 s."""
        self._connection = connection
        self._lock = lock
        self._limit = limit
        self._unsent = bytearray()
        self._slow = False  # whether a thread is sending the rest
        self._closed = self._last = False

    def send(self, data: bytes, *, last: bool = False) -> None:
        """Send as many bytes as the connection accepts now; a thread sends the rest later.

        After the `last` bytes the client reads the end of the connection, which stays open for reading.
        """
        if self._closed:
            return
        self._last = self._last or last
        self._unsent += data
        if not self._slow:
            self._send_now()
            if self._unsent:
                self._slow = True
                threading.Thread(target=self._send_rest, name="send-slowly", daemon=True).start()
        elif len(self._unsent) > self._limit:
            self._disconnect()

    def close(self) -> None:
        """Stop sending; call this before the connection is closed."""
        self._closed = True

    def _send_now(self) -> None:
        try:
            sent = self._connection.send(self._unsent) if self._unsent else 0
        except BlockingIOError:
            return
        except OSError as error:  # the client is gone; the reading thread handles the end of the connection
            logger.info("client: %s", error)
            sent = len(self._unsent)
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
        logger.warning("client: takes no replies; cut off")
        self._unsent.clear()
        with contextlib.suppress(OSError):  # the client closed it already
            self._connection.shutdown(socket.SHUT_RDWR)
