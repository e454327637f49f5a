"""Shared memory of the CPU in place of a GPU's: torch's files of it have the lifetime of CUDA's
handles.

Readers are counted as torch 2.13 counts those of a GPU's memory (torch/csrc/CudaIPCTypes.cpp and
StorageSharing.cpp): in a shared file with a header of 64 bytes, in unsigned numbers, and with a
limbo for memory that was freed before.
"""

from __future__ import annotations

import itertools
import os
import struct
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vlagents_ray.weights import shared_values
from vlagents_ray.weights.shared_values import StorageHandle, counted_reads

GPU = "GPU-of-the-test"
_FOLDER = Path("/dev/shm")
_HEADER, _SLOTS = 64, 10_000
_FILES = itertools.count()


class ReaderCounts:
    """Torch's counts of the readers of memory that this process has sent."""

    def __init__(self) -> None:
        # Readers keep files of counts open by their names, so that no name is ever used again, as
        # torch's are not.
        self.name = f"/readers_{os.getpid()}_{next(_FILES)}"
        self.next = 0
        self.limbo: list[tuple[int, Any]] = []  # slots, and their storages
        self._path = _FOLDER / self.name[1:]
        self._path.write_bytes(bytes(_HEADER + 8 * _SLOTS))
        weakref.finalize(self, self._path.unlink)

    def share(self) -> int:
        """Begin a count at 1, and return its slot, which is used once."""
        slot, self.next = self.next, self.next + 1
        self._change(self.name, slot, 1)
        return slot

    @classmethod
    def release(cls, name: str, slot: int) -> None:
        """Take a reader away, in any process; a file that is gone is no error."""
        if (_FOLDER / name[1:]).exists():
            cls._change(name, slot, -1)

    def delete(self, slot: int, storage: Any) -> None:
        """Free memory whose owner is done with it; what still has readers goes into limbo."""
        self.limbo.append((slot, storage))
        self.collect()

    def collect(self) -> None:
        """Free memory in limbo without readers."""
        self.limbo = [(slot, storage) for slot, storage in self.limbo if self.value(slot) > 0]

    def value(self, slot: int) -> int:
        """Return a count as torch reads it, which is unsigned."""
        with self._path.open("rb") as file:
            file.seek(_HEADER + 8 * slot)
            return int(struct.unpack("<Q", file.read(8))[0])

    @staticmethod
    def _change(name: str, slot: int, change: int) -> None:
        with (_FOLDER / name[1:]).open("r+b", buffering=0) as file:
            file.seek(_HEADER + 8 * slot)
            value = struct.unpack("<q", file.read(8))[0]
            file.seek(_HEADER + 8 * slot)
            file.write(struct.pack("<q", value + change))


class SharedCpuMemory:
    """Takes the CPU for one GPU."""

    def __init__(self, gpu: str = GPU, *peers: str) -> None:
        self.uuid, self.peers = gpu, peers
        self.handles = 0  # that this process has handed out and not taken back
        self.counts = ReaderCounts()

    def install(self) -> None:
        """Let this process hand over tensors on the CPU as if they were on a GPU."""
        shared_values._MEMORY = self  # type: ignore[assignment]

    def gpu(self, value: Any) -> str:
        torch = sys.modules.get("torch")
        return (
            self.uuid
            if torch is not None and isinstance(value, torch.Tensor) and value.numel()
            else ""
        )

    def readable(self, gpu: str) -> tuple[str, ...]:
        return gpu, *self.peers

    def finish(self, device: Any) -> None:
        assert str(device) == "cpu"

    @contextmanager
    def handed_over(self, storage: Any) -> Iterator[StorageHandle]:
        # Moves the values there, so that writes are seen by all.
        manager, file, size = storage._share_filename_cpu_()
        slot = self.counts.share()
        self.handles += 1
        try:
            with counted_reads(self.counts.name.encode(), slot):
                yield StorageHandle(
                    file, size, 0, manager + b"\0" + self.counts.name.encode(), slot
                )
        finally:
            self.handles -= 1
            self.counts.delete(slot, storage)

    def collect(self) -> None:
        self.counts.collect()

    def opened(self, gpu: str, handle: StorageHandle) -> Any:
        import torch

        if gpu not in self.readable(self.uuid):
            raise RuntimeError("this process does not use that GPU")
        manager, _, name = handle.counters.partition(b"\0")
        storage = torch.UntypedStorage._new_shared_filename_cpu(
            manager, handle.allocation, handle.size
        )
        weakref.finalize(storage, ReaderCounts.release, name.decode(), handle.counter)
        return storage


def files_of_torch() -> set[str]:
    """The files of shared memory that this process has mapped."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    return {line.partition("/dev/shm")[2] for line in lines if "/dev/shm/torch_" in line}
