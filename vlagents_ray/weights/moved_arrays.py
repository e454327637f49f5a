"""JAX arrays that are in the memory of the host while a policy sleeps.

A JAX array never changes, and has no memory that could be freed while references to the array
remain. An `ArrayOnHost` therefore replaces the array in dicts and in the policy. As in the module
`trainable`, JAX is never imported here.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True, eq=False)
class ArrayOnHost:
    """The numbers of a JAX array, and the device on which it was."""

    numbers: np.ndarray
    sharding: Any

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the array."""
        return self.numbers.shape

    @property
    def dtype(self) -> Any:
        """The type of the array."""
        return self.numbers.dtype


class MovedArrays:
    """The JAX arrays of one policy that were moved to the host.

    An array that several values share is copied only once in each direction.
    """

    def __init__(self) -> None:
        # Copies on the host by the identity of the array.
        self._on_host: dict[int, ArrayOnHost] = {}
        self._restored: dict[int, Any] = {}  # arrays by the identity of the `ArrayOnHost`

    @property
    def is_empty(self) -> bool:
        """Whether no array was moved."""
        return not self._on_host

    def to_host(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return values in which no array is on an accelerator.

        The memory of an array is freed when no reference to it remains.

        Args:
            values: The values by name; values that are not JAX arrays on an accelerator stay
                unchanged.
        """
        moved: dict[str, Any] = {}
        for name, value in values.items():
            if is_on_accelerator(value):
                if id(value) not in self._on_host:
                    self._on_host[id(value)] = ArrayOnHost(np.asarray(value), value.sharding)
                moved[name] = self._on_host[id(value)]
            else:
                moved[name] = value
        return moved

    def from_host(self, values: dict[str, Any]) -> None:
        """Replace each `ArrayOnHost` with an equal array on the device of the original array.

        Args:
            values: The values by name. After an error, the arrays that did not fit into memory are
                still on the host, and a later call continues.
        """
        for name, value in values.items():
            if isinstance(value, ArrayOnHost):
                if id(value) not in self._restored:
                    device_put = sys.modules["jax"].device_put
                    self._restored[id(value)] = device_put(value.numbers, value.sharding)
                values[name] = self._restored[id(value)]

    def clear(self) -> None:
        """Drop all references, after the last `from_host`."""
        self._on_host.clear()
        self._restored.clear()


def is_on_accelerator(value: Any) -> bool:
    """Return whether a value is a JAX array on a device other than a CPU."""
    jax = sys.modules.get("jax")
    if jax is None or not isinstance(value, jax.Array):
        return False
    return any(device.platform != "cpu" for device in value.devices())
