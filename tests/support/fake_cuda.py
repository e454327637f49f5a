"""A simulation of CUDA with two devices on a CPU, with torch's streams, graphs and errors, for
tests without a GPU.

A tensor of `FakeCuda.tensor` computes on the CPU but reports a GPU as its device. While a graph is
captured, the operations of its stream are recorded, and their results are then overwritten, since a
capture computes nothing; a replay computes them again from the same tensors. The rules are those of
CUDA, or stricter:

- A capture fails, on both threads, if another thread waits for its device or makes a tensor there.
- An operation on another stream or device than the captured one runs at once and is not recorded.
- `torch.cuda.graph` uses one stream for all captures of a process, on the device of the first
  capture.
- With `install_copies`, a copy from pinned memory on a stream other than the default one is made
  only when a stream waits for an event after it; until then its destination contains garbage.
- The graphs of a memory pool share memory: a replay overwrites the results of all other graphs in
  the pool.
- A GPU's time is the number of replayed operations, in milliseconds.
- After `fail`, every call fails. A tensor of more than `most_rows` rows does not fit into memory.
"""

from __future__ import annotations

import sys
import threading
import warnings
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map

_EMPTY = (
    "The CUDA Graph is empty. This usually means that the graph was attempted to be captured "
    "on wrong device or stream."
)
_GARBAGE = 55  # value of memory that a capture has not written


