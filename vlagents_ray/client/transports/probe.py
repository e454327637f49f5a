"""A message that is answered at once, to measure the link: it reaches neither a session nor the policy.

    offset 0   b"VLA?"
           4   uint32, not read
           8   any bytes, as many as the link is to carry

It travels as a WebSocket message or as the body of `POST /v1/probe`, under the same limits as a request. The answer is
b"VLA!" and the number of bytes that arrived, uint64 little-endian.
"""

from __future__ import annotations

import os
import struct

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.protocol.arrays import Buffer
from vlagents_ray.protocol.messages import Budget

_HEAD = struct.Struct("<4sI")
_PROBE_TAG, _ANSWER_TAG = b"VLA?", b"VLA!"
_ANSWER = struct.Struct("<4sQ")

LEAST_BYTES = _HEAD.size


def bytes_probe(size: int) -> bytes:
    """Return a probe of `size` bytes, at least `LEAST_BYTES`; random, so that no tunnel compresses it."""
    return _HEAD.pack(_PROBE_TAG, 0) + os.urandom(max(0, size - LEAST_BYTES))


def is_probe(message: Buffer) -> bool:
    """Whether a message is a probe, to be answered with `answer`."""
    return message[: len(_PROBE_TAG)] == _PROBE_TAG


def read_probe(message: bytes, budget: Budget) -> None:
    """Count a probe as one request of a simulation; raise `MalformedMessage` for any other message."""
    budget.begin_message()
    if not is_probe(message):
        raise MalformedMessage(f"probe: got {message[:4]!r} at its start, want {_PROBE_TAG!r}")
    if len(message) < LEAST_BYTES:
        raise MalformedMessage(f"probe: got {len(message)} bytes, want at least {LEAST_BYTES}")
    budget.begin("probe", "simulation")


def answer(size: int) -> bytes:
    """Return the answer to a probe of `size` bytes."""
    return _ANSWER.pack(_ANSWER_TAG, size)


def is_answer(message: Buffer) -> bool:
    """Whether a message is the answer to a probe; no other message of a server begins like it."""
    return len(message) == _ANSWER.size and message[: len(_ANSWER_TAG)] == _ANSWER_TAG
