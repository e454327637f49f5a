"""The safetensors format: a header in JSON, with type, shape and place of each value, followed by
their bytes.

It contains only numbers, so that reading it executes nothing. A reader checks the whole header
before it allocates memory for any value. See https://huggingface.co/docs/safetensors for the
format.
"""

from __future__ import annotations

import json
import math
import struct
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from vlagents_ray.errors import InvalidWeights, MalformedMessage, shown
from vlagents_ray.naming import without_duplicate_keys

# Longest message with weights: a header (about 40,000 values), or a part of their bytes.
MESSAGE_BYTES = 2**22
# Bytes of a part; while a replica reads longer parts, its acts wait for Python's lock.
PART_BYTES = 2**20
_LENGTH = struct.Struct("<Q")
_NAME_LENGTH = 512  # characters
_DIMENSIONS = 32  # as in the oldest supported numpy
_DIGITS = 15  # of a number in the header
_METADATA = "__metadata__"  # the only name that is not a value's
_TYPES = {
    "BOOL": np.dtype(np.bool_),
    "BF16": np.dtype("V2"),  # see `vlagents_ray.weights.trainable.portable`
    **{f"F{8 * size}": np.dtype(f"<f{size}") for size in (2, 4, 8)},
    **{f"I{8 * size}": np.dtype(f"<i{size}") for size in (1, 2, 4, 8)},
    **{f"U{8 * size}": np.dtype(f"<u{size}") for size in (1, 2, 4, 8)},
}
_CODES = {dtype: code for code, dtype in _TYPES.items()}


@dataclass(frozen=True, slots=True)
class ValueSpec:
    """Type and shape of one value, whose bytes follow those of the previous value."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def header_of(values: Mapping[str, np.ndarray]) -> bytes:
    """Return the header of a file with these values; raises `InvalidWeights` for a type that the
    format lacks.
    """
    document, begin = {}, 0
    for name, value in values.items():
        if value.dtype not in _CODES:
            raise InvalidWeights(
                f"{name!r}: got {value.dtype}, want one of {', '.join(sorted(_TYPES))}"
            )
        end = begin + value.nbytes
        document[name] = {
            "dtype": _CODES[value.dtype],
            "shape": list(value.shape),
            "data_offsets": [begin, end],
        }
        begin = end
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    return _LENGTH.pack(len(text)) + text


def parts_of(values: Mapping[str, np.ndarray], length: int = PART_BYTES) -> Iterator[bytes]:
    """Yield the bytes of the values, in the header's order, in parts of `length` bytes; the last
    may be shorter.
    """
    part = bytearray()
    for value in values.values():
        data = memoryview(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        while data:
            taken = data[: length - len(part)]
            part += taken
            data = data[len(taken) :]
            if len(part) == length:
                yield bytes(part)
                part.clear()
    if part:
        yield bytes(part)


def read_header(data: bytes) -> dict[str, ValueSpec]:
    """Return the values that a header made by `header_of` announces, by name, in the order of their
    bytes.

    Raises:
        MalformedMessage: The data are not a header or too long, or the places overlap, leave gaps
            or do not fit the shapes.
    """
    announced = _LENGTH.unpack_from(data)[0] if len(data) >= _LENGTH.size else -1
    if announced != len(data) - _LENGTH.size or len(data) > MESSAGE_BYTES:
        raise MalformedMessage(
            f"safetensors: got {len(data)} bytes that announce a header of {announced}, want 8 "
            f"bytes with the length of the header, and the header, at most {MESSAGE_BYTES} together"
        )

    try:
        document = json.loads(
            data[_LENGTH.size :], parse_int=_whole, object_pairs_hook=without_duplicate_keys
        )
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"safetensors: the header is no JSON document ({error})") from error
    if not isinstance(document, dict):
        raise MalformedMessage(
            f"safetensors: got {type(document).__name__}, want an object with a value for each name"
        )
    document.pop(_METADATA, None)

    in_order = sorted((*_read_value(name, entry), name) for name, entry in document.items())
    specs = {}
    offset = 0
    for begin, end, code, shape, name in in_order:
        spec = ValueSpec(_TYPES[code], shape)
        if begin != offset or end - begin != spec.size:
            raise MalformedMessage(
                f"safetensors: {name!r}: got bytes {begin} to {end}, want {offset} to "
                f"{offset + spec.size} for {code} of shape {list(shape)}"
            )
        specs[name] = spec
        offset = end
    return specs


def _read_value(name: str, entry: Any) -> tuple[int, int, str, tuple[int, ...]]:
    """Return the begin and the end of a value's bytes, its type and its shape."""
    if len(name) > _NAME_LENGTH:
        raise MalformedMessage(
            f"safetensors: got a name of {len(name)} characters, the limit is {_NAME_LENGTH}"
        )
    if not isinstance(entry, dict) or entry.keys() != {"dtype", "shape", "data_offsets"}:
        raise MalformedMessage(f"safetensors: {name!r}: want 'dtype', 'shape' and 'data_offsets'")
    code, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(code, str) or code not in _TYPES:
        raise MalformedMessage(
            f"safetensors: {name!r}: got type {shown(code, 20)}, want one of {', '.join(_TYPES)}"
        )
    if not _are_whole(shape) or len(shape) > _DIMENSIONS:
        raise MalformedMessage(
            f"safetensors: {name!r}: shape: want at most {_DIMENSIONS} whole numbers"
        )
    if not _are_whole(offsets) or len(offsets) != 2:
        raise MalformedMessage(f"safetensors: {name!r}: data_offsets: want two whole numbers")
    return offsets[0], offsets[1], code, tuple(shape)


