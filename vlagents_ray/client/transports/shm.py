"""Messages on a Unix socket that refer to observations in shared memory.

`vlagents_ray.serve.endpoints.shm` is the server's side. With plasma (`.serve_handle`), the
observations are in the object store instead.
"""

from __future__ import annotations

import contextlib
import fcntl
import mmap
import os
import select
import socket
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from vlagents_ray.client.credentials import ANONYMOUS, Credentials
from vlagents_ray.client.transports.base import (
    ReplicaSilent,
    ReplicaWatch,
    connection_lost,
    no_answer,
    poller_of,
    wait,
)
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.images.codecs import RAW
from vlagents_ray.polling import Polling
from vlagents_ray.protocol import compact
from vlagents_ray.protocol.frames import decode_replies, request_parts
from vlagents_ray.protocol.messages import LocalAddress, Reply, Request, boot_id, peer_uid

_MESSAGE_BYTES = 128 * 1024  # the longest reply that fits in a message, plus a margin
_CONTROL = socket.CMSG_SPACE(4)
_PAGE = mmap.PAGESIZE
_POLLING_S = 150e-6  # time for which the client polls for an answer before it sleeps
# If an answer takes less, including the wake-up, the client polls for the next one.
_FAST_S = 600e-6


class UnixTransport(ABC):
    """Sends messages and receives replies. Subclasses write the observations. Sessions end with the
    connection.
    """

    name: ClassVar[str]
    holds_sessions = True

    def __init__(self, watch: ReplicaWatch | None = None) -> None:
        self._watch = watch or ReplicaWatch()
        self._server = ""  # the address of the server's socket
        self._key: str | None = None  # the API key, sent first
        self._socket: socket.socket | None = None
        self._poller = select.poll()  # polls the Unix socket
        self._buffer = bytearray(_MESSAGE_BYTES)
        self._writer = compact.CompactWriter()
        self._polling = Polling(_POLLING_S)
        self._answers_fast = True  # whether the last answer was immediate

    @abstractmethod
    def _is_free(self) -> bool:
        """Return whether the next requests can be written."""

    @abstractmethod
    def _write(self, requests: Sequence[Request], deadline: float) -> tuple[bytes, int | None]:
        """Write requests to memory that the server reads.

        Returns:
            The message to send, and the descriptor to send with it, if any.

        Raises:
            TimeoutError: The deadline has passed.
            OSError: Writing failed.
        """

    @abstractmethod
    def _unsent(self) -> None:
        """Clean up if the message about the last requests was not sent."""

    @abstractmethod
    def _answered(self, freed: int) -> None:
        """Process a reply. Bit n of `freed` is set if the server no longer reads memory file n."""

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Write requests to shared memory, send a message to the server, and return the replies.
        Late replies to earlier requests are discarded.
        """
        deadline = time.monotonic() + timeout_s
        connection = self._socket or self._open(timeout_s)
        self._watch.begin()
        try:
            self._send(connection, requests, deadline)
            return self._await(connection, requests, deadline)
        except ReplicaSilent:
            self.close()
            raise
        except TimeoutError as error:
            raise no_answer(self.name, timeout_s) from error
        except OSError as error:
            self.close()
            raise connection_lost(self.name, f"{error}; reset before the next act") from error

    def close(self) -> None:
        """End the connection and its sessions."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        self._writer = compact.CompactWriter()

    def _send(
        self, connection: socket.socket, requests: Sequence[Request], deadline: float
    ) -> None:
        """Write requests to memory that the server reads, and send the message.

        Raises:
            TimeoutError: The deadline has passed.
            OSError: Writing or sending failed.
        """
        try:
            while not self._is_free():  # the memory still contains requests that timed out
                try:
                    self._receive(connection)
                except BlockingIOError:
                    self._watch.wait(self._poller, deadline, self._ping)
            message, descriptor = self._write(requests, deadline)
            try:
                _send_message(connection, message, deadline, descriptor)
            except BaseException:
                self._unsent()
                raise
        except BaseException:
            self._writer = (
                compact.CompactWriter()
            )  # the server may not have received the new layout
            raise

    def _await(
        self, connection: socket.socket, requests: Sequence[Request], deadline: float
    ) -> list[Reply]:
        """Return the replies to these requests, and discard the replies to earlier requests."""
        begun = time.perf_counter()
        while True:
            if not (self._answers_fast and self._polling.receives(self._poller.poll)):
                self._watch.wait(self._poller, deadline, self._ping)
            replies = self._receive(connection)
            if replies and replies[0].answers(requests[0]):
                if not replies[0].request_id:  # the message was rejected before it was parsed
                    self._writer = compact.CompactWriter()
                self._answers_fast = time.perf_counter() - begun < _FAST_S
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
                raise PolicyUnavailable(
                    f"{self.name}: the server's socket does not answer ({error})"
                ) from error
            except BaseException:
                # e.g. an unencodable key or Ctrl-C: no other object refers to the socket
                connection.close()
                raise
            connection.setblocking(False)
            self._poller = poller_of(connection, select.POLLIN)
            self._socket = connection
            self._watch.received()
        return self._socket

    def _ping(self) -> None:
        """Ping the server, unless the socket is full of messages that the server has not read."""
        if self._socket is not None:
            with contextlib.suppress(OSError):  # the next read raises the error
                self._socket.send(LocalAddress.PING)

    def _receive(self, connection: socket.socket) -> list[Reply]:
        """Return the next replies, to any requests; an empty list if the next message answers a
        ping.

        Raises:
            BlockingIOError: No message has arrived yet.
        """
        size, control, _, _ = connection.recvmsg_into([self._buffer], _CONTROL)
        if size == 0:
            raise ConnectionResetError("the server closed the connection")
        self._watch.received()
        if size == len(LocalAddress.PONG):
            return []
        freed, flags = LocalAddress.REPLY.unpack_from(self._buffer)
        if flags & LocalAddress.IN_FILE:
            descriptor = int.from_bytes(control[0][2][:4], sys.byteorder)
            with os.fdopen(descriptor, "rb") as file:
                file.seek(0)
                content = memoryview(file.read())
        else:
            content = memoryview(self._buffer)[LocalAddress.REPLY.size : size]
        self._answered(freed)
        if flags & LocalAddress.COMPACT:
            return compact.read_answers(content)
        return decode_replies(bytes(content))


