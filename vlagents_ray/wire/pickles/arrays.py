"""numpy's arrays, types and numbers in a pickle: the calls by which numpy's own pickles state them.

The facts come from the pickles of numpy 1.26 and 2.4 in protocol 4 and 5. Arrays of objects, text, times or structures,
and big-endian ones, are refused.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.protocol.arrays import read_array
from vlagents_ray.protocol.messages import DEFAULT_LIMITS
from vlagents_ray.wire.pickles.reader import Call, Name, Reduced, read_pickle


class _Dtype(str):
    """The name of a plain numpy type, such as `<f4`."""

    __slots__ = ()


def _dtype(arguments: tuple[Any, ...]) -> Reduced:
    """`numpy.dtype`: ("f4", False, True), then (3, "<", None, None, None, -1, -1, 0)."""
    match arguments:
        case (str(kind), bool() | int(), bool() | int()):
            return Reduced(lambda state: _ordered_dtype(kind, state))
    raise MalformedMessage("pickle: numpy.dtype: want the type of plain numbers")


def _ordered_dtype(kind: str, state: Any) -> _Dtype:
    match state:
        case (int(3), str("<") | str("|") as order, None, None, None, int(-1), int(-1), int(0)):
            return _Dtype(order + kind)
    raise MalformedMessage("pickle: numpy.dtype: want the type of plain numbers in little-endian order")


def _array(arguments: tuple[Any, ...]) -> Reduced:
    """`_reconstruct`: (numpy.ndarray, (0,), b"b"), then (1, shape, dtype, whether by columns, data)."""
    match arguments:
        case (Name("numpy", "ndarray"), (int(0),), memoryview() as kind) if bytes(kind[:2]) == b"b":
            return Reduced(_content)
    raise MalformedMessage("pickle: numpy: want a plain array")


def _content(state: Any) -> np.ndarray:
    match state:
        case (int(1), tuple(shape), _Dtype() as dtype, bool(by_columns), memoryview() as data):
            return _ordered(data, dtype, shape, by_columns)
    raise MalformedMessage("pickle: numpy: want the shape, the type of numbers and the data of an array")


def _frombuffer(arguments: tuple[Any, ...]) -> Reduced:
    """`_frombuffer`, of protocol 5: (data, dtype, shape, "C" or "F")."""
    match arguments:
        case (memoryview() as data, _Dtype() as dtype, tuple(shape), str("C") | str("F") as order):
            return Reduced(value=_ordered(data, dtype, shape, order == "F"))
    raise MalformedMessage("pickle: numpy: want an array by rows; send numpy.ascontiguousarray of it")


def _scalar(arguments: tuple[Any, ...]) -> int | float:
    """`scalar`: (dtype, data)."""
    match arguments:
        case (_Dtype() as dtype, memoryview() as data):
            number: int | float = read_array(data, str(dtype), ()).item()
            return number
    raise MalformedMessage("pickle: numpy: want a plain number")


def _ordered(data: memoryview, dtype: str, shape: tuple[Any, ...], by_columns: bool) -> np.ndarray:
    return read_array(data, str(dtype), shape[::-1]).T if by_columns else read_array(data, str(dtype), shape)


# numpy renamed its modules in 2.0.
CALLS: dict[Name, Call | None] = {Name("numpy", "dtype"): _dtype, Name("numpy", "ndarray"): None} | {
    Name(f"numpy.{core}.{module}", name): read
    for core in ("core", "_core")
    for module, name, read in (
        ("multiarray", "_reconstruct", _array),
        ("multiarray", "scalar", _scalar),
        ("numeric", "_frombuffer", _frombuffer),
    )
}


def read_pickled_array(data: bytes) -> np.ndarray:
    """Return the numpy array that a pickle consists of, which views `data`.

    Raises:
        MalformedMessage: The pickle has anything but such an array, see `pickles`.
        MessageTooLarge: It exceeds a limit.
    """
    found = read_pickle(data, DEFAULT_LIMITS, {}, CALLS)
    if not isinstance(found, np.ndarray):
        raise MalformedMessage(f"pickle: got {type(found).__name__}, want a numpy array")
    return found
