"""Probes of a WebSocket, as clients send them."""

from __future__ import annotations

import os


def bytes_probe(size: int) -> bytes:
    """Return a probe of `size` bytes."""
    return b"VLA?" + bytes(4) + os.urandom(size - 8)


def is_probe_answer(message: bytes, probe: bytes) -> bool:
    """Return whether a message is the answer to that probe."""
    return message == b"VLA!" + len(probe).to_bytes(8, "little")
