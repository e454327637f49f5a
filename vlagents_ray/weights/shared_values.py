"""Values on a GPU that another process copies from where they are, by CUDA's handles for memory of other processes.

A handle is bytes and numbers, and `SharedValues` holds just these. It is good in processes of the same node that use
the same GPU, while the process that made it keeps the memory: see the part on interprocess communication of
https://docs.nvidia.com/cuda/cuda-c-programming-guide/. Torch is never imported here, as in `trainable`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.weights.trainable import dtype_name, is_array, portable


class NotShared(PolicyUnavailable):
    """The memory cannot be handed to the other process; the values must be sent instead."""


@dataclass(frozen=True, slots=True)
class StorageHandle:
    """The memory of one or more values."""

    allocation: bytes  # CUDA's handle of the allocation in which it is
    size: int  # bytes
    begin: int  # byte of the allocation at which it begins
    counters: bytes  # torch's shared file with the counts of readers
    counter: int  # place of its count in that file


@dataclass(frozen=True, slots=True)
class ValueView:
    """One value in shared memory."""

    storage: int  # its key in `SharedValues.storages`
    dtype: str  # of torch: "float32", "bfloat16", …
    begin: int  # element of the storage at which it begins
    shape: tuple[int, ...]
    stride: tuple[int, ...]  # elements


@dataclass(frozen=True, slots=True)
class SharedValues:
    """Values by name, most of which are in memory of one GPU."""

    gpu: str  # UUID
    storages: dict[int, StorageHandle]  # by their addresses in the learner's process
    views: dict[str, ValueView]
    others: dict[str, Any]  # those that are not on a GPU, as `portable` returns them


def gpu_of(named: Mapping[str, Any]) -> str:
    """Return the UUID of the GPU that holds all values; empty if there is no single one."""
    gpus = {_MEMORY.gpu(value) for value in named.values()} - {""}
    return gpus.pop() if len(gpus) == 1 else ""


@contextmanager
def shared(named: Mapping[str, Any]) -> Iterator[SharedValues]:
    """Yield values by name for another process, those on the GPU on one (`gpu_of`); they stay unchanged meanwhile.

    Raises:
        NotShared: The memory is of a kind that CUDA does not hand over.
    """
    with ExitStack() as stack:
        values, devices = SharedValues(gpu_of(named), {}, {}, {}), set()
        for name, value in named.items():
            if not _MEMORY.gpu(value):
                values.others[name] = portable(value) if is_array(value) else value
                continue
            devices.add(value.device)
            storage = value.untyped_storage()
            address, begin = storage.data_ptr(), value.storage_offset()
            if address not in values.storages:  # tied values have one storage
                values.storages[address] = stack.enter_context(_MEMORY.handed_over(storage))
            values.views[name] = ValueView(address, dtype_name(value), begin, tuple(value.shape), value.stride())
        for device in devices:
            _MEMORY.finish(device)
        yield values


@contextmanager
def opened(values: SharedValues) -> Iterator[Mapping[str, Any]]:
    """Yield another process's values by name, those on a GPU where they are; copy them. Raises `NotShared`."""
    torch = sys.modules["torch"]
    try:
        storages = {address: _MEMORY.opened(values.gpu, handle) for address, handle in values.storages.items()}
    except RuntimeError as error:
        raise NotShared(f"the learner's memory on GPU {values.gpu} cannot be opened: {error}") from error
    devices = {storage.device for storage in storages.values()}
    named = dict(values.others)
    for name, view in values.views.items():
        empty = torch.empty(0, dtype=getattr(torch, view.dtype), device=storages[view.storage].device)
        named[name] = empty.set_(storages[view.storage], view.begin, view.shape, view.stride)
    del storages, empty
    try:
        yield named
        for device in devices:
            _MEMORY.finish(device)
    finally:
        named.clear()  # an error has frames that refer to it


class _GpuMemory:
    """Hands over memory of GPUs. Tests replace it, to share memory of the CPU where there is no GPU."""

    def gpu(self, value: Any) -> str:
        """Return the UUID of the GPU on which a value is; empty if it is on none."""
        torch = sys.modules.get("torch")
        if torch is None or type(value) not in (torch.Tensor, torch.nn.Parameter):
            return ""
        # An empty tensor has no memory, and a sparse one has several.
        on_gpu = value.is_cuda and value.layout == torch.strided and value.numel()
        return self._uuid(value.device) if on_gpu else ""

    def finish(self, device: Any) -> None:
        """Wait until what this thread began on a GPU is done, for which another process does not wait.

        It waits for the current stream, not for the device, which would end the captures of other threads.
        """
        sys.modules["torch"].cuda.current_stream(device).synchronize()

    @contextmanager
    def handed_over(self, storage: Any) -> Iterator[StorageHandle]:
        """Yield a handle of a torch storage for another process."""
        torch = sys.modules["torch"]
        # Each call of `_share_cuda_` wraps the memory of the storage once more, for good. So it gets another storage of
        # the same memory, and the learner's own stays as it is, however often it is pushed.
        whole = torch.empty(0, dtype=torch.uint8, device=storage.device).set_(storage)
        alias = torch.from_dlpack(whole).untyped_storage()
        try:
            _, allocation, size, begin, counters, counter, _, _ = alias._share_cuda_()
        except RuntimeError as error:
            raise NotShared(f"this process cannot hand over its memory on {storage.device}: {error}") from error
        try:
            yield StorageHandle(allocation, size, begin, counters, counter)
        finally:
            # Torch keeps memory that it has sent until a reader has let go of it, and maybe there was none.
            torch.UntypedStorage._release_ipc_counter_cuda(counters, counter)

    def opened(self, gpu: str, handle: StorageHandle) -> Any:
        """Return the storage of another process; raises `RuntimeError` if it cannot be reached."""
        torch = sys.modules["torch"]
        devices = [device for device in range(torch.cuda.device_count()) if self._uuid(device) == gpu]
        if not devices:
            raise RuntimeError("this process does not use that GPU")
        # The last two are an event to wait for, which torch would never free here, and whether there is one. The sender
        # has waited, see `finish`.
        return torch.UntypedStorage._new_shared_cuda(
            devices[0], handle.allocation, handle.size, handle.begin, handle.counters, handle.counter, b"", False
        )

    @staticmethod
    def _uuid(device: Any) -> str:
        return str(sys.modules["torch"].cuda.get_device_properties(device).uuid)


_MEMORY = _GpuMemory()
