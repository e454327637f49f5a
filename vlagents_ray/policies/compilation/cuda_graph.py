"""A CUDA graph of a function of tensors: launched as one, without the time that Python takes for each kernel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from vlagents_ray.registry import require

_WARM_UP = 3  # calls before the capture, in which libraries allocate their own memory


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
        """
        torch = require("torch")
        self._inputs = [tensor.clone() for tensor in tensors]
        with torch.cuda.device(self._inputs[0].device):
            stream = torch.cuda.Stream()
            stream.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(stream):
                for _ in range(_WARM_UP):
                    function(*self._inputs)
            torch.cuda.current_stream().wait_stream(stream)
            self._graph = torch.cuda.CUDAGraph()
            # Other checkpoints act meanwhile, on other threads, whose calls must not end the capture.
            with torch.cuda.graph(self._graph, capture_error_mode="thread_local"):
                self._result = function(*self._inputs)

    def __call__(self, *tensors: Any) -> Any:
        """Return the function's result for tensors of the captured shapes, in memory of its own."""
        for held, tensor in zip(self._inputs, tensors, strict=True):
            held.copy_(tensor, non_blocking=True)
        self._graph.replay()
        result = self._result
        return tuple(one.clone() for one in result) if isinstance(result, tuple) else result.clone()
