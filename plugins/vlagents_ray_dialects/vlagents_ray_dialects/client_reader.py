"""Reads from the connections of a gateway's clients. The bytes of incomplete messages count as
bytes in flight.
"""

from __future__ import annotations

import contextlib
import mmap
import socket
import threading
import time

from vlagents_ray.errors import MessageTooLarge, Overloaded
from vlagents_ray.serve.engine.admission import Admission, ArrivingBytes

_READ_BYTES = 256 * 1024  # maximum number of bytes of one read
# The memory of a message above this size is an anonymous mapping: its pages are allocated when they
# are written, and returned to the system when the message is freed. The heaps of the clients'
# threads would keep such memory.
_MAPPED_BYTES = 256 * 1024
# Options of TCP: probes begin after 20 s of silence, and a connection ends after 35 s.
_KEEP_ALIVE = (
    ("TCP_KEEPIDLE", 20),
    ("TCP_KEEPINTVL", 5),
    ("TCP_KEEPCNT", 3),
    ("TCP_USER_TIMEOUT", 35_000),
)


def share_of(connection: socket.socket) -> str:
    """Return the name of the address of a client without a key, under which its bytes in flight are
    counted.
    """
    try:
        peer = connection.getpeername()
    except OSError:  # the client has disconnected
        return "address unknown"
    return "this machine" if connection.family == socket.AF_UNIX else f"address {peer[0]}"


def shut_down(connection: socket.socket, how: int = socket.SHUT_RDWR) -> None:
    """Shut a connection down, which wakes the thread that reads from it."""
    with contextlib.suppress(OSError):
        connection.shutdown(how)


def set_keep_alive(connection: socket.socket) -> None:
    """Let the kernel end a TCP connection if the client's machine does not answer for 35 s."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in _KEEP_ALIVE:
        if hasattr(socket, name):
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class ClientReader:
    """Reads from one connection, on one thread at a time.

    Args:
        connection: The connection.
        admission: Counts the bytes in flight.
        robot: Whether incomplete messages may use the bytes in flight that are reserved for robots.
    """

    def __init__(self, connection: socket.socket, admission: Admission, *, robot: bool) -> None:
        self._connection = connection
        # Guards the fields below, which `_give_up` changes on other threads.
        self._lock = threading.Lock()
        self._data = memoryview(b"")
        self._received = 0  # the number of bytes of `_data` that have been received
        # Whether the remaining bytes of the message are discarded, since no memory is left for
        # them.
        self._is_given_up = False
        self._arriving = ArrivingBytes(admission, share_of(connection), robot, self._give_up)

    def set_sender(self, admission: Admission, key: str, *, robot: bool) -> None:
        """Count the bytes of later messages in another share of the bytes in flight.

        Args:
            admission: Counts the bytes in flight.
            key: The name of the share, such as the name of the client's API key.
            robot: Whether messages may use the bytes that are reserved for robots.
        """
        self._arriving = ArrivingBytes(admission, key, robot, self._give_up)

    def read(self, length: int, silent_s: float, deadline: float) -> memoryview | None:
        """Read bytes. Memory is allocated as they arrive, and counts as in flight until they are
        complete.

        Args:
            length: The number of bytes.
            silent_s: Maximum time between two pieces, s.
            deadline: The time until which the last piece must arrive, s, of `time.monotonic()`.

        Returns:
            The bytes; None if the client disconnected before the first byte.

        Raises:
            Overloaded: There was no memory for the bytes, which were read and discarded.
            MessageTooLarge: The bytes took too long.
            ConnectionResetError: The client disconnected before the last byte.
        """
        memory = mmap.mmap(-1, length) if length > _MAPPED_BYTES else bytearray(length)
        with self._lock:
            self._data = memoryview(memory)
            self._received = 0
            self._is_given_up = False

        missing = length
        try:
            while missing:
                wait_s = min(silent_s, deadline - time.monotonic())
                if wait_s <= 0:
                    raise MessageTooLarge("a message took longer than the time limit of a client")

                self._connection.settimeout(wait_s)
                received = self._connection.recv(min(missing, _READ_BYTES))
                if not received:
                    if missing < length:
                        raise ConnectionResetError("the client disconnected within a message")
                    return None

                missing -= len(received)
                self._keep(received)
        finally:
            self._arriving.release()

        with self._lock:
            data, self._data = self._data, memoryview(b"")
            if self._is_given_up:
                raise Overloaded(
                    "the messages in flight leave too little memory for a message that arrives "
                    "this slowly; send it again"
                )
        return data

    def _keep(self, received: bytes) -> None:
        """Store received bytes, or discard the message if there is no memory."""
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
        """Free the memory of the incomplete message for complete messages; called on any thread."""
        with self._lock:
            self._discard()

    def _discard(self) -> None:
        """Free the memory of the message; the caller holds the lock."""
        self._data = memoryview(b"")
        self._is_given_up = True
