"""Copies between host memory and a GPU, through pinned memory that is used again, on a stream of their own.

CUDA copies pageable memory on the stream of the acts, which would wait for all of it. As in `trainable`, torch is never
imported here.
"""

from __future__ import annotations

import sys
import threading
from typing import Any

_PART = 2**25  # bytes of each of two parts, one of which is filled while the other one is copied
_LOCK = threading.Lock()
_PARTS: list[tuple[Any, Any]] = []  # pinned memory, and the event at the end of its last copy
_STREAMS: dict[Any, Any] = {}  # by device


def copy(source: Any, target: Any) -> Any:
    """Copy a tensor into a contiguous one of the same shape, and return that one.

    If only one of them is on a GPU, the copy begins after the work that this thread has queued there, and is over when
    this returns.
    """
    torch = sys.modules["torch"]
    with torch.no_grad():
        if source.is_cuda == target.is_cuda or not target.numel():
            return target.copy_(source)
        device, dtype = next((one.device, one.dtype) for one in (source, target) if one.is_cuda)
        length = _PART // dtype.itemsize
        with _LOCK, torch.cuda.device(device):
            while len(_PARTS) < 2:
                with torch.inference_mode(mode=False):  # otherwise it could not be written outside of that mode
                    _PARTS.append((torch.empty(_PART, dtype=torch.uint8).pin_memory(), torch.cuda.Event()))
            stream = _STREAMS.setdefault(device, torch.cuda.Stream(device))
            stream.wait_stream(torch.cuda.current_stream(device))
            places = target.view(-1).split(length)
            try:
                with torch.cuda.stream(stream):
                    for number, (part, place) in enumerate(zip(source.reshape(-1).split(length), places, strict=True)):
                        memory, event = _PARTS[number % 2]
                        event.synchronize()
                        pinned = memory[: len(part) * dtype.itemsize].view(dtype)
                        pinned.copy_(part, non_blocking=True)
                        if place.is_cuda:
                            place.copy_(pinned, non_blocking=True)
                        event.record(stream)
                        if not place.is_cuda:
                            event.synchronize()
                            place.copy_(pinned)
            finally:
                stream.synchronize()  # the memory may be freed, or used on other streams, from now on
    return target
