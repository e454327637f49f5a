"""The safetensors format: a header in JSON with the type, shape and offsets of each value, followed
by the bytes of the values.

A file contains only numbers, so that reading it executes nothing. A reader checks the whole header
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

# The size of the longest message with weights, which contains a header (about 40,000 values) or a
# part of the values' bytes.
MESSAGE_BYTES = 2**22
# The number of bytes that are sent at once. With larger pieces, inference calls of the reading
# replica would wait longer for Python's lock.
PART_BYTES = 2**20
_LENGTH = struct.Struct("<Q")
_NAME_LENGTH = 512  # longest name of a value, characters
_DIMENSIONS = 32  # most dimensions of a value, as in the oldest supported numpy
_DIGITS = 15  # most digits of a number in the header
_METADATA = "__metadata__"  # the only name in a header that is not the name of a value
_TYPES = {
    "BOOL": np.dtype(np.bool_),
    "BF16": np.dtype("V2"),  # a bfloat16, see `vlagents_ray.weights.trainable.portable`
    **{f"F{8 * size}": np.dtype(f"<f{size}") for size in (2, 4, 8)},
    **{f"I{8 * size}": np.dtype(f"<i{size}") for size in (1, 2, 4, 8)},
    **{f"U{8 * size}": np.dtype(f"<u{size}") for size in (1, 2, 4, 8)},
}
_CODES = {dtype: code for code, dtype in _TYPES.items()}


@dataclass(frozen=True, slots=True)
class ValueSpec:
    """The type and shape of one value. Its bytes follow the bytes of the previous value."""

    dtype: np.dtype[Any]
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """The number of bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def header_of(values: Mapping[str, np.ndarray]) -> bytes:
    """Return the header of a file with these values.

    Args:
        values: The values by name.

    Returns:
        The length of the header in 8 bytes, and the header.

    Raises:
        InvalidWeights: The format does not support the type of a value.
    """
    document = {}
    begin = 0
    for name, value in values.items():
        if value.dtype not in _CODES:
            raise InvalidWeights(
                f"{name!r}: expected a dtype of {', '.join(sorted(_TYPES))}, got {value.dtype}"
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
    """Yield the bytes of the values, in the order of the header.

    Args:
        values: The values by name.
        length: The number of bytes that are yielded at once. The last piece may be shorter.
    """
    buffer = bytearray()
    for value in values.values():
        data = memoryview(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        while data:
            fitting = data[: length - len(buffer)]
            buffer += fitting
            data = data[len(fitting) :]
            if len(buffer) == length:
                yield bytes(buffer)
                buffer.clear()
    if buffer:
        yield bytes(buffer)


def read_header(data: bytes) -> dict[str, ValueSpec]:
    """Read a header that `header_of` made.

    Args:
        data: The length of the header in 8 bytes, and the header.

    Returns:
        The types and shapes of the values that the header announces, by name, in the order of their
        bytes.

    Raises:
        MalformedMessage: The data are not a header, or are too long, or the offsets of the values
            overlap, leave gaps or do not fit the shapes.
    """
    announced = _LENGTH.unpack_from(data)[0] if len(data) >= _LENGTH.size else -1
    if announced != len(data) - _LENGTH.size or len(data) > MESSAGE_BYTES:
        raise MalformedMessage(
            "safetensors: expected 8 bytes with the length of the header, and the header, at "
            f"most {MESSAGE_BYTES} together, got {len(data)} bytes that announce a header of "
            f"{announced}"
        )

    try:
        document = json.loads(
            data[_LENGTH.size :], parse_int=_whole, object_pairs_hook=without_duplicate_keys
        )
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(
            f"safetensors: expected a JSON document as the header ({error})"
        ) from error
    if not isinstance(document, dict):
        raise MalformedMessage(
            "safetensors: expected an object with a value for each name, got "
            f"{type(document).__name__}"
        )
    document.pop(_METADATA, None)

    entries = sorted((*_read_value(name, entry), name) for name, entry in document.items())
    specs = {}
    offset = 0
    for begin, end, code, shape, name in entries:
        spec = ValueSpec(_TYPES[code], shape)
        if begin != offset or end - begin != spec.size:
            raise MalformedMessage(
                f"safetensors: {name!r}: expected the bytes {offset} to {offset + spec.size} for "
                f"{code} of shape {list(shape)}, got {begin} to {end}"
            )
        specs[name] = spec
        offset = end
    return specs


def _read_value(name: str, entry: Any) -> tuple[int, int, str, tuple[int, ...]]:
    """Check a value's entry in a header, and return the value's type and shape and the begin and
    end of its bytes.
    """
    if len(name) > _NAME_LENGTH:
        raise MalformedMessage(
            f"safetensors: expected names of at most {_NAME_LENGTH} characters, got one of "
            f"{len(name)}"
        )
    if not isinstance(entry, dict) or entry.keys() != {"dtype", "shape", "data_offsets"}:
        raise MalformedMessage(
            f"safetensors: {name!r}: expected 'dtype', 'shape' and 'data_offsets'"
        )

    code, shape, offsets = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(code, str) or code not in _TYPES:
        raise MalformedMessage(
            f"safetensors: {name!r}: expected a type of {', '.join(_TYPES)}, got {shown(code, 20)}"
        )
    if not _are_whole(shape) or len(shape) > _DIMENSIONS:
        raise MalformedMessage(
            f"safetensors: {name!r}: shape: expected at most {_DIMENSIONS} whole numbers"
        )
    if not _are_whole(offsets) or len(offsets) != 2:
        raise MalformedMessage(f"safetensors: {name!r}: data_offsets: expected two whole numbers")
    return offsets[0], offsets[1], code, tuple(shape)


def _are_whole(numbers: Any) -> bool:
    return isinstance(numbers, list) and all(
        type(number) is int and number >= 0 for number in numbers
    )


def _whole(text: str) -> int:
    """Parse a whole number of a JSON text.

    Very long numbers are rejected, since parsing them would take too much time.
    """
    if len(text) > _DIGITS:
        raise ValueError(f"a number of {len(text)} digits")
    return int(text)


class ValuesReader:
    """Reads values whose bytes arrive one after the other. The memory of a value is allocated when
    its first byte arrives.

    Args:
        specs: The values that a header announces, from `read_header`.
    """

    def __init__(self, specs: Mapping[str, ValueSpec]) -> None:
        self._values: dict[str, np.ndarray] = {}
        self._pending = deque(specs.items())  # values of which no byte has arrived yet
        # The bytes of the current value that have not arrived yet.
        self._missing = np.empty(0, np.uint8)
        self.received = 0  # the number of bytes that have arrived
        self.size = sum(spec.size for spec in specs.values())  # the number of all bytes

    def add(self, data: bytes) -> None:
        """Add the next bytes.

        Args:
            data: The bytes, of one value or several.

        Raises:
            MalformedMessage: There are more bytes than the header announced.
        """
        if self.received + len(data) > self.size:
            raise MalformedMessage(
                f"safetensors: expected {self.size} bytes of values, as the header announced, got "
                f"{self.received + len(data)}"
            )
        self.received += len(data)

        remaining = np.frombuffer(data, np.uint8)
        while remaining.size:
            if not self._missing.size:
                self._begin_next()
            length = min(remaining.size, self._missing.size)
            self._missing[:length] = remaining[:length]
            self._missing = self._missing[length:]
            remaining = remaining[length:]

    def values(self) -> Mapping[str, np.ndarray]:
        """Return the values, read-only, once all bytes have arrived.

        Raises:
            MalformedMessage: A truth value is neither 0 nor 1.
        """
        while self._pending:  # values without elements
            self._begin_next()

        for name, value in self._values.items():
            if value.dtype == np.bool_ and value.size and value.view(np.uint8).max() > 1:
                raise MalformedMessage(
                    f"safetensors: {name!r}: expected bytes of 0 and 1 as bools, got others"
                )
            value.flags.writeable = False
        return self._values

    def _begin_next(self) -> None:
        """Allocate the memory of the next value."""
        name, spec = self._pending.popleft()
        value = np.empty(spec.shape, spec.dtype)
        self._values[name] = value
        self._missing = value.reshape(-1).view(np.uint8)


def write_values(file: BinaryIO, values: Mapping[str, np.ndarray]) -> None:
    """Write values into a file, at its current position.

    Args:
        file: The file, open for writing.
        values: The values by name.

    Raises:
        InvalidWeights: The format does not support the type of a value.
    """
    file.write(header_of(values))
    file.writelines(parts_of(values))
    file.flush()


def read_values(file: BinaryIO) -> Mapping[str, np.ndarray]:
    """Read the values that `write_values` wrote.

    Args:
        file: The file, open for reading.

    Returns:
        The values by name, read-only.

    Raises:
        MalformedMessage: The file is damaged, or has another format.
    """
    length = file.read(_LENGTH.size)
    announced = _LENGTH.unpack(length)[0] if len(length) == _LENGTH.size else 0
    header = file.read(min(announced, MESSAGE_BYTES))
    reader = ValuesReader(read_header(length + header))

    data = file.read(PART_BYTES)
    while data:
        reader.add(data)
        data = file.read(PART_BYTES)
    if reader.received != reader.size:
        raise MalformedMessage(
            f"safetensors: expected {reader.size} bytes of values, as the header announced, got "
            f"{reader.received}"
        )
    return reader.values()
