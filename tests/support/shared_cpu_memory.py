"""Shared memory of the CPU in place of a GPU's: torch's files of it have the lifetime of CUDA's handles."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from vlagents_ray.weights import shared_values
from vlagents_ray.weights.shared_values import StorageHandle

GPU = "GPU-of-the-test"


class SharedCpuMemory:
    """Takes the CPU for one GPU."""

    def __init__(self, gpu: str = GPU, *peers: str) -> None:
        self.uuid, self.peers = gpu, peers
        self.handles = 0  # that this process has handed out and not taken back

    def install(self) -> None:
        """Let this process hand over tensors on the CPU as if they were on a GPU."""
        shared_values._MEMORY = self  # type: ignore[assignment]

    def gpu(self, value: Any) -> str:
        torch = sys.modules.get("torch")
        return self.uuid if torch is not None and isinstance(value, torch.Tensor) and value.numel() else ""

    def readable(self, gpu: str) -> tuple[str, ...]:
        return gpu, *self.peers

    def finish(self, device: Any) -> None:
        assert str(device) == "cpu"

    @contextmanager
    def handed_over(self, storage: Any) -> Iterator[StorageHandle]:
        manager, file, size = storage._share_filename_cpu_()  # moves the values there, so that writes are seen by all
        self.handles += 1
        try:
            yield StorageHandle(file, size, 0, manager, 0)
        finally:
            self.handles -= 1

    def opened(self, gpu: str, handle: StorageHandle) -> Any:
        import torch

        if gpu not in self.readable(self.uuid):
            raise RuntimeError("this process does not use that GPU")
        return torch.UntypedStorage._new_shared_filename_cpu(handle.counters, handle.allocation, handle.size)


def files_of_torch() -> set[str]:
    """The files of shared memory that this process has mapped."""
    lines = Path("/proc/self/maps").read_text().splitlines()
    return {line.partition("/dev/shm")[2] for line in lines if "/dev/shm/torch_" in line}
