"""The container of a frame: a JSON header and binary blobs, each aligned.

offset 0   b"VLA" and the version byte 1
       4   length of the header in bytes, uint32 little-endian
       8   header: JSON in UTF-8, its key "blobs" lists the length of each blob
       …   blobs, each beginning at a multiple of 8 from the start of the frame
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from typing import Any

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.protocol.arrays import Buffer
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, Budget, Limits

_PREFIX = struct.Struct("<3sBI")
_ALIGN = 8
HEADER_BYTES = 2**20  # most bytes of the JSON of a request; the limits of a body hold for that of a reply
VALUES = 20_000  # most values in the JSON of a request, which parses in about 2 ms
_INLINE_BYTES = 64 * 1024  # longer JSON is parsed within a budget, which may move it to a decoding thread
_LONG_VALUES = 1_000_000
dump = json.JSONEncoder(separators=(",", ":")).encode  # created once, as `json.dumps` creates an encoder for each call


def pack(header: dict[str, Any], blobs: list[Buffer]) -> list[Buffer]:
    """Return the pieces of a frame, in order; sets "blobs" in `header`; blobs are not copied."""
    header["blobs"] = [len(blob) for blob in blobs]
    return assemble(dump(header), blobs)


def assemble(header: str, blobs: list[Buffer]) -> list[Buffer]:
    """Return the pieces of a frame whose header is JSON text already, with "blobs"."""
    head = header.encode()
    parts: list[Buffer] = [_PREFIX.pack(b"VLA", PROTOCOL_VERSION, len(head)), head]
    at = _PREFIX.size + len(head)
    for blob in blobs:
        gap = -at % _ALIGN
        parts += (b"\0" * gap, blob)
        at += gap + len(blob)
    return parts


def unpack(data: Buffer, limits: Limits, budget: Budget | None = None) -> tuple[dict[str, Any], list[Buffer]]:
    """Return the header of a frame and views of its blobs.

    Args:
        data: The frame.
        limits: The limits of its size.
        budget: Of a request, whose header has further limits; None for a reply.

    Raises:
        MalformedMessage: The data are not a frame.
        MessageTooLarge: The frame exceeds the limits.
    """
    if len(data) > limits.body_bytes:
        raise MessageTooLarge(f"frame: got {len(data)} bytes, the limit is {limits.body_bytes}")
    if len(data) < _PREFIX.size:
        raise MalformedMessage(f"frame: got {len(data)} bytes, want at least {_PREFIX.size}")
    magic, version, length = _PREFIX.unpack_from(data)
    if magic != b"VLA":
        raise MalformedMessage(f"frame: got {magic!r} at its start, want b'VLA'; is this a vlagents_ray frame?")
    if version != PROTOCOL_VERSION:
        raise MalformedMessage(f"frame: got version {version}, this side speaks {PROTOCOL_VERSION}; upgrade the older")
    view = memoryview(data)
    at = _PREFIX.size + length
    if at > len(view):
        raise MalformedMessage(f"frame: ends inside its header ({len(view)} of {at} bytes); it was truncated")
    header = parse_json(view[_PREFIX.size : at], "frame: the header is", budget=budget, long=budget is None)
    lengths = header.get("blobs") if isinstance(header, dict) else None
    if not isinstance(lengths, list) or not all(type(n) is int and n >= 0 for n in lengths):
        raise MalformedMessage("frame: the header has no list 'blobs' of lengths")
    blobs: list[Buffer] = []
    for n in lengths:
        at += -at % _ALIGN
        if at + n > len(view):
            raise MalformedMessage(f"frame: ends inside a blob ({len(view)} of {at + n} bytes); it was truncated")
        blobs.append(view[at : at + n])
        at += n
    if at != len(view):
        raise MalformedMessage(f"frame: {len(view) - at} bytes follow its last blob")
    return header, blobs


def parse_json(
    text: Buffer | str,
    what: str,
    pairs: Callable[[list[tuple[str, Any]]], Any] | None = None,
    *,
    budget: Budget | None = None,
    long: bool = False,
) -> Any:
    """Return the value of a JSON text of the network.

    Args:
        text: The text; bytes are UTF-8.
        what: The beginning of the error message, such as "obs:".
        pairs: Makes the value of an object from its keys and values; a `ValueError` of it is a `MalformedMessage`.
        budget: Is charged before a long text is parsed.
        long: Whether it may be longer than a request: the reply of a server, or a file.

    Raises:
        MalformedMessage: It is not JSON, or has characters that no text can have: halves of surrogate pairs.
        MessageTooLarge: It is too long, or has too many values.
    """
    if len(text) > HEADER_BYTES and not long:
        raise MessageTooLarge(
            f"message: got {len(text)} bytes of JSON, the limit is {HEADER_BYTES}; send arrays and files as bytes"
        )
    if budget is not None and len(text) > _INLINE_BYTES:
        budget.parse(len(text))
    data = text if isinstance(text, str) else bytes(text)
    _require_few_values(data, _LONG_VALUES if long else VALUES)
    try:
        decoded = data if isinstance(data, str) else data.decode("utf-8-sig")
        value = json.loads(decoded, object_pairs_hook=pairs)
        if "\\u" in decoded:
            json.dumps(value, ensure_ascii=False).encode()  # raises an error for half of a pair
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"{what} not JSON ({error})") from error
    return value


def _require_few_values(text: bytes | str, most: int) -> None:
    """Raise `MessageTooLarge` for JSON that would need far more memory and time to read than its length suggests."""
    if len(text) <= 2 * most:  # each value takes two characters at least
        return
    marks: tuple[Any, ...] = (",", "[", "{") if isinstance(text, str) else (b",", b"[", b"{")
    if sum(map(text.count, marks)) > most:
        raise MessageTooLarge(f"message: more than {most} values in its JSON; send arrays instead of lists")
