"""Pickles that are written by hand, as Python's own pickler would need the classes."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.wire.pickles.reader import Name

_ARRAY, _KIND, _DTYPE = (
    Name("numpy._core.multiarray", "_reconstruct"),
    Name("numpy", "ndarray"),
    Name("numpy", "dtype"),
)


def write_record(name: Name, fields: Mapping[str, Any]) -> bytes:
    """Return the pickle of an object of a data class, in protocol 4.

    Args:
        name: The class.
        fields: Its fields: numbers below 2**31, texts, truth values, None, arrays of plain numbers, and tuples, lists
            and dicts of these.
    """
    return b"".join((b"\x80\4", _named(name), b")\x81", written(fields), b"b."))


def written(value: Any) -> bytes:
    """Return the opcodes that push a value onto the stack."""
    if isinstance(value, str):
        return text(value)
    if isinstance(value, float):
        return b"G" + struct.pack(">d", value)
    if isinstance(value, np.ndarray):
        return _array(value)
    if isinstance(value, Mapping):
        return b"}(" + b"".join(text(key) + written(one) for key, one in value.items()) + b"u"
    if isinstance(value, tuple):
        return b"(" + b"".join(map(written, value)) + b"t"
    if isinstance(value, list):
        return b"](" + b"".join(map(written, value)) + b"e"
    if value is None or isinstance(value, bool):
        return {None: b"N", True: b"\x88", False: b"\x89"}[value]
    return b"J" + struct.pack("<i", value)


def text(value: str) -> bytes:
    """Return the opcodes that push a text."""
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def _named(name: Name) -> bytes:
    return text(name.module) + text(name.name) + b"\x93"


def _array(value: np.ndarray) -> bytes:
    """Return the calls by which numpy's own pickles, from version 1.26 on, state an array of protocol 4."""
    value = np.ascontiguousarray(value)
    order, kind = value.dtype.str[0], value.dtype.str[1:]
    dtype = (
        _named(_DTYPE) + written((kind, False, True)) + b"R" + written((3, order, None, None, None, -1, -1, 0)) + b"b"
    )
    data = value.tobytes()
    made = _named(_ARRAY) + _named(_KIND) + written((0,)) + b"C\1b\x87R"
    head = written(1) + written(value.shape) + dtype + written(False) + b"B" + struct.pack("<I", len(data))
    return b"".join((made, b"(", head, data, b"tb"))
