"""OpenVLA's REST bodies: JSON with arrays as `json-numpy` writes them, plain or encoded twice.

`{"__numpy__": base64, "dtype": "|u1", "shape": [H, W, 3]}` is an array. Encoded twice, for clients that do not patch
their json module, a request is `{"encoded": "<the JSON>"}` and its answer a JSON string that holds the JSON.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.wire import json_numpy
from vlagents_ray.wire.messages import DEFAULT_LIMITS, Limits


def decode(body: bytes, limits: Limits = DEFAULT_LIMITS) -> tuple[dict[str, Any], bool]:
    """The observation in a request's body, and whether it was encoded twice.

    Raises `MalformedMessage` or `MessageTooLarge`.
    """
    if len(body) > limits.body_bytes:
        raise MessageTooLarge(f"body: got {len(body)} bytes, the limit is {limits.body_bytes}")
    payload = _load(body, limits)
    if twice := "encoded" in payload:
        if len(payload) != 1 or not isinstance(payload["encoded"], str):
            raise MalformedMessage("body: want 'encoded' alone, and text in it")
        payload = _load(payload["encoded"].encode("utf-8", "replace"), limits)
    return payload, twice


def encode(action: np.ndarray | Sequence[np.ndarray], twice: bool) -> bytes:
    """An action, (D,), or several of them, as the answer to a request."""
    text = json_numpy.dumps(action)
    return (json.dumps(text) if twice else text).encode()


def _load(text: bytes, limits: Limits) -> dict[str, Any]:
    payload = json_numpy.loads(text, limits)
    if not isinstance(payload, dict):
        raise MalformedMessage(f"body: got {type(payload).__name__}, want an object")
    return payload
