"""A simulation of JAX with arrays on a GPU, for tests of weights without a GPU or JAX."""

from __future__ import annotations

import gc
import sys
import weakref
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest


class Array:
    """A `jax.Array` on a simulated GPU."""

    arrays: ClassVar[weakref.WeakSet[Array]]

    def __init__(self, numbers: Any, sharding: str) -> None:
        self._numbers = np.array(numbers)
        self.sharding = sharding
        Array.arrays.add(self)

    @property
    def shape(self) -> tuple[int, ...]:
        return self._numbers.shape

    @property
    def dtype(self) -> Any:
        return self._numbers.dtype

    def devices(self) -> list[Any]:
        return [SimpleNamespace(platform="gpu")]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.array(self._numbers, dtype)

    def __eq__(self, other: object) -> Any:
        return self._numbers == np.asarray(other)

    __hash__ = object.__hash__


class Gpu:
    """The memory of a GPU, with room for a number of arrays."""

    def __init__(self) -> None:
        self.fits = sys.maxsize

    def put(self, numbers: Any, sharding: str) -> Array:
        if self.count() >= self.fits:
            raise RuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 4 bytes")
        return Array(numbers, sharding)

    def count(self) -> int:
        gc.collect()
        return len(Array.arrays)

    def install(self, patch: pytest.MonkeyPatch) -> None:
        """Replace JAX by the simulation, without any arrays."""
        Array.arrays = weakref.WeakSet()
        jax_numpy = SimpleNamespace(isfinite=lambda array: np.isfinite(np.asarray(array)))
        jax = SimpleNamespace(Array=Array, device_put=self.put, numpy=jax_numpy)
        patch.setitem(sys.modules, "jax", jax)
