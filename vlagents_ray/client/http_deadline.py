"""A socket for `http.client` with a deadline for each exchange, even if the server sends slowly.

The time limit of a plain socket applies to each read, so a server that sends a byte from time to
time could keep its client waiting forever.
"""

from __future__ import annotations

import contextlib
import http.client
import io
import math
import socket
import time
from collections.abc import Iterator
from typing import IO, Any, cast

from vlagents_ray.protocol.frame_layout import Buffer


class DeadlineSocket:
    """The part of a connected socket that `http.client` uses, with one time limit for a whole
    exchange.
    """

    def __init__(self, sock: socket.socket) -> None:
        self._socket = sock
        self._deadline = math.inf  # time.monotonic()
        # Pieces of a request, until the whole request is sent.
        self._pieces: list[Buffer] | None = None

    @classmethod
    def install(cls, connection: http.client.HTTPConnection) -> DeadlineSocket:
        """Replace the socket of an open connection."""
        installed = cls(connection.sock)
        connection.sock = cast(socket.socket, installed)
        return installed

    def begin_exchange(self, timeout_s: float) -> None:
        """Set the time limit, s, for sending the next request and receiving its whole answer."""
        self._deadline = time.monotonic() + timeout_s

    def apply_deadline(self) -> None:
        """Limit the next operation of the socket to the remaining time.

        Raises:
            TimeoutError: No time remains.
        """
        left_s = self._deadline - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("timed out")
        self._socket.settimeout(None if math.isinf(left_s) else left_s)

    @contextlib.contextmanager
    def sending_at_once(self) -> Iterator[None]:
        """Collect the data of all calls of `sendall` within the context, and send them together
        when the context ends.

        `http.client` sends the headers and the body of a request separately, which would wake up
        the server twice.
        """
        pieces: list[Buffer] = []
        self._pieces = pieces
        try:
            yield
        finally:
            self._pieces = None
        self.sendall(b"".join(pieces))

    def sendall(self, data: Buffer) -> None:
        """Send all of the data within the time limit of the exchange.

        A TLS socket's `sendall` would apply the limit to each record.
        """
        if self._pieces is not None:
            self._pieces.append(data)
            return
        remaining = memoryview(data).cast("B")
        while remaining:
            self.apply_deadline()
            remaining = remaining[self._socket.send(remaining) :]

    def makefile(self, mode: str) -> IO[bytes]:
        """Return a buffered reader of one answer, for `http.client.HTTPResponse`."""
        if mode != "rb":
            raise ValueError(f"mode: expected 'rb', got {mode!r}")
        return io.BufferedReader(
            _AnswerReader(self, cast(io.RawIOBase, self._socket.makefile("rb", buffering=0)))
        )

    def fileno(self) -> int:
        return self._socket.fileno()

    def close(self) -> None:
        self._socket.close()


class _AnswerReader(io.RawIOBase):
    """Reads a socket. The time limit of each read is the remaining time of the exchange."""

    def __init__(self, deadline_socket: DeadlineSocket, raw: io.RawIOBase) -> None:
        self._deadline_socket, self._raw = deadline_socket, raw

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int | None:
        self._deadline_socket.apply_deadline()
        return self._raw.readinto(buffer)

    def close(self) -> None:
        # `http.client` may have closed the connection already; the socket stays open until its
        # reader is closed, here.
        self._raw.close()
        super().close()
