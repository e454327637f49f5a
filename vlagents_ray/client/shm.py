"""Frames in shared memory to a server on this machine: see `vlagents_ray.serve.local` for the other side."""

from __future__ import annotations

import fcntl
import math
import mmap
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.client.credentials import NOBODY, Credentials
from vlagents_ray.client.transport import is_answer
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, PolicyUnavailable
from vlagents_ray.wire import compact, cores
from vlagents_ray.wire.codecs import RAW
from vlagents_ray.wire.frames import decode_replies, request_parts
from vlagents_ray.wire.messages import LocalAddress, Reply, Request, boot_id

_MESSAGE_BYTES = 128 * 1024  # the longest reply that comes in a message, and some
_PAGE = mmap.PAGESIZE
_CONTROL = socket.CMSG_SPACE(4)
_LOOK_S = 150e-6  # for an answer before going to sleep
_QUICK_S = 600e-6  # for the last answer, waking up included: the next may come while looked for


@dataclass(slots=True)
class _Memory:
    """A memory file of ours that the server maps too."""

    number: int
    map: mmap.mmap
    busy: bool = False  # the server may still read it


def reaches(local: dict[str, Any]) -> bool:
    """Is the server that states `local` in its metadata on this machine, and can this process use it?"""
    return hasattr(os, "memfd_create") and local["boot_id"] == boot_id() != ""


class ShmTransport:
    """Raw frames written once, into memory that the server reads; sessions last as long as the connection."""

    name = "shm"
    holds_sessions = True

    def __init__(self, local: dict[str, Any], credentials: Credentials = NOBODY) -> None:
        self._credentials = credentials
        self._address = LocalAddress(**local)
        self._socket: socket.socket | None = None
        self._memories: list[_Memory] = []
        self._buffer = bytearray(_MESSAGE_BYTES)
        self._acts = compact.Writer()
        self._quick = True  # did the last answer come at once?
        self._core = -1  # on which it was written

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect to the server's socket; the metadata came with its address."""
        self._open(timeout_s)
        return {}

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """One frame into free memory, a message to the server, its replies back; late ones are discarded."""
        deadline = time.monotonic() + timeout_s
        connection = self._open(timeout_s)
        try:
            try:
                self.hand_over(connection, requests, deadline)
            except BaseException:
                self._acts = compact.Writer()  # the server may not have heard of a layout
                raise
            return self._await(connection, requests, deadline)
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
        self._acts = compact.Writer()

    def server(self) -> str:
        """The name of the server's socket."""
        return f"\0{self._address.socket}"

    def hand_over(self, connection: socket.socket, requests: Sequence[Request], deadline: float) -> None:
        """Put requests where the server reads them, and say so. `TimeoutError`, `OSError` if that fails."""
        while len(self._memories) == LocalAddress.FILES and all(memory.busy for memory in self._memories):
            try:  # they are with requests that were given up
                self.receive(connection)
            except BlockingIOError:
                self.wait(connection, select.POLLIN, deadline)
        written = self._acts.write(requests)
        if written is not None:
            memory, descriptor = self._memory(written.size)
            for at, array in written.arrays:
                np.ndarray(array.shape, array.dtype, memory.map, at)[...] = array
            message = LocalAddress.REQUEST.pack(memory.number, LocalAddress.COMPACT, written.size) + written.message
        else:
            parts = request_parts(requests, RAW)
            length = sum(map(len, parts))
            memory, descriptor = self._memory(length)
            at = 0
            for part in parts:
                memory.map[at : at + len(part)] = part
                at += len(part)
            message = LocalAddress.REQUEST.pack(memory.number, 0, length)
        memory.busy = True
        try:
            self.send(connection, message, deadline, descriptor)
        except BaseException:  # the server has heard of nothing, nor got the file: another one takes its number
            memory.busy = False
            if descriptor is not None:
                self._memories[memory.number] = _Memory(memory.number, mmap.mmap(-1, 1))
            raise

    def send(self, connection: socket.socket, message: bytes, deadline: float, descriptor: int | None = None) -> None:
        """A message to the server, with a descriptor that is then closed here. Waits while it reads none."""
        try:
            while True:
                try:
                    if descriptor is None:
                        connection.send(message)
                    else:
                        socket.send_fds(connection, [message], [descriptor])
                except BlockingIOError:
                    self.wait(connection, select.POLLOUT, deadline)
                else:
                    return
        finally:
            if descriptor is not None:
                os.close(descriptor)

    def _await(self, connection: socket.socket, requests: Sequence[Request], deadline: float) -> list[Reply]:
        """The replies to these requests, and to no earlier ones.

        Where they came at once lately, look for them for a moment before going to sleep: waking up
        takes as long as all the rest. Other processes get the core meanwhile if they want it.
        """
        begun = time.perf_counter()
        look_until = begun + (_LOOK_S if self._quick else 0.0)
        while True:
            try:
                replies = self.receive(connection)
            except BlockingIOError:
                if time.perf_counter() < look_until:
                    os.sched_yield()
                else:
                    self.wait(connection, select.POLLIN, deadline)
                continue
            if is_answer(replies, requests):
                self._quick = time.perf_counter() - begun < _QUICK_S
                if self._quick:
                    cores.leave(self._core)
                return replies

    def _open(self, timeout_s: float) -> socket.socket:
        if self._socket is None:
            connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            connection.settimeout(timeout_s)
            try:
                connection.connect(self.server())
                if self._address.keyed:
                    self._show_key(connection)
            except OSError as error:
                connection.close()
                raise PolicyUnavailable(f"{self.name}: the server's socket does not answer ({error})") from error
            connection.setblocking(False)
            self._socket = connection
        return self._socket

    def _show_key(self, connection: socket.socket) -> None:
        """To the server, and nobody else: the name of one that has ended is free for whoever takes it."""
        peer = connection.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        if struct.unpack("3i", peer)[1] != os.getuid():
            raise PermissionError("it is another user's")
        connection.send((self._credentials.api_key or "-").encode())

    def _memory(self, length: int) -> tuple[_Memory, int | None]:
        """Memory that holds `length` bytes and is free, with its descriptor if the server has yet to get it."""
        for memory in self._memories:
            if not memory.busy and len(memory.map) >= length:
                return memory, None
        free = [memory for memory in self._memories if not memory.busy]
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
        """The next replies, to whichever requests; `BlockingIOError` if there are none yet."""
        size, control, _, _ = connection.recvmsg_into([self._buffer], _CONTROL)
        if size == 0:
            raise ConnectionResetError("the server hung up")
        freed, flags, self._core = LocalAddress.REPLY.unpack_from(self._buffer)
        if flags & LocalAddress.IN_FILE:
            descriptor = int.from_bytes(control[0][2][:4], sys.byteorder)
            with os.fdopen(descriptor, "rb") as file:
                file.seek(0)
                content = memoryview(file.read())
        else:
            content = memoryview(self._buffer)[LocalAddress.REPLY.size : size]
        while freed:
            number = freed.bit_length() - 1
            freed -= 1 << number
            if number < len(self._memories):
                self._memories[number].busy = False
        if flags & LocalAddress.COMPACT:
            return compact.read_answers(content)
        return decode_replies(bytes(content))

    @staticmethod
    def wait(connection: socket.socket, event: int, deadline: float) -> None:
        """Sleep until the socket is ready for `select.POLLIN` or `POLLOUT`; `TimeoutError` at the deadline."""
        left_s = deadline - time.monotonic()
        poller = select.poll()
        poller.register(connection, event)
        if left_s <= 0 or not poller.poll(math.ceil(left_s * 1e3)):
            raise TimeoutError
