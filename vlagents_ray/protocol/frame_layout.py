"""The container of a frame: a JSON header and binary blobs, each aligned.

offset 0   b"VLA" and the version byte 1
       4   length of the header in bytes, uint32 little-endian
       8   header: JSON in UTF-8, its key "blobs" lists the length of each blob
       …   blobs, each beginning at a multiple of 8 from the start of the frame
"""

from __future__ import annotations

import codecs
import json
import math
import re
import struct
from collections.abc import Callable
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, Budget, MessageLimits

Buffer = bytes | memoryview
_PREFIX = struct.Struct("<3sBI")
_ALIGN = 8
HEADER_BYTES = 2**20  # maximum size of a request's JSON; only the body's size limits a reply's JSON
VALUES = 20_000  # maximum number of values in a request's JSON; parsing that many takes about 2 ms
# JSON that is longer than this is parsed within a budget, which may move it to a decoding thread.
_INLINE_BYTES = 64 * 1024
_LONG_VALUES = 1_000_000
_PLAIN = re.compile(r"[<|][biuf][1248]")
# The encoder is created once, since `json.dumps` creates one at each call.
dump = json.JSONEncoder(separators=(",", ":")).encode


def pack(header: dict[str, Any], blobs: list[Buffer]) -> list[Buffer]:
    """Return the pieces of a frame in order, and set "blobs" in `header`. The blobs are not
    copied.
    """
    header["blobs"] = [len(blob) for blob in blobs]
    return assemble(dump(header), blobs)


def assemble(header: str, blobs: list[Buffer]) -> list[Buffer]:
    """Return the pieces of a frame whose header is JSON text that already contains "blobs"."""
    head = header.encode()
    parts: list[Buffer] = [_PREFIX.pack(b"VLA", PROTOCOL_VERSION, len(head)), head]
    offset = _PREFIX.size + len(head)
    for blob in blobs:
        gap = -offset % _ALIGN
        parts += (b"\0" * gap, blob)
        offset += gap + len(blob)
    return parts


def unpack(
    data: Buffer, limits: MessageLimits, budget: Budget | None = None
) -> tuple[dict[str, Any], list[Buffer]]:
    """Return the header of a frame, and views of its blobs.

    The header of a request is charged to `budget`. The `budget` of a reply is None, and its header
    may be longer.

    Raises:
        MalformedMessage: The data are not a frame.
        MessageTooLarge: The frame exceeds the limits.
    """
    if len(data) > limits.body_bytes:
        raise MessageTooLarge(f"frame: expected at most {limits.body_bytes} bytes, got {len(data)}")
    if len(data) < _PREFIX.size:
        raise MalformedMessage(f"frame: expected at least {_PREFIX.size} bytes, got {len(data)}")

    magic, version, length = _PREFIX.unpack_from(data)
    if magic != b"VLA":
        raise MalformedMessage(
            f"frame: expected b'VLA' at its start, got {magic!r}; is this a vlagents_ray frame?"
        )
    if version != PROTOCOL_VERSION:
        raise MalformedMessage(
            f"frame: expected version {PROTOCOL_VERSION}, got {version}; upgrade the older side"
        )

    view = memoryview(data)
    offset = _PREFIX.size + length
    if offset > len(view):
        raise MalformedMessage(
            f"frame: ends inside its header ({len(view)} of {offset} bytes); it was truncated"
        )
    header = parse_json(
        view[_PREFIX.size : offset], "frame: the header is", budget=budget, long=budget is None
    )

    lengths = header.get("blobs") if isinstance(header, dict) else None
    if not isinstance(lengths, list) or not all(type(n) is int and n >= 0 for n in lengths):
        raise MalformedMessage("frame: expected a list 'blobs' of lengths in the header, got none")
    blobs: list[Buffer] = []
    for blob_length in lengths:
        offset += -offset % _ALIGN
        end = offset + blob_length
        if end > len(view):
            raise MalformedMessage(
                f"frame: ends inside a blob ({len(view)} of {end} bytes); it was truncated"
            )
        blobs.append(view[offset:end])
        offset = end
    if offset != len(view):
        raise MalformedMessage(f"frame: {len(view) - offset} bytes follow its last blob")
    return header, blobs


