"""Brine, RPyC's encoding of values: None, bool, int, float, text, bytes, and tuples of these; facts from rpyc 6.0.

Its other types (slices, sets, complex numbers, …) are refused, as no client needs them here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from vlagents_ray.errors import MalformedMessage, MessageTooLarge

_DEPTH = 16
_ITEMS = 1024  # maximum number of values in a message
_DIGITS = 20  # maximum length of an integer, its sign included
_F8, _U4 = struct.Struct("!d"), struct.Struct("!L")


def read(data: memoryview) -> Any:
    """Return the one value that `data` consists of; raise `MalformedMessage` or `MessageTooLarge` if it is invalid."""
    return _BrineReader(data).all()


def write(value: Any) -> bytes:
    """Return a value in brine, the inverse of `read`; raise `TypeError` for a type that is not supported."""
    parts: list[bytes] = []
    _write(value, parts)
    return b"".join(parts)


class _BrineReader:
    def __init__(self, data: memoryview) -> None:
        self._data = data
        self._at = 0
        self._items = 0

    def all(self) -> Any:
        """Return the value that the message consists of."""
        value = self._value(0)
        if self._at != len(self._data):
            raise MalformedMessage("brine: more than one value in a message")
        return value

    def _take(self, count: int) -> memoryview:
        end = self._at + count
        if end > len(self._data):
            raise MalformedMessage("brine: a message that ends too early")
        found = self._data[self._at : end]
        self._at = end
        return found

    def _value(self, depth: int) -> Any:
        self._items += 1
        if self._items > _ITEMS or depth > _DEPTH:
            raise MessageTooLarge(f"brine: more than {_ITEMS} values or {_DEPTH} levels in a message")
        tag = self._take(1)[0]
        if 0x20 <= tag < 0xF0:
            return tag - 0x50
        if tag in _SINGLE:
            return _SINGLE[tag]
        if tag == 0x18:
            return _F8.unpack(self._take(8))[0]
        if tag == 0x08:
            return self._text(depth)
        if tag in _BYTES:
            return bytes(self._take(_BYTES[tag](self)))
        if tag in _TUPLES:
            return self._tuple(_TUPLES[tag](self), depth)
        if tag in _INTS:
            return self._integer(_INTS[tag](self))
        raise MalformedMessage(f"brine: got a value of kind {tag:#04x}, want text, numbers or tuples")

    def _text(self, depth: int) -> str:
        data = self._value(depth + 1)
        if not isinstance(data, bytes):
            raise MalformedMessage("brine: text that is none")
        try:
            return data.decode()
        except UnicodeDecodeError as error:
            raise MalformedMessage(f"brine: not UTF-8 ({error.reason})") from error

    def _tuple(self, length: int, depth: int) -> tuple[Any, ...]:
        if length > _ITEMS:
            raise MessageTooLarge(f"brine: a tuple of {length} values, the limit is {_ITEMS}")
        return tuple(self._value(depth + 1) for _ in range(length))

    def _integer(self, length: int) -> int:
        digits = bytes(self._take(length))
        sign = digits[:1] == b"-"
        if not digits[sign:].isdigit() or length > _DIGITS:
            raise MalformedMessage("brine: not a number")
        return int(digits)

    def length1(self) -> int:
        """Read a length of one byte."""
        return self._take(1)[0]

    def length4(self) -> int:
        """Read a length of four bytes."""
        return int(_U4.unpack(self._take(4))[0])


def _fixed(length: int) -> Callable[[_BrineReader], int]:
    return lambda _: length


_SINGLE: dict[int, Any] = {0x00: None, 0x01: b"", 0x02: (), 0x03: True, 0x04: False}
_BYTES = {0x09 + n: _fixed(n) for n in (1, 2, 3, 4)} | {0x0E: _BrineReader.length1, 0x0F: _BrineReader.length4}
_TUPLES = {0x0F + n: _fixed(n) for n in (1, 2, 3, 4)} | {0x14: _BrineReader.length1, 0x15: _BrineReader.length4}
_INTS = {0x16: _BrineReader.length1, 0x17: _BrineReader.length4}


def _write(value: Any, parts: list[bytes]) -> None:
    if value is None:
        parts.append(b"\x00")
    elif isinstance(value, bool):
        parts.append(b"\x03" if value else b"\x04")
    elif isinstance(value, int):
        if -0x30 <= value < 0xA0:
            parts.append(bytes([value + 0x50]))
        else:
            digits = str(value).encode()
            parts.append(b"\x16" + bytes([len(digits)]) + digits)
    elif isinstance(value, float):
        parts.append(b"\x18" + _F8.pack(value))
    elif isinstance(value, str):
        parts.append(b"\x08")
        _write(value.encode(), parts)
    elif isinstance(value, bytes):
        parts.append(b"\x01" if not value else b"\x0f" + _U4.pack(len(value)) + value)
    elif isinstance(value, tuple):
        parts.append(b"\x02" if not value else b"\x15" + _U4.pack(len(value)))
        for item in value:
            _write(item, parts)
    else:
        raise TypeError(f"brine: cannot send {type(value).__name__}")
