"""The shared-memory transport: frames to a server on this machine.

`vlagents_ray.serve.endpoints.shm` is the server's side.
"""

from __future__ import annotations

import fcntl
import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.client.credentials import ANONYMOUS, Credentials
from vlagents_ray.client.transports.unix_messages import UnixTransport
from vlagents_ray.images.codecs import RAW
from vlagents_ray.protocol.frames import request_parts
from vlagents_ray.protocol.messages import LocalAddress, Request, boot_id

_PAGE = mmap.PAGESIZE


@dataclass(slots=True)
class _Memory:
    """A memory file of this client that the server maps, too."""

    number: int
    map: mmap.mmap
    busy: bool = False  # the server may still read it


def reaches(local: dict[str, Any]) -> bool:
    """Whether the server that states `local` in its metadata is on this machine and can be used by this process."""
    return hasattr(os, "memfd_create") and local["boot_id"] == boot_id() != ""


class ShmTransport(UnixTransport):
    """Writes raw frames once, into memory files that the server reads."""

    name: ClassVar[str] = "shm"

    def __init__(self, local: dict[str, Any], credentials: Credentials = ANONYMOUS) -> None:
        """Set the server; `local` is the entry for this endpoint in its metadata."""
        super().__init__()
        address = LocalAddress(**local)
        self._server = f"\0{address.socket}"
        self._key = (credentials.api_key or "-") if address.keyed else None
        self._memories: list[_Memory] = []
        # The memory of the last request, and the descriptor of it that the server was sent.
        self._written: tuple[_Memory, int | None] | None = None

    def connect(self, timeout_s: float) -> None:
        """Connect to the server's socket; raises `PolicyUnavailable` if it does not answer."""
        self._open(timeout_s)

    def close(self) -> None:
        """Close the connection and free the memory."""
        super().close()
        for memory in self._memories:
            memory.map.close()
        self._memories.clear()

    def _is_free(self) -> bool:
        return len(self._memories) < LocalAddress.FILES or not all(memory.busy for memory in self._memories)

    def _write(self, requests: Sequence[Request], deadline: float) -> tuple[bytes, int | None]:
        written = self._writer.write(requests)
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
        self._written = memory, descriptor
        return message, descriptor

    def _unsent(self) -> None:
        """Drop the memory file of the last request, which the server did not get: another file takes its number."""
        if self._written is not None:
            memory, descriptor = self._written
            memory.busy = False
            if descriptor is not None:
                self._memories[memory.number] = _Memory(memory.number, mmap.mmap(-1, 1))

    def _answered(self, freed: int) -> None:
        while freed:
            number = freed.bit_length() - 1
            freed -= 1 << number
            if number < len(self._memories):
                self._memories[number].busy = False

    def _memory(self, length: int) -> tuple[_Memory, int | None]:
        """Return free memory for `length` bytes, with its descriptor if the server has yet to get it."""
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