class FakeCuda:
    """The GPUs of the process. `install` replaces torch's own functions."""

    def __init__(self) -> None:
        self.capture: Capture | None = None  # the capture in progress
        self.failure = ""
        self.most_rows = sys.maxsize
        self.emptied = 0  # calls of `empty_cache`
        self.pinned: list[torch.Tensor] = []
        self.clock_ms = 0.0  # common clock of all GPUs
        self.captures: list[Capture] = []  # all captures since the start
        self.replays: list[Capture] = []  # the graph of each replay
        self.reserved = [0, 0]  # bytes reserved for graphs on each device
        self.memory = Memory()
        # Streams and bytes of copies between GPU and host.
        self.transfers: list[tuple[Stream, int]] = []
        self._local = threading.local()
        self._default = [Stream(self, index) for index in range(2)]
        self._capture_stream: Stream | None = None

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Replace the parts of `torch.cuda` that policies use, and disable compilation."""
        for name, value in {
            "is_available": lambda: True,
            "is_initialized": lambda: True,
            "Stream": lambda device=None, priority=0: Stream(
                self, self._index(device), priority=priority
            ),
            "stream": self._on_stream,
            "device": self._on_device,
            "current_device": lambda: self._index(None),
            "current_stream": self.current_stream,
            "synchronize": self.synchronize,
            "empty_cache": self._empty_cache,
            "CUDAGraph": lambda: Capture(self),
            "Event": lambda **_: Event(self),
            "graph_pool_handle": object,
            "memory_allocated": lambda _=None: self.memory.allocated,
            "memory_reserved": lambda device=None: (
                self.memory.allocated + self.reserved[self._index(device)]
            ),
            "mem_get_info": lambda _=None: (
                self.memory.total - self.memory.allocated,
                self.memory.total,
            ),
            "graph": self._graph,
        }.items():
            patch.setattr(torch.cuda, name, value)
        patch.setattr(torch, "compile", lambda function, **_: function)
        patch.setattr(torch.Tensor, "pin_memory", lambda self: self)

    def install_copies(self, patch: pytest.MonkeyPatch) -> None:
        """Replace pinned memory and the copies from it; a copy that would wait for its stream
        raises an error.
        """
        empty, pin, to, pinned = torch.empty, torch.Tensor.clone, torch.Tensor.to, set[int]()

        def hold(tensor: torch.Tensor, held: bool = True) -> torch.Tensor:
            if held:
                pinned.add(tensor.data_ptr())
                # The memory stays in use, so that no other tensor gets the same address.
                self.pinned.append(tensor)
            return tensor

        def copy(
            tensor: torch.Tensor, *args: Any, non_blocking: bool = False, **kwargs: Any
        ) -> Any:
            device = args[0] if args else None
            if (
                isinstance(tensor, GpuTensor)
                or not isinstance(device, torch.device)
                or device.type != "cuda"
            ):
                return to(tensor, *args, non_blocking=non_blocking, **kwargs)
            if not non_blocking or tensor.data_ptr() not in pinned:
                raise AssertionError(
                    "the copy waits for its stream: expected pinned memory and non_blocking"
                )
            made = self.tensor(torch.full_like(tensor, _GARBAGE), self._index(device))
            stream = self.current_stream(device)
            stream.pending.append(lambda: made.values.copy_(tensor))
            if stream in self._default:
                stream.run_pending()
            return made

        patch.setattr(
            torch,
            "empty",
            lambda *size, pin_memory=False, **kwargs: hold(empty(*size, **kwargs), pin_memory),
        )
        patch.setattr(torch.Tensor, "pin_memory", lambda tensor: hold(pin(tensor)))
        patch.setattr(torch.Tensor, "to", copy)

    def tensor(self, values: torch.Tensor, index: int = 0) -> GpuTensor:
        """Return a tensor of these values on a simulated GPU."""
        return GpuTensor(values, self, index)

    def fail(self, said: str = "CUDA error: device-side assert triggered") -> None:
        """Let all further calls fail with the message `said`."""
        self.failure = said

    def current_stream(self, device: Any = None) -> Stream:
        """Return this thread's current stream on a device."""
        index = self._index(device)
        stream: Stream = self._streams().get(index, self._default[index])
        return stream

    def synchronize(self, device: Any = None) -> None:
        """Wait for a device, which ends a capture on it."""
        self._require(self._index(device))

    def run(self, index: int, call: Callable[[], Any], inputs: list[Any]) -> Any:
        """Run an operation on a device, and record it if its stream is captured."""
        capture = self.capture
        if capture is None or capture.thread != threading.get_ident():
            self._require(index)
        # An operation begins after the copies that were queued on its stream before it.
        self.current_stream(index).run_pending()
        result = call()
        if any(
            isinstance(one, torch.Tensor) and one.ndim and len(one) > self.most_rows
            for one in tree_leaves(result)
        ):
            raise torch.OutOfMemoryError(
                "CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has 1.00 GiB free"
            )
        if capture is not None and capture.stream is self.current_stream(index):
            capture.calls.append((call, result, inputs))
        return result

    def _require(self, index: int) -> None:
        if self.failure:
            raise torch.AcceleratorError(self.failure, 710)
        if (capture := self.capture) is not None and capture.stream.index == index:
            capture.broken = True
            raise torch.AcceleratorError(
                "CUDA error: operation not permitted when stream is capturing", 900
            )

    def _streams(self) -> dict[int, Stream]:
        streams: dict[int, Stream] = self._local.__dict__.setdefault("streams", {})
        return streams

    def _index(self, device: Any) -> int:
        current: int = self._local.__dict__.get("device", 0)
        if device is None or isinstance(device, int):
            return current if device is None else device
        return torch.device(device).index or 0

    def _empty_cache(self) -> None:
        self.emptied += 1

    @contextmanager
    def _on_device(self, device: Any) -> Iterator[None]:
        before, self._local.device = self._index(None), self._index(device)
        try:
            yield
        finally:
            self._local.device = before

    @contextmanager
    def _on_stream(self, stream: Stream) -> Iterator[None]:
        before = self.current_stream(self._gpu(stream))
        self._streams()[stream.index] = stream
        try:
            yield
        finally:
            self._streams()[stream.index] = before

    @contextmanager
    def _graph(
        self,
        capture: Capture,
        pool: Any = None,
        stream: Stream | None = None,
        capture_error_mode: str = "global",
    ) -> Iterator[None]:
        self.captures.append(capture)
        capture.pool = pool
        self._capture_stream = self._capture_stream or Stream(self, self._index(None))
        capture.stream = stream or self._capture_stream
        self.synchronize()
        self._empty_cache()
        before = self.current_stream(self._gpu(capture.stream))
        self._streams()[capture.stream.index] = capture.stream
        capture.thread, self.capture = threading.get_ident(), capture
        try:
            yield
        finally:
            self.capture = None
            capture.end()  # torch does not restore the stream if this fails
            self._streams()[capture.stream.index] = before

    @staticmethod
    def _gpu(stream: Stream) -> torch.device:
        return torch.device("cuda", stream.index)