def parse_json(
    text: Buffer | str,
    beginning: str,
    pairs: Callable[[list[tuple[str, Any]]], Any] | None = None,
    *,
    budget: Budget | None = None,
    long: bool = False,
) -> Any:
    """Parse JSON text from the network.

    Args:
        text: The text, or its bytes in UTF-8.
        beginning: The beginning of the error message, such as "obs:".
        pairs: Converts the keys and values of each object; its `ValueError`s become
            `MalformedMessage`.
        budget: The budget to charge before a long text is parsed.
        long: Whether the text may be longer than a request, as a server's reply or a file may be.

    Raises:
        MalformedMessage: The text is not valid JSON, or contains unpaired surrogates.
        MessageTooLarge: The text is too long, or has too many values.
    """
    if len(text) > HEADER_BYTES and not long:
        raise MessageTooLarge(
            f"message: expected at most {HEADER_BYTES} bytes of JSON, got {len(text)}; send "
            "arrays and files as bytes"
        )
    if budget is not None and len(text) > _INLINE_BYTES:
        budget.parse(len(text))

    data = text if isinstance(text, str) else bytes(text)
    max_values = _LONG_VALUES if long else VALUES
    if len(data) > 2 * max_values:  # each value takes at least two characters
        marks: tuple[Any, ...] = (",", "[", "{") if isinstance(data, str) else (b",", b"[", b"{")
        # Parsing such a text would need far more memory and time than its length suggests.
        if sum(map(data.count, marks)) > max_values:
            raise MessageTooLarge(
                f"message: expected at most {max_values} values in its JSON, got more; send "
                "arrays instead of lists"
            )

    try:
        decoded = data if isinstance(data, str) else data.removeprefix(codecs.BOM_UTF8).decode()
        value = json.loads(decoded, object_pairs_hook=pairs)
        if "\\u" in decoded:
            # `encode` raises an error for an unpaired surrogate.
            json.dumps(value, ensure_ascii=False).encode()
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"{beginning} not JSON ({error})") from error
    return value


# Arrays in messages contain only booleans, integers or floats, and the number of bytes must match
# the shape.


def is_plain(dtype: Any) -> bool:
    """Return whether `dtype`, in numpy's notation, means booleans, integers or floats."""
    return isinstance(dtype, str) and _PLAIN.fullmatch(dtype) is not None


def plain_dtype(dtype: Any) -> np.dtype[Any]:
    """Return the numpy dtype named `dtype`; raise `MalformedMessage` if it is not plain."""
    if not is_plain(dtype):
        raise MalformedMessage(
            f"array: expected a dtype like '<f4' or '|u1', got {shown(dtype, 20)}"
        )
    try:
        named_dtype: np.dtype[Any] = np.dtype(dtype)
    except TypeError as error:
        raise MalformedMessage(
            f"array: expected a dtype that numpy knows, got {dtype!r}"
        ) from error
    return named_dtype


def read_array(data: Buffer, dtype: Any, shape: Any) -> np.ndarray:
    """Return a read-only array over `data`.

    Raises:
        MalformedMessage: The data do not match the dtype and the shape.
    """
    kind = plain_dtype(dtype)
    if not isinstance(data, (bytes, memoryview)):
        raise MalformedMessage(f"array: expected bytes as its data, got {type(data).__name__}")
    if (
        not isinstance(shape, (list, tuple))
        or len(shape) > 8
        or not all(type(n) is int and n >= 0 for n in shape)
    ):
        raise MalformedMessage(
            f"array: expected a shape of up to 8 integers of 0 or more, got {shown(shape)}"
        )
    if math.prod(shape) * kind.itemsize != len(data):
        raise MalformedMessage(
            f"array: expected the bytes of {shown(shape)} {dtype}, got {len(data)} bytes"
        )
    try:
        return np.ndarray(shape, kind, data)
    except (ValueError, OverflowError) as error:
        # numpy cannot represent such a long axis, even if another axis is empty.
        raise MalformedMessage(
            f"array: expected a shape that numpy accepts, got {shown(shape)}"
        ) from error
