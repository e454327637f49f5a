"""Access by name to the shared memory of a client on this machine.

Segments are copied, never mapped: if a client shrinks a mapped segment, SIGBUS would end this process. This module
neither creates nor removes segments, nor registers them with Python's resource tracker, so that the client alone owns
them.
"""

from __future__ import annotations

import os
import re
import stat

from vlagents_ray.errors import InvalidObservation

_FOLDER = "/dev/shm"  # noqa: S108 - the folder of Linux for shared memory
# The names that Python's `SharedMemory` generates; clients may name no other file in the folder.
_NAME = re.compile(r"/?(psm_[0-9a-f]{1,32})")
_KEPT = 64


class SharedMemory:
    """The segments of one client, kept open between its requests."""

    def __init__(self, *, same_machine: bool) -> None:
        """Prepare to read; unless the client is on the `same_machine`, every name is refused."""
        self._same_machine = same_machine
        self._open: dict[str, int] = {}

    def read(self, name: str, size: int) -> bytearray:
        """Return a copy of the first `size` bytes of a segment; raise `InvalidObservation` if that is impossible."""
        if not self._same_machine:
            raise InvalidObservation(
                "shared memory: the client is not on the server's machine; leave on_same_machine=False"
            )
        descriptor = self._descriptor(name)
        if os.fstat(descriptor).st_size < size:  # checked before memory is allocated
            raise InvalidObservation(f"shared memory {name[:40]!r}: shorter than the {size} bytes of its shape")
        data = bytearray(size)
        got = 0
        while got < size:
            more = os.preadv(descriptor, [memoryview(data)[got:]], got)
            if more == 0:
                raise InvalidObservation(f"shared memory {name[:40]!r}: became shorter while it was read")
            got += more
        return data

    def close(self) -> None:
        """Close all segments, without removing them."""
        for descriptor in self._open.values():
            os.close(descriptor)
        self._open.clear()

    def _descriptor(self, name: str) -> int:
        match = _NAME.fullmatch(name)
        if match is None:
            raise InvalidObservation(f"shared memory: got the name {name[:40]!r}, want one like 'psm_01234567'")
        known = self._open.get(match[1])
        if known is not None:
            return known
        try:
            descriptor = os.open(f"{_FOLDER}/{match[1]}", os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            raise InvalidObservation(f"shared memory {name[:40]!r}: cannot be opened ({error.strerror})") from error
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise InvalidObservation(f"shared memory {name[:40]!r}: is none")
        if len(self._open) >= _KEPT:  # a client creates another segment when its images grow
            os.close(self._open.pop(next(iter(self._open))))
        self._open[match[1]] = descriptor
        return descriptor
