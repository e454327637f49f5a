"""Values on a GPU that another process copies directly from GPU memory, through CUDA's interprocess
memory handles.

A handle consists of bytes and numbers, which `SharedValues` contains. It is valid in processes on
the same node that use the same GPU, while the process that created it keeps the memory: see the
section on interprocess communication of https://docs.nvidia.com/cuda/cuda-c-programming-guide/. As
in the module `trainable`, torch is never imported here.
"""

from __future__ import annotations

import logging
import mmap
import sys
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import astuple, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.weights.trainable import dtype_name, is_array, portable

logger = logging.getLogger(__name__)


class NotShared(PolicyUnavailable):
    """The memory cannot be shared with the other process; the values must be sent instead."""


@dataclass(frozen=True, slots=True)
class StorageHandle:
    """The memory of one or more values."""

    allocation: bytes  # CUDA's handle of the allocation that contains the memory
    size: int  # size of the memory, bytes
    begin: int  # offset of the memory in the allocation, bytes
    counters: bytes  # name of torch's shared file with the reader counts
    counter: int  # index of the memory's count in that file


@dataclass(frozen=True, slots=True)
class ValueView:
    """One value in shared memory."""

    storage: int  # key of the memory in `SharedValues.storages`
    dtype: str  # name of a torch dtype: "float32", "bfloat16", …
    begin: int  # index of the first element in the storage
    shape: tuple[int, ...]
    stride: tuple[int, ...]  # strides, elements


@dataclass(frozen=True, slots=True)
class SharedValues:
    """Values by name, most of which are in memory of one GPU."""

    gpu: str  # UUID of the GPU
    storages: dict[int, StorageHandle]  # handles by the memory's address in the learner's process
    views: dict[str, ValueView]
    others: Mapping[str, Any]  # values that are not on a GPU, as returned by `portable`

    def to_json(self) -> dict[str, Any]:
        """Return all fields except `others` as JSON values for `from_json`."""
        storages = {}
        for address, handle in self.storages.items():
            storages[str(address)] = [
                handle.allocation.hex(),
                handle.size,
                handle.begin,
                handle.counters.hex(),
                handle.counter,
            ]
        views = {name: astuple(view) for name, view in self.views.items()}
        return {"gpu": self.gpu, "storages": storages, "views": views}

    @classmethod
    def from_json(cls, node: dict[str, Any], others: Mapping[str, Any]) -> SharedValues:
        """Read the handles that `to_json` returned.

        Args:
            node: The JSON values.
            others: The values that are not on a GPU, by name.
        """
        storages = {}
        for address, fields in node["storages"].items():
            allocation, size, begin, counters, counter = fields
            storages[int(address)] = StorageHandle(
                bytes.fromhex(allocation), size, begin, bytes.fromhex(counters), counter
            )
        views = {}
        for name, (storage, dtype, begin, shape, stride) in node["views"].items():
            views[name] = ValueView(storage, dtype, begin, tuple(shape), tuple(stride))
        return cls(node["gpu"], storages, views, others)


def gpu_of(values: Mapping[str, Any]) -> str:
    """Return the UUID of the GPU that contains all values on GPUs; empty if there is not exactly
    one such GPU.
    """
    gpus = {_MEMORY.gpu(value) for value in values.values()} - {""}
    return gpus.pop() if len(gpus) == 1 else ""


def readable_gpus(gpu: str) -> tuple[str, ...]:
    """Return the UUIDs of the GPUs whose memory this process can copy to `gpu`, including `gpu`.

    The result is empty if `gpu` is empty.
    """
    return _MEMORY.readable(gpu) if gpu else ()


