"""The protobuf messages of LeRobot's `AsyncInference` service, read and written by hand.

The facts come from LeRobot 0.4.4's `transport/services.proto`, and 0.6.1 has the same: `Observation` has the field 1,
`transfer_state`, and the field 2, `data`; `PolicySetup` and `Actions` have the field 1, `data`; `Empty` has none.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass

from vlagents_ray.errors import MalformedMessage

_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # types of a field
_VARINT_BYTES = 10  # maximum length of a number


class TransferState(enum.IntEnum):
    """The place of a part in its message."""

    BEGIN = 1
    MIDDLE = 2
    END = 3


@dataclass(frozen=True, slots=True)
class ObservationPart:
    """A part of a pickled observation."""

    state: TransferState
    data: memoryview


def read_observation_part(message: bytes) -> ObservationPart:
    """Return the content of an `Observation`; raise `MalformedMessage` if it is none."""
    number, data = 0, memoryview(b"")
    for field, value in _fields(message):
        if field == 1 and isinstance(value, int):
            number = value
        elif field == 2 and isinstance(value, memoryview):
            data = value
    try:
        return ObservationPart(TransferState(number), data)
    except ValueError as error:
        raise MalformedMessage(f"observation: got transfer state {number}, want 1, 2 or 3") from error


def read_setup(message: bytes) -> bytes:
    """Return the pickle in a `PolicySetup`; raise `MalformedMessage` if it is none."""
    for field, value in _fields(message):
        if field == 1 and isinstance(value, memoryview):
            return bytes(value)
    raise MalformedMessage("policy instructions: got none")


def write_actions(data: bytes) -> bytes:
    """Return an `Actions` with a pickle."""
    size, length = bytearray(), len(data)
    while length > 0x7F:
        size.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes([1 << 3 | _BYTES, *size, length]) + data


EMPTY = b""  # an `Empty`, and an `Actions` without a pickle


def _fields(message: bytes) -> Iterator[tuple[int, int | memoryview]]:
    """Yield the number and the value of each field that is a number or bytes; others are skipped."""
    view, at = memoryview(message), 0
    while at < len(view):
        key, at = _varint(view, at)
        kind = key & 7
        if kind == _VARINT:
            value, at = _varint(view, at)
            yield key >> 3, value
            continue
        length = {_FIXED64: 8, _FIXED32: 4}.get(kind)
        if kind == _BYTES:
            length, at = _varint(view, at)
        if length is None or at + length > len(view):
            raise MalformedMessage("protobuf: a field of an unknown type, or that ends too early")
        if kind == _BYTES:
            yield key >> 3, view[at : at + length]
        at += length


def _varint(view: memoryview, at: int) -> tuple[int, int]:
    """Return the number at `at`, and the place after it."""
    number = 0
    for place, byte in enumerate(view[at : at + _VARINT_BYTES]):
        number |= (byte & 0x7F) << (7 * place)
        if byte < 0x80:
            return number, at + place + 1
    raise MalformedMessage("protobuf: a number that ends too early")
