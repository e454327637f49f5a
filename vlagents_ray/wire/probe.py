"""A message that is answered at once, for measuring the link: it reaches neither a session nor the policy.

    offset 0   b"VLA?"
           4   any bytes, as many as the link is to carry

It travels as a WebSocket message or as the body of `POST /v1/probe`, under the same limits as a
request. The answer is b"VLA!" and the number of bytes that arrived, uint64 little-endian.
"""

from __future__ import annotations

import os
import struct

from vlagents_ray.errors import MalformedMessage

_ASK = b"VLA?"
_ANSWER = struct.Struct("<4sQ")
_TELL = b"VLA!"

LEAST_BYTES = len(_ASK)


def probe(size: int) -> bytes:
    """A probe of `size` bytes, `LEAST_BYTES` at least; random, so that no tunnel makes it smaller."""
    return _ASK + os.urandom(max(0, size - LEAST_BYTES))


def is_probe(message: bytes | memoryview) -> bool:
    """Is it to be answered with `answer`?"""
    return message[: len(_ASK)] == _ASK


def answer(message: bytes | memoryview) -> bytes:
    """The answer to a probe; `MalformedMessage` if it is none."""
    if not is_probe(message):
        raise MalformedMessage(f"probe: got {bytes(message[:4])!r} at its start, want {_ASK!r}")
    return _ANSWER.pack(_TELL, len(message))


def is_answer(message: bytes | memoryview) -> bool:
    """Does it answer a probe? Nothing else that a server sends begins so."""
    return len(message) == _ANSWER.size and message[: len(_TELL)] == _TELL