class Memory:
    """The number of bytes of the tensors on all GPUs, each memory counted once, and the peak of
    this number.
    """

    def __init__(self) -> None:
        self.allocated = self.peak = 0
        self.total = 80 * 10**9
        self._tensors: Counter[int] = Counter()  # number of tensors by the address of their memory

    def add(self, tensor: GpuTensor) -> None:
        """Count a tensor until it is deleted."""
        storage = tensor.values.untyped_storage()
        address, size = storage.data_ptr(), storage.nbytes()
        self._tensors[address] += 1
        if self._tensors[address] == 1:
            self.allocated += size
            self.peak = max(self.peak, self.allocated)
        weakref.finalize(tensor, self._deleted, address, size)

    def _deleted(self, address: int, size: int) -> None:
        self._tensors[address] -= 1
        if not self._tensors[address]:
            self.allocated -= size


@dataclass(eq=False)
class Stream:
    """A stream of one GPU. Only the copies of `install_copies` are delayed; all other operations
    run at once.
    """

    cuda: FakeCuda
    index: int
    priority: int = 0
    # Copies that no stream has waited for.
    pending: list[Callable[[], object]] = field(default_factory=list)
    synchronized: int = 0  # number of calls of `synchronize`
    waited_for: list[Stream] = field(default_factory=list)  # arguments of `wait_stream`

    def record_event(self) -> Event:
        """Return an event after all copies so far."""
        event = Event(self.cuda)
        event.record(self)
        return event

    def wait_event(self, event: Event) -> None:
        """Make the copies that were queued before the event."""
        if event.stream is not None:
            event.stream.run_pending()

    def run_pending(self) -> None:
        """Make all queued copies."""
        while self.pending:
            self.pending.pop(0)()

    def wait_stream(self, other: Stream) -> None:
        """Make the queued copies of another stream, and record that stream."""
        self.waited_for.append(other)
        other.run_pending()

    def synchronize(self) -> None:
        """Wait for the stream, which is an error if it is captured."""
        self.synchronized += 1
        if self.cuda.failure or (
            self.cuda.capture is not None and self.cuda.capture.stream is self
        ):
            self.cuda._require(self.index)


@dataclass(eq=False)
class Event:
    """A `torch.cuda.Event`, which is always completed."""

    cuda: FakeCuda
    ms: float | None = None
    stream: Stream | None = None  # the first stream on which the event was recorded

    def record(self, stream: Stream | None = None) -> None:
        """Record the time and the stream. The stream must be on the same GPU as before, and may
        have only copies outstanding.
        """
        stream = stream or self.cuda.current_stream()
        stream.synchronize()
        assert self.stream is None or self.stream.index == stream.index, (
            "Event device does not match the stream's"
        )
        self.ms, self.stream = self.cuda.clock_ms, stream

    def query(self) -> bool:
        """Return True, since the event is completed."""
        return True

    def synchronize(self) -> None:
        """Do nothing, since the event is completed."""

    def elapsed_time(self, end: Event) -> float:
        """Return the time until another event, ms."""
        assert self.ms is not None
        assert end.ms is not None
        return end.ms - self.ms


