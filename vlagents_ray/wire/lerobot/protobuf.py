"""The protobuf messages of LeRobot's `AsyncInference` service, read and written by hand.

The facts come from LeRobot 0.4.4's `transport/services.proto`, and 0.6.1 has the same: `Observation` has the field 1,
`transfer_state`, and the field 2, `data`; `PolicySetup` and `Actions` have the field 1, `data`; `Empty` has none.
"""

from __future__ import annotations

import enum
from collections.abc import Iterator
from dataclasses import dataclass

from vlagents_ray.errors import MalformedMessage

SERVICE = "transport.AsyncInference"
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # types of a field
_VARINT_BYTES = 10  # maximum length of a number
_PART_BYTES = 2 * 2**20  # as LeRobot's own client sends; its server takes messages of 4 MiB


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


def write_observation_parts(data: bytes) -> Iterator[bytes]:
    """Yield the `Observation` messages of a pickled observation."""
    for at in range(0, len(data), _PART_BYTES):
        end = at + _PART_BYTES
        state = TransferState.END if end >= len(data) else TransferState.MIDDLE if at else TransferState.BEGIN
        yield bytes([1 << 3 | _VARINT, state, *_head(2, len(data[at:end]))]) + data[at:end]


def read_data(message: bytes) -> memoryview | None:
    """Return the pickle in a `PolicySetup` or an `Actions`; None if it has none."""
    for field, value in _fields(message):
        if field == 1 and isinstance(value, memoryview):
            return value
    return None


def write_data(data: bytes) -> bytes:
    """Return a `PolicySetup` or an `Actions` with a pickle."""
    return _head(1, len(data)) + data


def method(name: str) -> str:
    """Return the path of a method of the service."""
    return f"/{SERVICE}/{name}"


EMPTY = b""  # an `Empty`, and an `Actions` without a pickle


def _head(number: int, length: int) -> bytes:
    """Return what precedes the bytes of a field."""
    size = bytearray()
    while length > 0x7F:
        size.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes([number << 3 | _BYTES, *size, length])


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
