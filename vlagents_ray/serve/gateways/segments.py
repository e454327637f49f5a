"""The shared memory of a client on this machine, by name.

Read by copying, never mapped: a client that shrinks its segment under a mapping would end this process by
SIGBUS. Nothing here creates or removes a segment, nor tells Python's resource tracker of one, so a
client's end touches no memory but its own.
"""

from __future__ import annotations

import os
import re
import stat

from vlagents_ray.errors import InvalidObservation

_FOLDER = "/dev/shm"  # noqa: S108 - where Linux keeps them
# What Python's `SharedMemory` calls those that it makes; any other file there is not for clients to name.
_NAME = re.compile(r"/?(psm_[0-9a-f]{1,32})")
_KEPT = 64


class SharedMemory:
    """The segments of one client, kept open between its requests."""

    def __init__(self, *, near: bool) -> None:
        """`near`: is the client on this machine? No other may name a segment."""
        self._near = near
        self._open: dict[str, int] = {}

    def read(self, name: str, size: int) -> bytearray:
        """A copy of the first `size` bytes of a segment; `InvalidObservation` if there are not as many."""
        if not self._near:
            raise InvalidObservation(
                "shared memory: the client is not on the server's machine; leave on_same_machine=False"
            )
        descriptor = self._descriptor(name)
        if os.fstat(descriptor).st_size < size:  # before memory is taken for it
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
        """Let go of all of them; they stay their client's."""
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
        if len(self._open) >= _KEPT:  # a client makes another segment when its images grow
            os.close(self._open.pop(next(iter(self._open))))
        self._open[match[1]] = descriptor
        return descriptor