def _send_message(
    connection: socket.socket, message: bytes, deadline: float, descriptor: int | None = None
) -> None:
    """Send a message and a descriptor, which is then closed. This waits while the server does not
    read.
    """
    try:
        while True:
            try:
                if descriptor is None:
                    connection.send(message)
                else:
                    socket.send_fds(connection, [message], [descriptor])
            except BlockingIOError:
                wait(poller_of(connection, select.POLLOUT), deadline)
            else:
                return
    finally:
        if descriptor is not None:
            os.close(descriptor)


def _require_same_user(connection: socket.socket) -> None:
    """Raise `PermissionError` if the server belongs to another user, as any user may reuse the name
    of a server that has ended.
    """
    uid = peer_uid(connection)
    if uid != os.getuid():
        raise PermissionError(
            f"it belongs to the user with the uid {uid}, not to {os.getuid()}, this process's user"
        )


@dataclass(slots=True)
class _Memory:
    """A memory file of this client, which the server also maps."""

    number: int
    map: mmap.mmap
    busy: bool = False  # whether the server may still read the memory


def reaches(local: LocalAddress) -> bool:
    """Return whether the server with this address is on this machine and usable by this process."""
    return hasattr(os, "memfd_create") and local.boot_id == boot_id() != ""


class ShmTransport(UnixTransport):
    """Writes raw frames once, into memory files that the server reads."""

    name: ClassVar[str] = "shm"

    def __init__(
        self,
        address: LocalAddress,
        credentials: Credentials = ANONYMOUS,
        watch: ReplicaWatch | None = None,
    ) -> None:
        """Set the server by its address, `local` in its metadata."""
        super().__init__(watch)
        self._server = f"\0{address.socket}"
        self._key = (credentials.api_key or "-") if address.keyed else None
        self._memories: list[_Memory] = []
        # The memory of the last request, and its descriptor if the request sends one.
        self._written: tuple[_Memory, int | None] | None = None

    def connect(self, timeout_s: float) -> None:
        """Connect to the server's socket.

        Raises:
            PolicyUnavailable: The server does not answer.
        """
        self._open(timeout_s)

    def close(self) -> None:
        """Close the connection and free the memory."""
        super().close()
        for memory in self._memories:
            memory.map.close()
        self._memories.clear()

    def _is_free(self) -> bool:
        return len(self._memories) < LocalAddress.FILES or not all(
            memory.busy for memory in self._memories
        )

    def _write(self, requests: Sequence[Request], deadline: float) -> tuple[bytes, int | None]:
        written = self._writer.write(requests)
        if written is not None:
            memory, descriptor = self._memory(written.size)
            for offset, array in written.arrays:
                np.ndarray(array.shape, array.dtype, memory.map, offset)[...] = array
            message = (
                LocalAddress.REQUEST.pack(memory.number, LocalAddress.COMPACT, written.size)
                + written.message
            )
        else:
            parts = request_parts(requests, RAW)
            length = sum(map(len, parts))
            memory, descriptor = self._memory(length)
            offset = 0
            for buffer in parts:
                memory.map[offset : offset + len(buffer)] = buffer
                offset += len(buffer)
            message = LocalAddress.REQUEST.pack(memory.number, 0, length)
        memory.busy = True
        self._written = memory, descriptor
        return message, descriptor

    def _unsent(self) -> None:
        """Drop the memory file of the last request, which the server did not receive, so that its
        number can be used again.
        """
        if self._written is not None:
            memory, descriptor = self._written
            memory.busy = False
            if descriptor is not None:
                self._memories[memory.number] = _Memory(memory.number, mmap.mmap(-1, 1))

    def _answered(self, freed: int) -> None:
        for memory in self._memories:
            if freed >> memory.number & 1:
                memory.busy = False

    def _memory(self, length: int) -> tuple[_Memory, int | None]:
        """Return free memory for `length` bytes, with its descriptor if the server has not
        received it yet.
        """
        for memory in self._memories:
            if not memory.busy and len(memory.map) >= length:
                return memory, None
        free = [memory for memory in self._memories if not memory.busy]
        number = free[0].number if free else len(self._memories)
        size = -(-length * 5 // 4 // _PAGE) * _PAGE
        descriptor = os.memfd_create("vlagents-ray-frames", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(descriptor, size)
        fcntl.fcntl(
            descriptor,
            fcntl.F_ADD_SEALS,
            fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL,
        )
        memory = _Memory(number, mmap.mmap(descriptor, size))
        if free:
            free[0].map.close()
            self._memories[number] = memory
        else:
            self._memories.append(memory)
        return memory, descriptor
