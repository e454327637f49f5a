"""Arrays from the bytes of any message: only bools, integers and floats, and only with all their bytes."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, shown

Buffer = bytes | memoryview
_PLAIN = re.compile(r"[<|][biuf][1248]")


def is_plain(dtype: Any) -> bool:
    """Whether `dtype`, as numpy writes it, names bools, integers or floats."""
    return isinstance(dtype, str) and _PLAIN.fullmatch(dtype) is not None


def plain_dtype(dtype: Any) -> np.dtype[Any]:
    """Return numpy's type of that name; raises `MalformedMessage` unless it is plain."""
    if not is_plain(dtype):
        raise MalformedMessage(f"array: got dtype {shown(dtype, 20)}, want one like '<f4' or '|u1'")
    try:
        found: np.dtype[Any] = np.dtype(dtype)
    except TypeError as error:
        raise MalformedMessage(f"array: got dtype {dtype!r}, which is none of numpy's") from error
    return found


def read_array(data: Buffer, dtype: Any, shape: Any) -> np.ndarray:
    """Return a read-only view of `data` as an array; raises `MalformedMessage` unless data, type and shape match."""
    kind = plain_dtype(dtype)
    if not isinstance(data, (bytes, memoryview)):
        raise MalformedMessage(f"array: got {type(data).__name__} for its data, want bytes")
    if not isinstance(shape, (list, tuple)) or len(shape) > 8 or not all(type(n) is int and n >= 0 for n in shape):
        raise MalformedMessage(f"array: got shape {shown(shape)}, want up to 8 non-negative integers")
    if math.prod(shape) * kind.itemsize != len(data):
        raise MalformedMessage(f"array: got {len(data)} bytes, want {shown(shape)} of {dtype}")
    try:
        return np.frombuffer(data, kind).reshape(shape)
    except (ValueError, OverflowError) as error:  # an axis too long for numpy beside an empty one
        raise MalformedMessage(f"array: got shape {shown(shape)}, which is none of numpy's") from error
