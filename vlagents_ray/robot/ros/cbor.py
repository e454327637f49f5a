"""A decoder of CBOR (RFC 8949) with typed arrays (RFC 8746), as far as rosbridge uses it: no indefinite lengths.

The robot's install has no CBOR package, and the whole of the format is more than is needed here. Nothing that the bytes
declare is allocated before they have shown to be as long.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, shown

_DEPTH = 16
_HALF, _SINGLE, _DOUBLE = struct.Struct(">e"), struct.Struct(">f"), struct.Struct(">d")
_SIMPLE: dict[int, Any] = {20: False, 21: True, 22: None, 23: None}
# Typed arrays: the tag's bits say kind, byte order and size.
_TYPED = {
    64: "u1", 65: ">u2", 66: ">u4", 67: ">u8", 68: "u1", 69: "<u2", 70: "<u4", 71: "<u8",
    72: "i1", 73: ">i2", 74: ">i4", 75: ">i8", 77: "<i2", 78: "<i4", 79: "<i8",
    80: ">f2", 81: ">f4", 82: ">f8", 84: "<f2", 85: "<f4", 86: "<f8",
}  # fmt: skip


def decode(data: bytes | memoryview) -> Any:
    """Decode one CBOR item.

    Args:
        data: The whole item.

    Returns:
        Numbers, strings, lists and mappings; byte strings as views of `data`, typed arrays as numpy arrays, (D,).

    Raises:
        MalformedMessage: The data are truncated, continue after the item, nest too deep, or use what is not
            supported.
    """
    view = memoryview(data)
    reader = _Reader(view)
    found = reader.item(_DEPTH)
    if reader.at != len(view):
        raise MalformedMessage(f"CBOR: got {len(view) - reader.at} bytes after the item, want none")
    return found


class _Reader:
    def __init__(self, view: memoryview) -> None:
        self.at = 0
        self._view = view

    def item(self, depth: int) -> Any:
        if depth == 0:
            raise MalformedMessage(f"CBOR: got more than {_DEPTH} levels, want a message of ROS")
        head = self._take(1)[0]
        kind, low = head >> 5, head & 31
        if kind == 7:
            return self._simple(low)
        read: Callable[[int, int], Any] = (
            lambda count, _: count,
            lambda count, _: -1 - count,
            lambda count, _: self._take(count),
            lambda count, _: self._text(count),
            self._list,
            self._map,
            self._tagged,
        )[kind]
        return read(self._count(low), depth - 1)

    def _take(self, count: int) -> memoryview:
        end = self.at + count
        if end > len(self._view):
            raise MalformedMessage(f"CBOR: got {len(self._view)} bytes, want {end} or more; the message is truncated")
        taken = self._view[self.at : end]
        self.at = end
        return taken

    def _count(self, low: int) -> int:
        if low < 24:
            return low
        if low > 27:
            raise MalformedMessage(f"CBOR: got the additional information {low}, want 0 to 27: no indefinite lengths")
        return int.from_bytes(self._take(1 << (low - 24)), "big")

    def _text(self, count: int) -> str:
        try:
            return str(self._take(count), "utf-8")
        except UnicodeDecodeError as error:
            raise MalformedMessage(f"CBOR: got a text that is not UTF-8 ({error})") from error

    def _list(self, count: int, depth: int) -> list[Any]:
        self._expect(count)
        return [self.item(depth) for _ in range(count)]

    def _map(self, count: int, depth: int) -> dict[str, Any]:
        self._expect(2 * count)
        found: dict[str, Any] = {}
        for _ in range(count):
            key = self.item(depth)
            if not isinstance(key, str):
                raise MalformedMessage(f"CBOR: got the key {shown(key)}, want a field's name")
            found[key] = self.item(depth)
        return found

    def _expect(self, count: int) -> None:
        if count > len(self._view) - self.at:  # each item takes a byte or more
            raise MalformedMessage(f"CBOR: got {len(self._view) - self.at} bytes for {count} items")

    def _tagged(self, tag: int, depth: int) -> Any:
        value = self.item(depth)
        if tag not in _TYPED:
            return value
        kind = np.dtype(_TYPED[tag])
        if not isinstance(value, memoryview) or len(value) % kind.itemsize:
            raise MalformedMessage(f"CBOR: got a typed array of {kind} that is not as many bytes")
        return np.frombuffer(value, kind)

    def _simple(self, low: int) -> Any:
        if low in _SIMPLE:
            return _SIMPLE[low]
        shape = {25: _HALF, 26: _SINGLE, 27: _DOUBLE}.get(low)
        if shape is None:
            raise MalformedMessage(f"CBOR: got the simple value {low}, want false, true, null or a float")
        return shape.unpack(self._take(shape.size))[0]
