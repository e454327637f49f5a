"""Arrays in the format of the package `msgpack_numpy`: maps with the key `nd`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.protocol.arrays import read_array


def is_packed(node: Mapping[Any, Any]) -> bool:
    """Return whether a map is an array."""
    return b"nd" in node or "nd" in node


def read_packed(node: Mapping[Any, Any]) -> np.ndarray:
    """Return the array in a map of `msgpack_numpy` as a read-only view."""
    found = {(key.decode(errors="replace") if isinstance(key, bytes) else key): item for key, item in node.items()}
    dtype, shape, data = found.get("type"), found.get("shape"), found.get("data")
    if not isinstance(data, bytes) or found.get("kind") not in (None, "", b""):
        raise MalformedMessage("array: nd: want bytes of a plain array")
    dtype = dtype.decode(errors="replace") if isinstance(dtype, bytes) else dtype
    if found["nd"] is not True:
        shape = []
    return read_array(data, dtype, list(shape) if isinstance(shape, (list, tuple)) else shape)


def write_packed(value: Any) -> dict[bytes, Any]:
    """Return the map with an array in the format of `msgpack_numpy`, for msgpack."""
    if isinstance(value, (np.ndarray, np.generic)):
        array = np.ascontiguousarray(value)
        return {
            b"nd": True,
            b"type": array.dtype.str,
            b"kind": b"",
            b"shape": np.shape(value),
            b"data": array.tobytes(),
        }
    raise TypeError(f"cannot send {type(value).__name__}")