@dataclass(eq=False)
class Capture:
    """A `torch.cuda.CUDAGraph`."""

    cuda: FakeCuda
    # The recorded calls, with result and arguments.
    calls: list[tuple[Callable[[], Any], Any, list[Any]]] = field(default_factory=list)
    broken: bool = False
    thread: int = 0
    stream: Any = None
    pool: Any = None

    def end(self) -> None:
        """Raise an error if another thread ended the capture; overwrite all results, since none was
        computed.
        """
        if self.broken:
            raise torch.AcceleratorError(
                "CUDA error: operation failed due to a previous error during capture", 901
            )
        if not self.calls:
            warnings.warn(_EMPTY, stacklevel=2)
        self.cuda.reserved[self.stream.index] += sum(result.nbytes for result in self._results())
        self.spoil()

    def _results(self) -> Iterator[torch.Tensor]:
        """Yield the result tensors in the memory of this graph's pool."""
        for _, result, inputs in self.calls:
            own = {one.untyped_storage().data_ptr() for one in inputs}
            for one in tree_leaves(result):
                if isinstance(one, torch.Tensor) and one.untyped_storage().data_ptr() not in own:
                    yield one

    @torch.inference_mode()
    def spoil(self) -> None:
        """Overwrite all results."""
        for one in self._results():
            one.fill_(_GARBAGE)

    @torch.inference_mode()  # the tensors may have been made in inference mode
    def replay(self) -> None:
        """Compute all results again in their memory, and overwrite the results of other graphs in
        the pool.
        """
        self.cuda._require(self.stream.index)
        for other in self.cuda.captures:
            if other.pool is not None and other.pool is self.pool and other is not self:
                other.spoil()
        self.cuda.replays.append(self)
        self.cuda.clock_ms += len(self.calls)
        for call, result, _ in self.calls:
            for old, new in zip(tree_leaves(result), tree_leaves(call()), strict=True):
                if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


class HostCopies(TorchFunctionMode):  # type: ignore[misc]
    """Within this context, `torch.tensor` copies to a simulated GPU. A capture forbids such a copy
    unless the data is empty.
    """

    def __init__(self, cuda: FakeCuda) -> None:
        super().__init__()
        self._cuda = cuda

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given = dict(kwargs or {})
        if func is not torch.tensor or given.get("device") is None:
            return func(*args, **given)
        index = self._cuda._index(given.pop("device"))
        numbers = torch.tensor(*args, **given)
        if numbers.numel():
            self._cuda._require(index)
        return self._cuda.tensor(numbers, index)


class GpuTensor(torch.Tensor):
    """A tensor whose operations run through a `FakeCuda`."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    values: torch.Tensor  # the values, on the CPU
    cuda_of: FakeCuda
    index: int
    streams: list[Stream]  # arguments of `record_stream`

    @staticmethod
    def __new__(cls: Any, values: torch.Tensor, cuda: FakeCuda, index: int) -> GpuTensor:
        made: GpuTensor = torch.Tensor._make_wrapper_subclass(
            cls,
            values.shape,
            strides=values.stride(),
            storage_offset=values.storage_offset(),
            dtype=values.dtype,
        )
        made.values, made.cuda_of, made.index = values, cuda, index
        made.streams = []
        cuda.memory.add(made)
        return made

    def record_stream(self, stream: Any) -> None:
        """Record the stream; the memory is not reused before its operations end."""
        self.streams.append(stream)

    def data_ptr(self) -> int:
        return self.values.data_ptr()

    @property
    def device(self) -> Any:  # type: ignore[override]
        return torch.device("cuda", self.index)

    @property
    def is_cuda(self) -> bool:  # type: ignore[override]
        return True

    def untyped_storage(self) -> Any:
        """Return the storage of the values on the CPU."""
        return self.values.untyped_storage()

    @classmethod
    def __torch_dispatch__(cls, op: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        own = [one for one in tree_leaves((args, kwargs)) if isinstance(one, GpuTensor)]
        cuda, index = own[0].cuda_of, own[0].index
        if op is torch.ops.aten.copy_.default and len(own) == 1:
            cuda.transfers.append((cuda.current_stream(index), own[0].nbytes))
        args, kwargs = tree_map(_values, (args, kwargs or {}))
        inputs = [one.values for one in own]
        result = cuda.run(index, lambda: op(*args, **kwargs), inputs)
        # An in-place operation returns one of its arguments.
        wrappers = {id(one.values): one for one in own}

        on_host = {
            id(one) for one in tree_leaves((args, kwargs)) if isinstance(one, torch.Tensor)
        } - {*map(id, inputs)}

        def wrapped(one: Any) -> Any:
            if not isinstance(one, torch.Tensor) or id(one) in on_host:
                return one
            return wrappers[id(one)] if id(one) in wrappers else GpuTensor(one, cuda, index)

        return tree_map(wrapped, result)


def _values(one: Any) -> Any:
    return one.values if isinstance(one, GpuTensor) else one