@contextmanager
def shared(values_by_name: Mapping[str, Any]) -> Iterator[SharedValues]:
    """Share values within the context with another process, which reads the memory of the GPU.

    The values must not change meanwhile.

    Args:
        values_by_name: The values. Those on a GPU must all be on the same one, see `gpu_of`.

    Yields:
        The handles of values on the GPU, and the other values.

    Raises:
        NotShared: CUDA cannot share this kind of memory.
    """
    with ExitStack() as stack:
        stack.callback(_MEMORY.collect)  # called after all handles have been released
        others: dict[str, Any] = {}
        shared_values = SharedValues(gpu_of(values_by_name), {}, {}, others)
        devices = set()
        for name, value in values_by_name.items():
            if not _MEMORY.gpu(value):
                others[name] = portable(value) if is_array(value) else value
                continue

            devices.add(value.device)
            storage = value.untyped_storage()
            address = storage.data_ptr()
            if address not in shared_values.storages:  # Tied values share one storage.
                handle = stack.enter_context(_MEMORY.handed_over(storage))
                shared_values.storages[address] = handle
            shared_values.views[name] = ValueView(
                storage=address,
                dtype=dtype_name(value),
                begin=value.storage_offset(),
                shape=tuple(value.shape),
                stride=value.stride(),
            )

        for device in devices:
            _MEMORY.finish(device)
        yield shared_values


@contextmanager
def opened(values: SharedValues) -> Iterator[Mapping[str, Any]]:
    """Open the values of another process.

    Values on a GPU are not copied, so the caller must copy them within the context.

    Args:
        values: The handles and values that `shared` yields in the other process.

    Yields:
        The values by name.

    Raises:
        NotShared: The memory of the other process cannot be opened.
    """
    torch = sys.modules["torch"]
    storages = {}
    try:
        for address, handle in values.storages.items():
            storages[address] = _MEMORY.opened(values.gpu, handle)
    except RuntimeError as error:
        raise NotShared(
            f"the learner's memory on GPU {values.gpu} cannot be opened: {error}"
        ) from error

    devices = {storage.device for storage in storages.values()}
    values_by_name = dict(values.others)
    for name, view in values.views.items():
        dtype = getattr(torch, view.dtype)
        empty = torch.empty(0, dtype=dtype, device=storages[view.storage].device)
        values_by_name[name] = empty.set_(
            storages[view.storage], view.begin, view.shape, view.stride
        )
        del empty
    del storages

    try:
        yield values_by_name
        for device in devices:
            _MEMORY.finish(device)
    finally:
        # The frames of an error may keep a reference to it, and thereby the memory of the other
        # process.
        values_by_name.clear()


_SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - the folder of torch's file of counts
_FIRST_COUNT = 64  # number of bytes before the counts in the file
_COUNT = 8  # the number of bytes of a count


@contextmanager
def counted_reads(counters: bytes, counter: int) -> Iterator[None]:
    """Let torch free the memory that it has shared in this context, however many processes have
    read it.

    Torch keeps such memory while the count of its readers is not 0. The count is initially 1, and
    each reader subtracts 1 when it ends. Without a reader, or with several readers, the count is
    therefore wrong; since it is unsigned, it would never become 0.

    Args:
        counters: The name of torch's file of counts, which exists now.
        counter: The index of the count in it.
    """
    count = _count(counters, counter)
    try:
        yield
    finally:
        if count is not None:
            count[:] = bytes(_COUNT)
        else:
            sys.modules["torch"].UntypedStorage._release_ipc_counter_cuda(counters, counter)


def _count(counters: bytes, counter: int) -> memoryview | None:
    """Return the bytes of a count; None, with a warning, if the file does not have the expected
    layout.
    """
    begin = _FIRST_COUNT + _COUNT * counter
    try:
        count = memoryview(_counts(counters))[begin : begin + _COUNT]
    except OSError as error:
        reason = str(error)
    else:
        value = int.from_bytes(count, sys.byteorder)
        if len(count) == _COUNT and value == 1:
            return count
        reason = f"expected 1 as the first value, got {value}"
    _warn_of_counts(reason)
    return None


@lru_cache(maxsize=16)  # logged once for each reason, not for each value
def _warn_of_counts(reason: str) -> None:
    logger.warning(
        "torch's counts of readers cannot be set (%s): memory that was pushed to replicas on the "
        "same GPU may stay allocated; if it grows, use another version of torch, or other GPUs for "
        "the replicas",
        reason,
    )


