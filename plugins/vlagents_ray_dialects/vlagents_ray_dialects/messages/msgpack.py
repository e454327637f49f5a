"""A reader of msgpack with limits, for the messages of other systems.

A short message can need much memory, as each byte may be an empty list. Values are therefore
counted while they are read, and reading stops at the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.frame_layout import read_array
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.protocol.values import require_plain
from vlagents_ray.registry import require

Hook = Callable[[dict[Any, Any]], Any]


def unpack(
    data: bytes | memoryview, limits: MessageLimits, hook: Hook, text: int | None = None
) -> Any:
    """Decode a message.

    Args:
        data: The message.
        limits: The limits of its size, its number of values and their nesting.
        hook: Receives each map, innermost first, and returns the value that replaces it. The keys
            of a returned map must be text. The values of a returned list, such as an array of text,
            also count towards the limit; the hook itself limits them to `limits.items`.
        text: Maximum size of one text, bytes; None if only the size of the message is limited.

    Returns:
        The value in the message.

    Raises:
        MalformedMessage: The message is not msgpack, or contains extension types.
        MessageTooLarge: The message exceeds a limit.
        InvalidInput: The hook raised it.
    """
    if len(data) > limits.body_bytes:
        raise MessageTooLarge(
            f"message: expected at most {limits.body_bytes} bytes, got {len(data)}"
        )

    msgpack = require("msgpack")
    count = 0

    def counted(values: Any) -> Any:
        """Count the values of a container, and return it."""
        nonlocal count
        count += len(values) + 1
        if count > limits.items:
            raise MessageTooLarge(
                f"message: more than {limits.items} values; send arrays instead of lists"
            )
        return values

    def hooked(values: dict[Any, Any]) -> Any:
        """Count a map, and return the value that replaces it."""
        counted(values)
        replacement = hook(values)
        if isinstance(replacement, list):
            counted(replacement)
            for texts in replacement:
                if isinstance(texts, list):
                    counted(texts)
        return replacement

    try:
        value = msgpack.unpackb(
            data,
            object_hook=hooked,
            list_hook=counted,
            ext_hook=_refuse,
            strict_map_key=False,
            max_str_len=len(data) if text is None else text,
            max_array_len=limits.items,
            max_map_len=limits.items,
        )
    except InvalidInput:
        raise
    except (msgpack.exceptions.UnpackException, ValueError, TypeError, OverflowError) as error:
        if "exceeds max_" in str(error):  # msgpack has no error class for this
            raise MessageTooLarge(f"message: {error}; send arrays instead of lists") from error
        raise MalformedMessage(
            f"message: no msgpack ({type(error).__name__}: {str(error)[:100]})"
        ) from error

    require_plain(value, limits.depth)
    return value


def pack(value: Any, default: Callable[[Any], Any]) -> bytes:
    """Encode a message.

    Args:
        value: The value.
        default: Converts values of types that msgpack does not support, such as arrays, to maps.
    """
    packed: bytes = require("msgpack").packb(value, default=default)
    return packed


def _refuse(code: int, _data: bytes) -> Any:
    """Reject an extension type, which msgpack calls for each of them."""
    raise MalformedMessage(f"message: expected plain values and arrays, got extension type {code}")


# Arrays in the format of the package `msgpack_numpy`: maps with the key `nd`.


def is_packed(node: Mapping[Any, Any]) -> bool:
    """Return whether a map contains an array in this format."""
    return b"nd" in node or "nd" in node


def read_packed(node: Mapping[Any, Any]) -> np.ndarray:
    """Return the array in a map of `msgpack_numpy` as a read-only view."""
    fields = {}
    for key, value in node.items():
        name = key.decode(errors="replace") if isinstance(key, bytes) else key
        fields[name] = value

    dtype, shape, data = fields.get("type"), fields.get("shape"), fields.get("data")
    if not isinstance(data, bytes) or fields.get("kind") not in (None, "", b""):
        raise MalformedMessage(f"array: nd: expected bytes of a plain array, got {shown(data)}")

    dtype = dtype.decode(errors="replace") if isinstance(dtype, bytes) else dtype
    if fields["nd"] is not True:  # a number instead of an array
        shape = []
    if isinstance(shape, tuple):
        shape = list(shape)
    return read_array(data, dtype, shape)


def write_packed(value: Any) -> dict[bytes, Any]:
    """Return the map with an array in the format of `msgpack_numpy`, for msgpack."""
    if isinstance(value, (np.ndarray, np.generic)):
        array = np.ascontiguousarray(value)
        return {
            b"nd": True,
            b"type": array.dtype.str,
            b"kind": b"",
            b"shape": np.shape(value),
            b"data": array.tobytes(),
        }
    raise TypeError(f"cannot send {type(value).__name__}")
