"""Messages on a Unix socket that say where the observations lie: what shared memory and plasma have in common.

`vlagents_ray.serve.endpoints.unix_messages` is the server's side.
"""

from __future__ import annotations

import math
import os
import select
import socket
import struct
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from vlagents_ray.client.transports.base import is_answer
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, PolicyUnavailable, VLAgentsError
from vlagents_ray.images import thread_map
from vlagents_ray.protocol import shm_layout
from vlagents_ray.protocol.frames import decode_replies
from vlagents_ray.protocol.messages import LocalAddress, Reply, Request

_MESSAGE_BYTES = 128 * 1024  # the longest reply that fits in a message, and a margin
_CONTROL = socket.CMSG_SPACE(4)
_SPIN_S = 150e-6  # s to poll for an answer before sleeping
_FAST_S = 600e-6  # s; if the last answer took less, wake-up included, the next one may come while polling


class UnixTransport(ABC):
    """Sends messages and receives replies; subclasses write the observations. Sessions end with the connection."""

    name: ClassVar[str]
    holds_sessions = True

    def __init__(self) -> None:
        self._server = ""  # the address of its socket
        self._key: str | None = None  # the API key, sent first
        self._socket: socket.socket | None = None
        self._poller = select.poll()  # polls the socket
        self._buffer = bytearray(_MESSAGE_BYTES)
        self._writer = shm_layout.ShmWriter()
        self._answers_fast = True  # whether the last answer came at once
        self._core = -1  # the core on which the last answer was written

    @abstractmethod
    def _is_free(self) -> bool:
        """Whether the next requests can be written."""

    @abstractmethod
    def _write(self, requests: Sequence[Request], deadline: float) -> tuple[bytes, int | None]:
        """Write requests where the server reads them.

        Returns:
            The message that says so, and a descriptor to send with it, if any.

        Raises:
            TimeoutError: The deadline is over; `OSError` if writing fails.
        """

    @abstractmethod
    def _unsent(self) -> None:
        """Handle that the message about the last requests was not sent."""

    @abstractmethod
    def _answered(self, freed: int) -> None:
        """Handle a reply. Bit n of `freed` says that the server no longer reads memory n."""

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Write requests for the server, send it a message and return its replies; late replies are discarded."""
        deadline = time.monotonic() + timeout_s
        connection = self._socket or self._open(timeout_s)
        try:
            self._send(connection, requests, deadline)
            return self._await(connection, requests, deadline)
        except OSError as error:
            raise self._failure(error, timeout_s) from error

    def call_on(self, request: Request, timeout_s: float) -> Reply:
        """See `RequestChannel`."""
        if self._socket is None:
            raise ConnectionLost(f"{self.name}: closed between two parts of a chunk; reset before the next act")
        try:
            return self._await(self._socket, [request], time.monotonic() + timeout_s)[0]
        except OSError as error:
            raise self._failure(error, timeout_s) from error

    def _failure(self, error: OSError, timeout_s: float) -> VLAgentsError:
        """Return the error of a call that failed, and close a connection that broke."""
        if isinstance(error, TimeoutError):
            return DeadlineExceeded(f"{self.name}: no answer within {timeout_s:g} s")
        self.close()
        return ConnectionLost(f"{self.name}: {error}; reset before the next act")

    def close(self) -> None:
        """End the connection, and with it its sessions."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._writer = shm_layout.ShmWriter()

    def _send(self, connection: socket.socket, requests: Sequence[Request], deadline: float) -> None:
        """Write requests where the server reads them, and send the message.

        Raises `TimeoutError` or `OSError` on failure.
        """
        try:
            while not self._is_free():  # the memory still holds requests that timed out
                try:
                    self._receive(connection)
                except BlockingIOError:
                    _wait(connection, select.POLLIN, deadline)
            message, descriptor = self._write(requests, deadline)
            try:
                _send_message(connection, message, deadline, descriptor)
            except BaseException:
                self._unsent()
                raise
        except BaseException:
            self._writer = shm_layout.ShmWriter()  # the server may not know a layout
            raise

    def _await(self, connection: socket.socket, requests: Sequence[Request], deadline: float) -> list[Reply]:
        """Return the replies to these requests, and to no earlier ones.

        If the last answer came at once, poll for a moment before sleeping: waking up takes as long as all the rest.
        Other processes can still use the core meanwhile.
        """
        begun = time.perf_counter()
        spin_until = begun + (_SPIN_S if self._answers_fast else 0.0)
        while True:
            while not self._poller.poll(0):  # polling costs a fraction of the exception that reading raises
                if time.perf_counter() < spin_until:
                    os.sched_yield()
                else:
                    _wait(connection, select.POLLIN, deadline)
            replies = self._receive(connection)
            if is_answer(replies, requests):
                if not replies[0].request_id:  # refused before it was parsed
                    self._writer = shm_layout.ShmWriter()
                self._answers_fast = time.perf_counter() - begun < _FAST_S
                if self._answers_fast:
                    thread_map.leave(self._core)
                return replies

    def _open(self, timeout_s: float) -> socket.socket:
        if self._socket is None:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            try:
                connection.settimeout(timeout_s)
                connection.connect(self._server)
                _require_same_user(connection)
                if self._key is not None:
                    connection.send(self._key.encode())
            except OSError as error:
                connection.close()
                raise PolicyUnavailable(f"{self.name}: the server's socket does not answer ({error})") from error
            except BaseException:  # an unencodable key, or Ctrl-C: nothing else refers to the socket
                connection.close()
                raise
            connection.setblocking(False)
            self._poller = select.poll()
            self._poller.register(connection, select.POLLIN)
            self._socket = connection
        return self._socket

    def _receive(self, connection: socket.socket) -> list[Reply]:
        """Return the next replies, to any requests; raises `BlockingIOError` if there are none yet."""
        size, control, _, _ = connection.recvmsg_into([self._buffer], _CONTROL)
        if size == 0:
            raise ConnectionResetError("the server closed the connection")
        freed, flags, self._core = LocalAddress.REPLY.unpack_from(self._buffer)
        if flags & LocalAddress.IN_FILE:
            descriptor = int.from_bytes(control[0][2][:4], sys.byteorder)
            with os.fdopen(descriptor, "rb") as file:
                file.seek(0)
                content = memoryview(file.read())
        else:
            content = memoryview(self._buffer)[LocalAddress.REPLY.size : size]
        self._answered(freed)
        if flags & LocalAddress.COMPACT:
            return shm_layout.read_answers(content)
        return decode_replies(bytes(content))


