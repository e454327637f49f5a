"""The endpoint for processes on the same machine: observations in shared memory.

A client connects to an abstract Unix socket whose unguessable name is in the metadata, and passes memory files that it
writes its frames into (`vlagents_ray.serve.endpoints.unix_messages`). Neither side creates a file name, so that
memory and socket are freed with their processes, however those end.
"""

from __future__ import annotations

import fcntl
import mmap
import os
import secrets
import weakref
from collections.abc import Sequence
from functools import partial
from typing import ClassVar

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.protocol.messages import OPS, Limits, LocalAddress, Op, boot_id
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.unix_messages import BACKLOG, Admit, UnixServer
from vlagents_ray.serve.engine.engine import Engine

_MAX_VIEWS = 8  # number of memory files that a policy may hold views of before requests are copied


class ShmServer(UnixServer):
    """Accepts the clients that read its address in the metadata."""

    name: ClassVar[str] = "shm"

    def __init__(self, engine: Engine, limits: Limits, admit: Admit | NoKey, ops: Sequence[Op] = OPS) -> None:
        """See `UnixServer`."""
        super().__init__(engine, admit, limits, partial(MemoryFiles, limits), ops)
        self.address = LocalAddress(
            f"vlagents-ray-{secrets.token_hex(16)}", boot_id(), keyed=not isinstance(admit, NoKey)
        )

    def listen(self) -> None:
        """See `UnixServer`."""
        self._listener.bind(f"\0{self.address.socket}")
        self._listener.listen(BACKLOG)


class MemoryFiles:
    """A `Payload`: the memory files of one client, read in place and given back when no view is left."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._files: dict[int, mmap.mmap] = {}
        self._views: dict[int, weakref.ref[np.ndarray]] = {}  # the array on each file, until it is garbage-collected
        self._freed: set[int] = set()  # freed files that no reply has reported yet

    def read(self, message: memoryview, descriptors: list[int]) -> tuple[np.ndarray, bool, memoryview]:
        """See `Payload`."""
        if len(message) < LocalAddress.REQUEST.size:
            raise MalformedMessage(f"local: got {len(message)} bytes, want at least {LocalAddress.REQUEST.size}")
        number, flags, length = LocalAddress.REQUEST.unpack_from(message)
        if descriptors:
            self._add(number, descriptors.pop(0))
        memory = self._memory(number, length)
        return memory, bool(flags & LocalAddress.COMPACT), message[LocalAddress.REQUEST.size :]

    def freed(self) -> int:
        """See `Payload`."""
        bits = 0
        while self._freed:
            bits |= 1 << self._freed.pop()
        return bits

    def free(self) -> None:
        """See `Payload`; memory that the policy still views is freed with the last view."""
        self._files.clear()

    def _memory(self, number: int, length: int) -> np.ndarray:
        """Return the client's memory in place; the client does not write into it until a reply reports it as freed.

        Return a copy if the policy holds views of many files already.
        """
        file = self._files.get(number)
        if file is None or length > len(file):
            raise MalformedMessage(f"local: {length} bytes in memory file {number}, which is not there or shorter")
        memory = np.frombuffer(file, np.uint8, length)
        if len(self._views) >= _MAX_VIEWS:
            self._freed.add(number)
            memory = memory.copy()
            memory.flags.writeable = False
            return memory
        self._views[number] = weakref.ref(memory, partial(self._release, number))
        return memory

    def _release(self, number: int, _: object) -> None:
        self._views.pop(number, None)
        self._freed.add(number)

    def _add(self, number: int, descriptor: int) -> None:
        try:
            size = os.fstat(descriptor).st_size
            if size > 2 * self._limits.body_bytes or number >= LocalAddress.FILES:
                raise MessageTooLarge(
                    f"local: memory file {number} of {size} bytes; {LocalAddress.FILES} files are the limit"
                )
            # Reading a file that has shrunk would kill this process.
            if not fcntl.fcntl(descriptor, fcntl.F_GET_SEALS) & fcntl.F_SEAL_SHRINK:
                raise MalformedMessage("local: the memory file is not sealed against shrinking")
            mapped = mmap.mmap(descriptor, size, prot=mmap.PROT_READ)
        except (OSError, ValueError) as error:
            if isinstance(error, VLAgentsError):
                raise
            raise MalformedMessage(f"local: not a memory file ({error})") from error
        finally:
            os.close(descriptor)
        self._files[number] = mapped