def _are_whole(numbers: Any) -> bool:
    return isinstance(numbers, list) and all(
        type(number) is int and number >= 0 for number in numbers
    )


def _whole(text: str) -> int:
    """Return a whole number of a JSON text; very long ones would take too much time."""
    if len(text) > _DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


class ValuesReader:
    """Values whose bytes arrive in parts. The memory of a value is allocated when its first byte
    arrives.
    """

    def __init__(self, specs: Mapping[str, ValueSpec]) -> None:
        """Read the values that a header announces, see `read_header`."""
        self._left = deque(specs.items())
        self._values: dict[str, np.ndarray] = {}
        # The bytes of the current value that have not arrived yet.
        self._room = np.empty(0, np.uint8)
        self.received = 0  # the number of bytes that have arrived
        self.size = sum(spec.size for spec in specs.values())  # the number of all bytes

    def add(self, part: bytes) -> None:
        """Append the next bytes; raises `MalformedMessage` if there are more than the header
        announced.
        """
        if self.received + len(part) > self.size:
            raise MalformedMessage(
                f"safetensors: got {self.received + len(part)} bytes of values, the header "
                f"announced {self.size}"
            )
        self.received += len(part)
        data = np.frombuffer(part, np.uint8)
        while data.size:
            if not self._room.size:
                self._begin_next()
            length = min(data.size, self._room.size)
            self._room[:length] = data[:length]
            self._room, data = self._room[length:], data[length:]

    def values(self) -> Mapping[str, np.ndarray]:
        """Return the values, read-only, once all bytes have arrived.

        Raises:
            MalformedMessage: A truth value is neither 0 nor 1.
        """
        while self._left:
            self._begin_next()  # needed for values without elements
        for name, value in self._values.items():
            if value.dtype == np.bool_ and value.size and value.view(np.uint8).max() > 1:
                raise MalformedMessage(
                    f"safetensors: {name!r}: got other bytes than 0 and 1 for truth values"
                )
            value.flags.writeable = False
        return self._values

    def _begin_next(self) -> None:
        name, spec = self._left.popleft()
        value = self._values[name] = np.empty(spec.shape, spec.dtype)
        self._room = value.reshape(-1).view(np.uint8)


def write_values(file: BinaryIO, values: Mapping[str, np.ndarray]) -> None:
    """Write values into a file, from its place on; raises `InvalidWeights` for a type that the
    format lacks.
    """
    file.write(header_of(values))
    file.writelines(parts_of(values))
    file.flush()


def read_values(file: BinaryIO) -> Mapping[str, np.ndarray]:
    """Return the values of a file, read-only, as `write_values` wrote them; raises
    `MalformedMessage`.
    """
    length = file.read(_LENGTH.size)
    announced = _LENGTH.unpack(length)[0] if len(length) == _LENGTH.size else 0
    reader = ValuesReader(read_header(length + file.read(min(announced, MESSAGE_BYTES))))
    while part := file.read(PART_BYTES):
        reader.add(part)
    if reader.received != reader.size:
        raise MalformedMessage(
            f"safetensors: got {reader.received} bytes of values, the header announced "
            f"{reader.size}"
        )
    return reader.values()
