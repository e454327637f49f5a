"""Copies between host memory and a GPU, through pinned memory that is used again, on a stream of their own.

CUDA copies pageable memory on the stream of the acts, which would wait for all of it. As in `trainable`, torch is never
imported here.
"""

from __future__ import annotations

import sys
import threading
from collections import deque
from collections.abc import Callable
from typing import Any

_PART = 32 * 2**20  # bytes of each of two parts, one of which is filled while the other one is copied


class PinnedCopies:
    """Copies tensors, one at a time. Thread-safe; 64 MiB of host memory stay pinned after the first copy."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._parts: list[tuple[Any, Any]] = []  # pinned memory, and the event at the end of its last copy
        self._streams: dict[Any, Any] = {}  # by device

    def copy(self, source: Any, target: Any) -> None:
        """Copy a tensor into a contiguous one of the same shape, and wait for the copy if only one is on a GPU.

        It begins after the work that this thread has queued on that GPU.
        """
        torch = sys.modules["torch"]
        with torch.no_grad():
            if source.is_cuda == target.is_cuda or not target.numel():
                target.copy_(source)
                return
            device = (source if source.is_cuda else target).device
            with self._lock, torch.cuda.device(device):
                if (stream := self._streams.get(device)) is None:
                    stream = self._streams[device] = torch.cuda.Stream(device)
                stream.wait_stream(torch.cuda.current_stream(device))
                try:
                    with torch.cuda.stream(stream):
                        self._copy_parts(source.reshape(-1), target.view(-1), stream)
                finally:
                    stream.synchronize()  # the memory may be freed, or used on other streams, from now on

    def _copy_parts(self, source: Any, target: Any, stream: Any) -> None:
        torch = sys.modules["torch"]
        while len(self._parts) < 2:
            with torch.inference_mode(mode=False):  # others could not be written outside of it
                self._parts.append((torch.empty(_PART, dtype=torch.uint8).pin_memory(), torch.cuda.Event()))
        dtype = (source if source.is_cuda else target).dtype
        length = _PART // dtype.itemsize
        unfinished: deque[Callable[[], None]] = deque()
        for number, (part, place) in enumerate(zip(source.split(length), target.split(length), strict=True)):
            if len(unfinished) == len(self._parts):
                unfinished.popleft()()
            memory, event = self._parts[number % 2]
            pinned = memory[: len(part) * dtype.itemsize].view(dtype)
            pinned.copy_(part, non_blocking=part.is_cuda)
            if place.is_cuda:
                place.copy_(pinned, non_blocking=True)
            event.record(stream)

            def finish(place: Any = place, pinned: Any = pinned, event: Any = event) -> None:
                event.synchronize()
                if not place.is_cuda:
                    place.copy_(pinned)

            unfinished.append(finish)
        for finish in unfinished:
            finish()


PINNED = PinnedCopies()
