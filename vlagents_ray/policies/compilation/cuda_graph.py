"""A CUDA graph of a function of tensors: launched as one, without the time that Python takes for each kernel."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from vlagents_ray.registry import require

_WARM_UP = 3  # calls before the capture, in which libraries allocate their own memory
_EMPTY = "CUDA Graph is empty"  # in torch's warning


class CaptureLock:
    """Keeps acts, of which it is the context, and pushes of weights out of the captures of this process.

    A call that waits for a whole device ends any capture on it, with an error on both threads, whatever the mode of the
    capture. A waiting capture goes before the next act, but waits for a push without delaying acts.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._acting: set[int] = set()  # threads
        self._capturing = False  # or about to
        self.pushes = threading.RLock()  # the context of a push, within which its thread may also act

    def __enter__(self) -> None:
        """Begin an act: wait for the end of a capture. None begins until its end; a thread enters once at a time."""
        with self._changed:
            self._changed.wait_for(lambda: not self._capturing)
            self._acting.add(threading.get_ident())

    def __exit__(self, *_: object) -> None:
        """End an act."""
        with self._changed:
            self._acting.discard(threading.get_ident())
            self._changed.notify_all()

    @contextmanager
    def capture(self) -> Iterator[None]:
        """Wait for running acts and pushes; none begins within this context.

        Raises:
            RuntimeError: This thread acts itself.
        """
        if threading.get_ident() in self._acting:
            raise RuntimeError("a CUDA graph cannot be captured within an act; capture it in Agent.initialize")
        with self.pushes:
            try:
                with self._changed:
                    self._capturing = True
                    self._changed.wait_for(lambda: not self._acting)
                yield
            finally:
                with self._changed:
                    self._capturing = False
                    self._changed.notify_all()


CAPTURES = CaptureLock()


class CudaGraph:
    """A function, captured once with inputs of one shape; calls copy their inputs to where the graph reads them.

    It is captured here, and not by `torch.compile`, whose graphs belong to the thread that captured them: a checkpoint
    is loaded on another thread than the one that acts with it.
    """

    def __init__(self, function: Callable[..., Any], tensors: Sequence[Any]) -> None:
        """Capture a function, which must return a tensor, or a tuple of them, and have no other effect.

        Args:
            function: The function.
            tensors: Its arguments, on one GPU, whose values do not matter.

        Raises:
            RuntimeError: The function cannot be captured, or none of its work was.
        """
        torch = require("torch")
        self._inputs, device = [tensor.clone() for tensor in tensors], tensors[0].device
        # The stream is named, since torch's own one is on the device of the first capture of the process. The current
        # one is entered again, since `torch.cuda.graph` leaves its own if the capture fails.
        own, current = torch.cuda.Stream(device), torch.cuda.current_stream(device)
        with torch.cuda.device(device), torch.cuda.stream(current):
            own.wait_stream(current)
            with torch.cuda.stream(own):
                for _ in range(_WARM_UP):
                    function(*self._inputs)
            current.wait_stream(own)
            self._graph = torch.cuda.CUDAGraph()
            with CAPTURES.capture(), warnings.catch_warnings(record=True) as said:
                warnings.simplefilter("always")
                # Preparations of acts go on meanwhile, on other threads, whose calls must not end the capture.
                with torch.cuda.graph(self._graph, stream=own, capture_error_mode="thread_local"):
                    self._result = function(*self._inputs)
        if any(_EMPTY in str(warning.message) for warning in said):
            raise RuntimeError("the CUDA graph is empty: all work ran on another stream, or on another device")

    def __call__(self, *tensors: Any) -> Any:
        """Return the function's result for tensors of the captured shapes, in memory of its own."""
        for held, tensor in zip(self._inputs, tensors, strict=True):
            held.copy_(tensor, non_blocking=True)
        self._graph.replay()
        result = self._result
        return tuple(one.clone() for one in result) if isinstance(result, tuple) else result.clone()
