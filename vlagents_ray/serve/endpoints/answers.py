"""Encoding of the replies of a message, which completes their `timing`.

Replies are encoded as a frame, in compact form, as a JSON document, or for another system's client.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, TypeVar

from vlagents_ray.protocol.compact import write_answers
from vlagents_ray.protocol.frames import encode_replies
from vlagents_ray.protocol.json_messages import reply_to_json
from vlagents_ray.serve.requests import IncomingMessage

T = TypeVar("T")


def as_frame(message: IncomingMessage) -> bytes:
    """Encode the replies as a frame."""
    return encode_replies(message.replies, arrived=message.arrived)


def as_compact(message: IncomingMessage) -> bytes | None:
    """Encode the replies in compact form; return None if that form cannot represent them."""
    return write_answers(message.replies, arrived=message.arrived)


def as_document(message: IncomingMessage) -> bytes:
    """Encode the only reply, which must not be an error, as JSON."""
    begun = time.perf_counter()
    [reply] = message.replies
    document = reply_to_json(reply)
    document.pop("timing")
    text = _json(document)
    _complete_timing(message, begun)
    return f'{text[:-1]},"timing":{_json(reply.timing)}}}'.encode()


def timed(message: IncomingMessage, encode: Callable[[], T]) -> T:
    """Encode the replies with `encode`, for a client of another system.

    The `timing` of a reply is complete only after this call.
    """
    begun = time.perf_counter()
    encoded = encode()
    _complete_timing(message, begun)
    return encoded


def _complete_timing(message: IncomingMessage, begun: float) -> None:
    """Add the time of the encoding, which began at the time `begun`, s, and the time of the whole
    message.
    """
    ended = time.perf_counter()
    for reply in message.replies:
        reply.timing["encode_ms"] = (ended - begun) * 1e3
        reply.timing["total_ms"] = (ended - message.arrived) * 1e3


def _json(value: dict[str, Any]) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":"))
