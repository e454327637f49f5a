"""OpenVLA's REST bodies: JSON with arrays as `json-numpy` writes them, plain or encoded twice.

`{"__numpy__": base64, "dtype": "|u1", "shape": [H, W, 3]}` is an array. Encoded twice, for clients that do not patch
their json module, a request is `{"encoded": "<the JSON>"}` and its answer a JSON string that holds the JSON.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge
from vlagents_ray.wire.arrays import read_array
from vlagents_ray.wire.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.wire.tree import require_plain


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
    require_plain(payload, limits.depth)
    return payload, twice


def encode(action: np.ndarray | Sequence[np.ndarray], twice: bool) -> bytes:
    """An action, (D,), or several of them, as the answer to a request."""
    node = _node(action) if isinstance(action, np.ndarray) else [_node(row) for row in action]
    text = json.dumps(node)
    return (json.dumps(text) if twice else text).encode()


def _load(text: bytes, limits: Limits) -> dict[str, Any]:
    if sum(map(text.count, (b",", b"[", b"{"))) > limits.items:  # none of them is in base64
        raise MessageTooLarge(
            f"body: more than {limits.items} values; send arrays as json-numpy writes them, not lists"
        )
    try:
        payload = json.loads(text, object_hook=_array)
    except InvalidInput:
        raise
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"body: not JSON ({error})") from error
    if not isinstance(payload, dict):
        raise MalformedMessage(f"body: got {type(payload).__name__}, want an object")
    return payload


def _array(node: dict[str, Any]) -> Any:
    if "__numpy__" not in node:
        return node
    encoded = node["__numpy__"]
    if not isinstance(encoded, str):
        raise MalformedMessage(f"array: got {type(encoded).__name__} for '__numpy__', want base64")
    try:
        data = base64.b64decode(encoded, validate=True)
    except (binascii.Error, ValueError) as error:
        raise MalformedMessage(f"array: no base64 ({error})") from error
    return read_array(data, node.get("dtype"), node.get("shape"))


def _node(value: np.ndarray) -> dict[str, Any]:
    return {
        "__numpy__": base64.b64encode(value.tobytes()).decode(),
        "dtype": value.dtype.str,
        "shape": list(value.shape),
    }
