"""A message that is answered at once, for measuring the link: it reaches neither a session nor the policy.

    offset 0   b"VLA?"
           4   what follows, uint32 little-endian: 0 any bytes, 1 the frame of a request
           8   that, as much as the link is to carry; a frame is decoded before the answer

It travels as a WebSocket message or as the body of `POST /v1/probe`, under the same limits as a
request. The answer is b"VLA!" and the number of bytes that arrived, uint64 little-endian.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.wire.arrays import Buffer
from vlagents_ray.wire.messages import Reply, Request

_HEAD = struct.Struct("<4sI")
_ASK, _TELL = b"VLA?", b"VLA!"
_ANSWER = struct.Struct("<4sQ")

LEAST_BYTES = _HEAD.size


def bytes_probe(size: int) -> bytes:
    """A probe of `size` bytes, `LEAST_BYTES` at least; random, so that no tunnel makes it smaller."""
    return _HEAD.pack(_ASK, 0) + os.urandom(max(0, size - LEAST_BYTES))


def frame_probe(parts: list[Buffer]) -> bytes:
    """A probe with a frame, given in pieces as `frames.request_parts` returns them."""
    return b"".join((_HEAD.pack(_ASK, 1), *parts))


def is_probe(message: Buffer) -> bool:
    """Is it to be answered with `answer`?"""
    return message[: len(_ASK)] == _ASK


def probed_frame(message: bytes) -> bytes | None:
    """The frame to decode before the answer, if there is one; `MalformedMessage` if it is no probe."""
    if len(message) < _HEAD.size or not is_probe(message):
        raise MalformedMessage(f"probe: got {message[:4]!r} at its start, want {_ASK!r} and what follows it")
    _, kind = _HEAD.unpack_from(message)
    if kind > 1:
        raise MalformedMessage(f"probe: got kind {kind}, want 0 for any bytes or 1 for a frame")
    return message[_HEAD.size :] if kind else None


def answer(message: Buffer, requests: Sequence[Request | Reply] = ()) -> bytes:
    """The answer to a probe, of whose frame `requests` were decoded; raises what kept one from being read."""
    for request in requests:
        if isinstance(request, Reply) and request.error is not None:
            raise request.error
    return _ANSWER.pack(_TELL, len(message))


def is_answer(message: Buffer) -> bool:
    """Does it answer a probe? Nothing else that a server sends begins so."""
    return len(message) == _ANSWER.size and message[: len(_TELL)] == _TELL
