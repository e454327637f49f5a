"""JSON with arrays in the format of the package `json_numpy`: `{"__numpy__": base64, "dtype",
"shape"}`.
"""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.frame_layout import read_array
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.protocol.values import require_plain

_KEYS = {"__numpy__", "dtype", "shape"}


def loads(text: str | bytes, limits: MessageLimits, levels: int = 0) -> Any:
    """Return the value of a JSON document, whose arrays are read-only. The document may be nested
    `levels` deeper than the limit.
    """
    if len(text) > limits.body_bytes:
        raise MessageTooLarge(
            f"document: expected at most {limits.body_bytes} bytes, got {len(text)}"
        )
    marks: tuple[Any, ...] = (",", "[", "{") if isinstance(text, str) else (b",", b"[", b"{")
    if sum(map(text.count, marks)) > limits.items:  # base64 text contains none of these characters
        raise MessageTooLarge(
            f"document: more than {limits.items} values; send arrays as json-numpy writes them"
        )
    try:
        value = json.loads(text, object_hook=_hook)
    except MalformedMessage:
        raise
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"document: not JSON ({error})") from error
    require_plain(value, limits.depth + levels)
    return value


def dumps(value: Any) -> str:
    """Return a value as a JSON document; raise `InvalidInput` for an unsupported type."""
    return json.dumps(value, default=_plain)


def rows(value: list[Any]) -> np.ndarray:
    """Convert a list of numbers, lists or arrays to one array; raise `MalformedMessage` if that is
    impossible.
    """
    if value and all(isinstance(row, np.ndarray) for row in value):
        shapes = {row.shape for row in value}
        if len(shapes) != 1:
            raise MalformedMessage(
                f"action: expected rows of the same shape, got the shapes {sorted(shapes)[:8]}"
            )
        return np.stack(value)
    try:
        array = np.asarray(value)
    except ValueError as error:
        raise MalformedMessage(f"action: expected an array of numbers ({error})") from error
    if array.dtype.kind not in "fiu":
        raise MalformedMessage(f"action: expected numbers, got {array.dtype}")
    return array


def decode_base64(data: object, name: str) -> bytes:
    """Decode base64 in the standard or the URL-safe alphabet; errors call the data `name`."""
    if not isinstance(data, str):
        raise MalformedMessage(f"{name}: expected base64, got {type(data).__name__}")
    try:
        altchars = b"-_" if "-" in data or "_" in data else None
        return base64.b64decode(data, altchars, validate=True)
    except (binascii.Error, ValueError) as error:
        raise MalformedMessage(f"{name}: not base64 ({error})") from error


def _hook(node: dict[str, Any]) -> Any:
    """Return the array that an object describes, or the object itself."""
    if "__numpy__" not in node:
        return node
    if node.keys() != _KEYS:
        raise MalformedMessage(f"array: expected the keys {sorted(_KEYS)}, got {shown(list(node))}")
    return read_array(decode_base64(node["__numpy__"], "array"), node["dtype"], node["shape"])


def _plain(value: Any) -> Any:
    """Convert an array, a mapping, bytes or a sequence to a value that `json` can encode."""
    if isinstance(value, (np.ndarray, np.generic)):
        if value.dtype.kind not in "biuf":
            raise InvalidInput(
                f"document: expected a dtype of bool, integers or floats, got {value.dtype}"
            )
        array = np.ascontiguousarray(value, dtype=value.dtype.newbyteorder("<"))
        return {
            "__numpy__": base64.b64encode(array.tobytes()).decode(),
            "dtype": array.dtype.str,
            "shape": list(np.shape(value)),
        }
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, (bytes, bytearray, memoryview)):
        return base64.b64encode(value).decode()
    if isinstance(value, Sequence):
        return list(value)
    raise InvalidInput(
        "document: expected a value that JSON or an array can represent, got "
        f"{type(value).__name__}"
    )
