"""Work on a GPU beside the acts of a policy: on streams of its own, and with pinned memory that is used again.

All threads share torch's default stream, which has the acts. A wait for one's own work there lasts until the end of all
acts that were queued before, and CUDA copies pageable memory in turn with them. As in `trainable`, torch is never
imported here.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_PART = 2**25  # bytes of each of two parts, one of which is filled while the other one is copied
_LOCK = threading.Lock()
# By device: the stream, and two parts of pinned memory, each with the event at the end of its last copy.
_USED: dict[Any, tuple[Any, list[tuple[Any, Any]]]] = {}
_BESIDE: dict[Any, Any] = {}  # the stream of `beside_acts` by device: one, as memory is only used again on its stream


@contextmanager
def beside_acts(device: Any) -> Iterator[None]:
    """Run this thread's work on a GPU within this context on another stream than the acts; it is over at the end.

    It begins after the work that was queued before. Memory that this context allocates may be used again in the next
    one as soon as it is freed, so that work of other streams on it must be over then.

    Args:
        device: The GPU; None: the current one. The context does nothing for "cpu", or while the process uses no GPU.
    """
    torch = sys.modules.get("torch")
    if torch is None or device == "cpu" or not torch.cuda.is_initialized():
        yield
        return
    device = torch.device("cuda", torch.cuda.current_device()) if device is None else device
    with _LOCK:
        stream = _BESIDE.get(device) or _BESIDE.setdefault(device, torch.cuda.Stream(device))
    stream.wait_stream(torch.cuda.current_stream(device))
    try:
        with torch.cuda.stream(stream):
            yield
    finally:
        stream.synchronize()


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
            if device not in _USED:
                with torch.inference_mode(mode=False):  # otherwise they could not be written outside of that mode
                    empty = [torch.empty(_PART, dtype=torch.uint8).pin_memory() for _ in range(2)]
                _USED[device] = torch.cuda.Stream(device), [(memory, torch.cuda.Event()) for memory in empty]
            stream, parts = _USED[device]
            stream.wait_stream(torch.cuda.current_stream(device))
            places = target.view(-1).split(length)
            try:
                with torch.cuda.stream(stream):
                    for number, (part, place) in enumerate(zip(source.reshape(-1).split(length), places, strict=True)):
                        memory, event = parts[number % 2]
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
