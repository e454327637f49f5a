"""Frames in shared memory to a server on this machine: see `vlagents_ray.serve.local` for the other side."""

from __future__ import annotations

import fcntl
import mmap
import os
import socket
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vlagents_ray.client.transport import is_answer
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, PolicyUnavailable
from vlagents_ray.wire.codecs import RAW
from vlagents_ray.wire.frames import decode_replies, request_parts
from vlagents_ray.wire.messages import LocalAddress, Reply, Request, boot_id
from vlagents_ray.wire.tree import Buffer

_MESSAGE_BYTES = 128 * 1024  # the longest reply that comes in a message, and some
_PAGE = mmap.PAGESIZE


@dataclass(slots=True)
class _Memory:
    """A memory file of ours that the server maps too."""

    number: int
    map: mmap.mmap
    busy: str = ""  # the request whose frame the server may still have to read


def reaches(local: dict[str, Any]) -> bool:
    """Is the server that states `local` in its metadata on this machine, and can this process use it?"""
    return hasattr(os, "memfd_create") and local["boot_id"] == boot_id() != ""


class ShmTransport:
    """Raw frames written once, into memory that the server reads; sessions last as long as the connection."""

    name = "shm"
    holds_sessions = True

    def __init__(self, local: dict[str, Any]) -> None:
        self._address = LocalAddress(**local)
        self._socket: socket.socket | None = None
        self._memories: list[_Memory] = []
        self._buffer = bytearray(_MESSAGE_BYTES)

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect to the server's socket; the metadata came with its address."""
        self._open(timeout_s)
        return {}

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """One frame into free memory, a message to the server, its replies back; late ones are discarded."""
        deadline = time.monotonic() + timeout_s
        connection = self._open(timeout_s)
        parts = request_parts(requests, RAW)
        try:
            self.hand_over(connection, parts, requests[0].request_id, deadline)
            while True:
                connection.settimeout(max(1e-4, deadline - time.monotonic()))
                replies = self.receive(connection)
                if is_answer(replies, requests):
                    return replies
        except TimeoutError as error:
            raise DeadlineExceeded(f"{self.name}: no answer within {timeout_s:g} s") from error
        except OSError as error:
            self.close()
            raise ConnectionLost(f"{self.name}: {error}; reset before the next act") from error

    def close(self) -> None:
        """Hang up and give the memory back."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        for memory in self._memories:
            memory.map.close()
        self._memories.clear()

    def server(self) -> str:
        """The name of the server's socket."""
        return f"\0{self._address.socket}"

    def hand_over(self, connection: socket.socket, parts: list[Buffer], request_id: str, deadline: float) -> None:
        """Put a frame where the server reads it, and say so. `TimeoutError`, `OSError` if that fails."""
        length = sum(map(len, parts))
        memory, descriptor = self._memory(length)
        at = 0
        for part in parts:
            memory.map[at : at + len(part)] = part
            at += len(part)
        memory.busy = request_id
        message = LocalAddress.REQUEST.pack(memory.number, length)
        connection.settimeout(max(1e-4, deadline - time.monotonic()))
        if descriptor is None:
            connection.send(message)
        else:
            with os.fdopen(descriptor, "rb"):
                socket.send_fds(connection, [message], [descriptor])

    def _open(self, timeout_s: float) -> socket.socket:
        if self._socket is None:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            connection.settimeout(timeout_s)
            try:
                connection.connect(self.server())
            except OSError as error:
                connection.close()
                raise PolicyUnavailable(f"{self.name}: the server's socket does not answer ({error})") from error
            self._socket = connection
        return self._socket

    def _memory(self, length: int) -> tuple[_Memory, int | None]:
        """Memory that holds `length` bytes and is free, with its descriptor if the server has yet to get it."""
        free = [memory for memory in self._memories if not memory.busy]
        for memory in free:
            if len(memory.map) >= length:
                return memory, None
        number = free[0].number if free else len(self._memories)
        size = -(-length * 5 // 4 // _PAGE) * _PAGE
        descriptor = os.memfd_create("vlagents-ray-frames", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        os.ftruncate(descriptor, size)
        fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
        memory = _Memory(number, mmap.mmap(descriptor, size))
        if free:
            free[0].map.close()
            self._memories[number] = memory
        else:
            self._memories.append(memory)
        return memory, descriptor

    def receive(self, connection: socket.socket) -> list[Reply]:
        """The next reply, to whichever request; its frame's memory is free again."""
        ancillary = socket.CMSG_SPACE(4)
        size, control, _, _ = connection.recvmsg_into([self._buffer], ancillary)
        if size == 0:
            raise ConnectionResetError("the server hung up")
        number, flags = LocalAddress.REPLY.unpack_from(self._buffer)
        if flags & LocalAddress.IN_FILE:
            descriptor = int.from_bytes(control[0][2][:4], "little")
            with os.fdopen(descriptor, "rb") as file:
                file.seek(0)
                frame = file.read()
        else:
            frame = bytes(memoryview(self._buffer)[LocalAddress.REPLY.size : size])
        if number < len(self._memories):
            self._memories[number].busy = ""
        return decode_replies(frame)
