"""Eager functions that a CUDA graph can capture, although they copy constants from the host."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

_COPIES = (torch.tensor, torch.as_tensor, torch.Tensor.to, torch.Tensor.cuda)


class Capturable(TorchFunctionMode):  # type: ignore[misc]
    """A core whose later calls reuse the tensors that its first call copied from the host.

    Copies from the host are not allowed during a capture. The copies are the same in each call,
    because a core depends on nothing but its arguments, so they are identified by their order. A
    core whose first call copied no elements is called directly. Otherwise, each operation of a
    capture would take more time, and inference calls of other policies wait during a capture. The
    cache of `autocast` for casts of weights is disabled: it is freed at the end of the context,
    while the graph continues to exist.
    """

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__()
        self._function, self._calls = function, 0
        self._was_called = False
        # The results of the calls of `_COPIES`. A result is None if the call copied no elements
        # from the host.
        self._copied: list[Any] = []

    def __call__(self, *tensors: Any) -> Any:
        cached, self._calls = torch.is_autocast_cache_enabled(), 0
        torch.set_autocast_cache_enabled(False)
        has_copies = any(copied is not None for copied in self._copied)
        is_watched = has_copies or not self._was_called
        try:
            with self if is_watched else nullcontext():
                result = self._function(*tensors)
        finally:
            torch.set_autocast_cache_enabled(cached)
        self._was_called = True
        return result

    def __torch_function__(
        self,
        func: Any,
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        if func not in _COPIES:
            return func(*args, **(kwargs or {}))

        number = self._calls
        self._calls += 1
        copied = self._copied[number] if number < len(self._copied) else None
        if copied is not None:
            return copied.clone()

        result = func(*args, **(kwargs or {}))
        if number == len(self._copied):
            from_gpu = any(isinstance(arg, torch.Tensor) and arg.is_cuda for arg in args)
            is_copied = result.is_cuda and not from_gpu and bool(result.numel())
            self._copied.append(result if is_copied else None)
        return result