def _send_message(connection: socket.socket, message: bytes, deadline: float, descriptor: int | None = None) -> None:
    """Send a message, with a descriptor that is then closed here; waits while the server reads none."""
    try:
        while True:
            try:
                if descriptor is None:
                    connection.send(message)
                else:
                    socket.send_fds(connection, [message], [descriptor])
            except BlockingIOError:
                _wait(connection, select.POLLOUT, deadline)
            else:
                return
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _wait(connection: socket.socket, event: int, deadline: float) -> None:
    """Sleep until the socket is ready for `select.POLLIN` or `POLLOUT`; raises `TimeoutError` at the deadline."""
    left_s = deadline - time.monotonic()
    poller = select.poll()
    poller.register(connection, event)
    if left_s <= 0 or not poller.poll(math.ceil(left_s * 1e3)):
        raise TimeoutError


def peer_uid(connection: socket.socket) -> int:
    """Return the user id of the process at the other end of a Unix socket, as the kernel reports it."""
    credentials = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
    uid: int = struct.unpack("3i", credentials)[1]
    return uid


def _require_same_user(connection: socket.socket) -> None:
    """Raise `PermissionError` if the server is another user's: anybody may take the name of a server that has ended."""
    if (uid := peer_uid(connection)) != os.getuid():
        raise PermissionError(f"it belongs to the user with the number {uid}, want {os.getuid()}, this process's own")
