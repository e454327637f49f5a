"""A repetition of a computation with other rounding errors, to measure the numerical noise of a
checkpoint.

This is Monte Carlo arithmetic (Parker 1997, https://web.cs.ucla.edu/~stott/mca/): each 16-bit
result is changed by a random fraction of its last digit. Another order of summation, or another
kernel, changes a result by a similar amount.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

_ROUNDED = (torch.float16, torch.bfloat16)


class OtherRounding(TorchDispatchMode):  # type: ignore[misc]
    """A context in which 16-bit results are rounded differently.

    It has its own random generators, so that the process's generators are not changed.
    """

    def __init__(self) -> None:
        super().__init__()
        self.types: set[str] = set()  # the types of the results, such as "bfloat16"
        self._generators: dict[Any, Any] = {}  # device -> generator

    def run(self, function: Callable[..., Any], *tensors: Any) -> Any:
        """Return the function's result.

        The cache of `autocast` for casts of weights is disabled, since casts are also rounded
        differently.
        """
        cached = torch.is_autocast_cache_enabled()
        torch.set_autocast_cache_enabled(False)
        try:
            with self:
                return function(*tensors)
        finally:
            torch.set_autocast_cache_enabled(cached)

    def __torch_dispatch__(
        self,
        func: Any,
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        if any(returned.alias_info is not None for returned in func._schema.returns):
            return result  # The result is a view, or the operation changed a tensor in place.
        if isinstance(result, tuple | list):
            return type(result)(map(self._rounded, result))
        return self._rounded(result)

    def _rounded(self, result: Any) -> Any:
        if not isinstance(result, torch.Tensor):
            return result
        self.types.add(str(result.dtype).removeprefix("torch."))
        if result.dtype not in _ROUNDED:
            return result
        device = result.device
        if device not in self._generators:
            self._generators[device] = torch.Generator(device).manual_seed(0)
        # The result is changed in place, since it may occupy a large part of the memory.
        factors = torch.rand(result.shape, generator=self._generators[device], device=device)
        factors.sub_(0.5).mul_(torch.finfo(result.dtype).eps).add_(1)
        return factors.mul_(result).to(result.dtype)
