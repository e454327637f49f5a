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
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, Limits

_PREFIX = struct.Struct("<3sBI")
_ALIGN = 8
_SHORT = 2**20  # bytes of JSON; a shorter text cannot need much memory
_VALUES = 1_000_000  # most values in a longer text
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


def unpack(data: Buffer, limits: Limits) -> tuple[dict[str, Any], list[Buffer]]:
    """Return the header of a frame and views of its blobs.

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
    header = parse_json(bytes(view[_PREFIX.size : at]), "frame: the header is")
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


def parse_json(text: bytes | str, what: str, pairs: Callable[[list[tuple[str, Any]]], Any] | None = None) -> Any:
    """Return the value of a JSON text of the network.

    Args:
        text: The text; bytes are UTF-8.
        what: The beginning of the error message, such as "obs:".
        pairs: Makes the value of an object from its keys and values; a `ValueError` of it is a `MalformedMessage`.

    Raises:
        MalformedMessage: It is not JSON, or has characters that no text can have: halves of surrogate pairs.
        MessageTooLarge: It would need far more memory and time to read than its length suggests.
    """
    _require_few_values(text)
    try:
        decoded = text if isinstance(text, str) else text.decode("utf-8-sig")
        value = json.loads(decoded, object_pairs_hook=pairs)
        if "\\u" in decoded:
            json.dumps(value, ensure_ascii=False).encode()  # raises an error for half of a pair
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"{what} not JSON ({error})") from error
    return value


def _require_few_values(text: bytes | str) -> None:
    """Raise `MessageTooLarge` for JSON that would need far more memory and time to read than its length suggests."""
    if len(text) <= _SHORT:
        return
    data = text.encode("utf-8", "replace") if isinstance(text, str) else text
    if sum(map(data.count, (b",", b"[", b"{"))) > _VALUES:
        raise MessageTooLarge(f"message: more than {_VALUES} values in its JSON; send arrays instead of lists")
