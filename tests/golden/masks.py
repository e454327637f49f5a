"""Functions for recorded bytes: zero the values that differ in each run, write bytes as text for a
file, and show them in lines for a reader.

A message is masked by decoding it, replacing values, and encoding it again. If encoding without a
replacement does not reproduce the message, the message does not conform to its format. Then it
stays unmasked, and so differs from its trace.
"""

from __future__ import annotations

import json
import re
import struct
from itertools import groupby
from typing import Any

import msgpack

# head of a reply over shared memory: free memory files, flags, CPU core
_REPLY = struct.Struct("<QHh")
# id, step, flags, dimensions, H, D, batch size, five times in ms.
_ANSWER = struct.Struct("<40sqBB2xIIIddddd")
_COMPACT = 2  # one of the flags
_FRAME = struct.Struct("<4sI")
# The random id of a session or a request, or the prefix of a request's id to which a gateway adds a
# count.
_ID = re.compile(rb"(?<![0-9a-f])([0-9a-f]{32}(?![0-9a-f])|[0-9a-f]{16}(?=-[0-9a-f]))")
_FRAME_MS = re.compile(rb'("\w+_ms":)-?\d+\.\d{4}(?=[,}])')
_JSON_MS = re.compile(rb'("(?:\w+_ms|created)": ?)-?\d+(\.\d+)?(e-\d+)?(?=[,}])')
_RPYC_JSON = re.compile(rb"\x0f(.{4})(\{.*\})(?=\n$)", re.DOTALL)
# Headers of uvicorn and websockets.
_SERVERS_OWN = re.compile(rb"^(date|server): .*\r\n", re.IGNORECASE | re.MULTILINE)
_LENGTH = re.compile(rb"(?<=\r\ncontent-length: )\d+", re.IGNORECASE)


def masked(data: bytes) -> bytes:
    """Return a message of an unknown format with zeros for ids, times and other values that
    vary.
    """
    for begin, mask in ((b"VLA\x01", _frame), (b"HTTP/1.1 ", _http)):
        if data.startswith(begin):
            return mask(data)
    if (value := _unpacked(data)) is not None:
        return msgpack.packb(_zeroed(value))
    return _without_ids(_JSON_MS.sub(rb"\g<1>0.0", data) if data[:1] == b"{" else data)


def masked_local(data: bytes) -> bytes:
    """Return a masked message of the server on a Unix socket, or its head and the memory file that
    came with it.

    The list of the client's free memory files also varies, since it depends on Python's garbage
    collector.
    """
    flags, rest = _REPLY.unpack_from(data)[1], data[_REPLY.size :]
    return _REPLY.pack(0, flags, 0) + (_without_times(rest) if flags & _COMPACT else masked(rest))


def _without_times(answers: bytes) -> bytes:
    try:
        end = 4 + int.from_bytes(answers[:4], "little") * _ANSWER.size
        each = [_ANSWER.pack(*one[:-5], *[0.0] * 5) for one in _ANSWER.iter_unpack(answers[4:end])]
    except struct.error:
        return answers
    return answers[:4] + b"".join(each) + answers[end:]


def masked_rpyc(data: bytes) -> bytes:
    """Return a masked message of RPyC. Its length and the length of its JSON are adjusted to the
    masked content.
    """
    if int.from_bytes(data[:4], "big") != len(data) - 6:
        return data
    if (found := _RPYC_JSON.search(data)) and int.from_bytes(found[1], "big") == len(found[2]):
        text = _JSON_MS.sub(rb"\g<1>0.0", found[2])
        data = data[: found.start(1)] + len(text).to_bytes(4, "big") + text + data[found.end() :]
    return (len(data) - 6).to_bytes(4, "big") + _without_ids(data[4:])


def masked_websocket(frame: bytes) -> bytes:
    """Return a masked frame of a server, with the length of the masked content in its head."""
    head_bytes = 2 + {126: 2, 127: 8}.get(frame[1], 0)
    body = frame[head_bytes:]
    if frame[1:head_bytes] != _websocket_size(body):
        return frame
    body = masked(body)
    return frame[:1] + _websocket_size(body) + body


def _websocket_size(body: bytes) -> bytes:
    if len(body) < 126:
        return bytes([len(body)])
    if len(body) < 2**16:
        return bytes([126]) + len(body).to_bytes(2, "big")
    return bytes([127]) + len(body).to_bytes(8, "big")


