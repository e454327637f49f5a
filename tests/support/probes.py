"""Probes of a WebSocket, as a client makes them."""

from __future__ import annotations

import os


def bytes_probe(size: int) -> bytes:
    """A probe of `size` bytes."""
    return b"VLA?" + bytes(4) + os.urandom(size - 8)


def is_probe_answer(message: bytes, probe: bytes) -> bool:
    """Whether a message is the answer to that probe."""
    return message == b"VLA!" + len(probe).to_bytes(8, "little")
