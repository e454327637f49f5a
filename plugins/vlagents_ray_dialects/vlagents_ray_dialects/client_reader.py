"""Reading from the connections of a gateway's clients: the bytes of incomplete messages count as
in flight.
"""

from __future__ import annotations

import contextlib
import mmap
import socket
import threading
import time

from vlagents_ray.errors import MessageTooLarge, Overloaded
from vlagents_ray.serve.engine.admission import Admission, ArrivingBytes

_READ_BYTES = 256 * 1024  # maximum size of a read
# Above this size a message is in a mapping, whose pages are taken when they are written, and are
# returned when it is freed. The heaps of as many threads as there are clients would keep them.
_MAPPED_BYTES = 256 * 1024
_KEEP_ALIVE = (
    ("TCP_KEEPIDLE", 20),
    ("TCP_KEEPINTVL", 5),
    ("TCP_KEEPCNT", 3),
    ("TCP_USER_TIMEOUT", 35_000),
)


def share_of(connection: socket.socket) -> str:
    """Return the name under which a client without a key has a share of the bytes in flight:
    that of its address.
    """
    try:
        peer = connection.getpeername()
    except OSError:  # the client is already gone
        return "address unknown"
    return "this machine" if connection.family == socket.AF_UNIX else f"address {peer[0]}"


def shut_down(connection: socket.socket, how: int = socket.SHUT_RDWR) -> None:
    """Shut a connection down, which wakes the thread that reads from it."""
    with contextlib.suppress(OSError):
        connection.shutdown(how)


def set_keep_alive(connection: socket.socket) -> None:
    """Let the kernel end a TCP connection whose client's machine no longer answers, after 35 s."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEP_ALIVE:
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class ClientReader:
    """Reads from one connection; one thread at a time reads."""

    def __init__(self, connection: socket.socket, admission: Admission, *, robot: bool) -> None:
        """Prepare to read.

        Args:
            robot: Whether incomplete messages may use the bytes in flight that are reserved for
                robots.
        """
        self._connection = connection
        # Guards the fields below, which `_give_up` changes on other threads.
        self._lock = threading.Lock()
        self._data = memoryview(b"")
        self._received = 0  # number of bytes of `_data` that have been received
        # Whether the rest of the message is discarded, as there is no memory for it.
        self._is_given_up = False
        self._arriving = ArrivingBytes(admission, share_of(connection), robot, self._give_up)

    def set_sender(self, admission: Admission, key: str, *, robot: bool) -> None:
        """Count later messages for another share of the bytes in flight, that of a key."""
        self._arriving = ArrivingBytes(admission, key, robot, self._give_up)

    def read(self, length: int, silent_s: float, deadline: float) -> memoryview | None:
        """Read `length` bytes; memory is taken as they arrive, and counts as in flight until they
        are complete.

        Args:
            silent_s: Maximum time between two parts, s.
            deadline: Time of the last part at the latest, s, of `time.monotonic()`.

        Returns:
            The bytes; None if the client disconnected before the first.

        Raises:
            Overloaded: There was no memory for the bytes, which were read and discarded.
            MessageTooLarge: The bytes took too long.
            ConnectionResetError: The client disconnected among them.
        """
        with self._lock:
            self._data = memoryview(
                mmap.mmap(-1, length) if length > _MAPPED_BYTES else bytearray(length)
            )
            self._received, self._is_given_up = 0, False

        left = length
        try:
            while left:
                wait_s = min(silent_s, deadline - time.monotonic())
                if wait_s <= 0:
                    raise MessageTooLarge("a message took longer than a client may take")

                self._connection.settimeout(wait_s)
                received = self._connection.recv(min(left, _READ_BYTES))
                if not received:
                    if left < length:
                        raise ConnectionResetError("the client disconnected within a message")
                    return None

                left -= len(received)
                self._keep(received)
        finally:
            self._arriving.release()

        with self._lock:
            data, self._data = self._data, memoryview(b"")
            if self._is_given_up:
                raise Overloaded(
                    "the messages in flight leave no room for one that arrives slowly; send it "
                    "again"
                )
        return data

    def _keep(self, received: bytes) -> None:
        with self._lock:
            if self._is_given_up:
                return
            end = self._received + len(received)
            try:
                self._arriving.resize(end)
            except Overloaded:
                self._discard()
            else:
                self._data[self._received : end] = received
                self._received = end

    def _give_up(self) -> None:
        """Free the memory of an incomplete message, as a complete one needs it; called on any
        thread.
        """
        with self._lock:
            self._discard()

    def _discard(self) -> None:
        self._data = memoryview(b"")
        self._is_given_up = True