@lru_cache(maxsize=4)  # Torch begins another file after 10,000 values.
def _counts(counters: bytes) -> mmap.mmap:
    """Map torch's file of counts into memory.

    The mapping stays valid when torch removes the file.
    """
    with open(_SHARED_MEMORY / counters.decode().lstrip("/"), "r+b") as file:
        return mmap.mmap(file.fileno(), 0)


class _GpuMemory:
    """Shares memory of GPUs.

    Tests replace this object to share CPU memory on machines without a GPU.
    """

    def gpu(self, value: Any) -> str:
        """Return the UUID of the GPU that contains a value; empty if the value is not on a GPU."""
        torch = sys.modules.get("torch")
        if torch is None or type(value) not in (torch.Tensor, torch.nn.Parameter):
            return ""
        # An empty tensor has no memory block, and a sparse tensor has several.
        has_one_memory = value.layout == torch.strided and value.numel()
        return self._uuid(value.device) if value.is_cuda and has_one_memory else ""

    def finish(self, device: Any) -> None:
        """Wait for the work that this thread has queued on a GPU, since other processes do not wait
        for it.

        This synchronizes only the current stream. Synchronizing the device would abort graph
        captures of other threads.
        """
        sys.modules["torch"].cuda.current_stream(device).synchronize()

    @contextmanager
    def handed_over(self, storage: Any) -> Iterator[StorageHandle]:
        """Yield a handle of a torch storage for another process."""
        torch = sys.modules["torch"]
        # Each call of `_share_cuda_` permanently adds a wrapper to the memory of the storage. It is
        # therefore called on another storage of the same memory. The learner's own storage stays
        # unchanged, however often its values are pushed.
        whole = torch.empty(0, dtype=torch.uint8, device=storage.device).set_(storage)
        alias = torch.from_dlpack(whole).untyped_storage()
        try:
            _, allocation, size, begin, counters, counter, _, _ = alias._share_cuda_()
        except RuntimeError as error:
            raise NotShared(
                f"this process cannot hand over its memory on {storage.device}: {error}"
            ) from error
        with counted_reads(counters, counter):
            yield StorageHandle(allocation, size, begin, counters, counter)

    def collect(self) -> None:
        """Free the memory that was handed over, if no other reference to it remains."""
        torch = sys.modules.get("torch")
        if torch is not None and torch.cuda.is_initialized():
            torch.cuda.ipc_collect()

    def opened(self, gpu: str, handle: StorageHandle) -> Any:
        """Return the storage of another process; raises `RuntimeError` if the storage cannot be
        opened.
        """
        torch = sys.modules["torch"]
        uuids = self._visible_uuids()
        if gpu not in uuids:
            raise RuntimeError("this process does not use that GPU")
        # The last two arguments are an event to wait for, which torch would never free here, and
        # whether an event is used. The sender has already waited, see `finish`.
        return torch.UntypedStorage._new_shared_cuda(
            uuids.index(gpu),
            handle.allocation,
            handle.size,
            handle.begin,
            handle.counters,
            handle.counter,
            b"",
            False,
        )

    def readable(self, gpu: str) -> tuple[str, ...]:
        """Return the UUIDs of the visible GPUs whose memory can be copied to `gpu` without a copy
        on the host.
        """
        cuda = sys.modules["torch"].cuda
        uuids = self._visible_uuids()
        index = uuids.index(gpu)
        readable = []
        for i, uuid in enumerate(uuids):
            if i == index or cuda.can_device_access_peer(index, i):
                readable.append(uuid)
        return tuple(readable)

    def _visible_uuids(self) -> list[str]:
        """Return the UUIDs of the GPUs that are visible to this process, in the order of torch's
        indices.
        """
        count = sys.modules["torch"].cuda.device_count()
        return [self._uuid(device) for device in range(count)]

    @staticmethod
    def _uuid(device: Any) -> str:
        return str(sys.modules["torch"].cuda.get_device_properties(device).uuid)


_MEMORY = _GpuMemory()