def masked_zmtp(body: bytes) -> bytes:
    """Return the masked body of a frame of ZeroMQ. Its length does not change, since all floats
    have the same length.
    """
    body_masked = masked(body)
    return body_masked if len(body_masked) == len(body) else body


def _without_ids(data: bytes) -> bytes:
    return _ID.sub(lambda found: b"0" * len(found[0]), data)


def _frame(data: bytes) -> bytes:
    header, blobs = _taken_apart(data)
    if header is None:
        return data
    return _put_together(_without_ids(_FRAME_MS.sub(rb"\g<1>0.0000", header)), blobs)


def _taken_apart(data: bytes) -> tuple[bytes | None, list[bytes]]:
    """Return the header's JSON and the blobs of a frame; None if the data is no frame, or contains
    anything else.
    """
    try:
        _, length = _FRAME.unpack_from(data)
        at = _FRAME.size + length
        header, blobs = data[_FRAME.size : at], []
        for size in json.loads(header)["blobs"]:
            at += -at % 8
            blobs.append(data[at : at + size])
            at += size
    except (ValueError, KeyError, TypeError, struct.error):
        return None, []
    return (header, blobs) if _put_together(header, blobs) == data else (None, [])


def _put_together(header: bytes, blobs: list[bytes]) -> bytes:
    data = _FRAME.pack(b"VLA\x01", len(header)) + header
    for blob in blobs:
        data += bytes(-len(data) % 8) + blob
    return data


def _http(data: bytes) -> bytes:
    head, _, body = data.partition(b"\r\n\r\n")
    head, body_masked = _without_ids(_SERVERS_OWN.sub(b"", head + b"\r\n")), masked(body)
    if (length := _LENGTH.search(head)) is None or int(length[0]) != len(body):
        return head + b"\r\n" + body
    return _LENGTH.sub(str(len(body_masked)).encode(), head) + b"\r\n" + body_masked


def _unpacked(data: bytes) -> Any:
    """Return the map or list in msgpack; None if the data is neither."""
    try:
        value = msgpack.unpackb(data, strict_map_key=False)
    except (ValueError, msgpack.exceptions.UnpackException):
        return None
    return value if isinstance(value, dict | list) and msgpack.packb(value) == data else None


def _zeroed(value: Any, key: Any = "") -> Any:
    if isinstance(value, dict):
        return {key: _zeroed(item, key) for key, item in value.items()}
    if isinstance(value, list):
        return [_zeroed(item) for item in value]
    if key == "sent_at":
        return ""
    if isinstance(value, str):
        return _without_ids(value.encode()).decode()
    if isinstance(value, float) and (str(key).endswith("_ms") or key in ("timestamp", "act_s")):
        return 0.0
    return 0 if key == "created" else value


def as_text(data: bytes) -> str:
    """Return bytes as text for a file: printable ASCII as it is, other bytes in hexadecimal within
    «», and `07*192` for repeated bytes.
    """
    return re.sub(rb"[ -~]{4,}|(?:(?![ -~]{4})[\s\S])+", _run, data).decode() or "«»"


def _run(found: re.Match[bytes]) -> bytes:
    data = found[0]
    if len(data) >= 4 and re.fullmatch(rb"[ -~]+", data) and len(set(data)) > 1:
        return data
    runs = [(value, len(list(group))) for value, group in groupby(data)]
    pieces = [f" {value:02x}*{n} " if n > 3 else f"{value:02x}" * n for value, n in runs]
    return f"«{'|'.join(''.join(pieces).split())}»".encode()


def from_text(text: str) -> bytes:
    """Return the bytes of a text that `as_text` wrote."""
    data = b""
    for place, part in enumerate(re.split("[«»]", text)):
        for piece in part.split("|") if place % 2 else ():
            value, _, number = piece.partition("*")
            data += bytes.fromhex(value) * int(number or 1)
        data += b"" if place % 2 else part.encode()
    return data


def described(data: bytes) -> list[str]:
    """Return the lines of a message for a reader, about one field per line."""
    return re.sub(r',(?=")|(?<=.)(?=«)|«0d0a»', r"\g<0>\n", as_text(data)).split("\n")
