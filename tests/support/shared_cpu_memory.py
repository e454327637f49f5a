"""Shared CPU memory that simulates a GPU's memory: torch's shared files have the same lifetime as
CUDA's handles.

Readers are counted like the readers of a GPU's memory in torch 2.13 (torch/csrc/CudaIPCTypes.cpp
and StorageSharing.cpp): in a shared file with a header of 64 bytes, as unsigned numbers, and with a
limbo list for memory that was freed before its readers ended.
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
    """Torch's reference counts of the readers of memory that this process has sent."""

    def __init__(self) -> None:
        # Readers keep the files of counts open by name. So names are never reused, as in torch.
        self.name = f"/readers_{os.getpid()}_{next(_FILES)}"
        self.next = 0
        self.limbo: list[tuple[int, Any]] = []  # slots and their storages
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
        """Decrement a count, in any process; a missing file is not an error."""
        if (_FOLDER / name[1:]).exists():
            cls._change(name, slot, -1)

    def delete(self, slot: int, storage: Any) -> None:
        """Free memory that its owner no longer needs; memory with readers moves to the
        limbo list.
        """
        self.limbo.append((slot, storage))
        self.collect()

    def collect(self) -> None:
        """Free memory in the limbo list that has no readers."""
        self.limbo = [(slot, storage) for slot, storage in self.limbo if self.value(slot) > 0]

    def value(self, slot: int) -> int:
        """Return a count as torch reads it, as an unsigned number."""
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
    """Presents the CPU as one GPU."""

    def __init__(self, gpu: str = GPU, *peers: str) -> None:
        self.uuid, self.peers = gpu, peers
        self.handles = 0  # number of handles that this process has created and not released
        self.counts = ReaderCounts()

    def install(self) -> None:
        """Let this process share tensors on the CPU as if they were on a GPU."""
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
        # Moves the values into shared memory, so that all processes see later writes.
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
    """Return the files of shared memory that this process has mapped."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    return {line.partition("/dev/shm")[2] for line in lines if "/dev/shm/torch_" in line}
