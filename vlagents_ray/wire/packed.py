"""msgpack, read within limits: for the messages of others. Ours are frames.

A message of few bytes can ask for much memory (each byte an empty list); here the values are counted while they are
read, and reading stops at the limit.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from vlagents_ray.errors import InvalidInput, MalformedMessage, MessageTooLarge
from vlagents_ray.registry import require
from vlagents_ray.wire.messages import Limits
from vlagents_ray.wire.tree import require_plain

Hook = Callable[[dict[Any, Any]], Any]


def unpack(data: bytes, limits: Limits, hook: Hook) -> Any:
    """The value in `data`. `hook` gets each map, innermost first, and gives what stands in its place.

    In what it leaves, keys are text. Raises `MalformedMessage` or `MessageTooLarge`, and whatever `InvalidInput`
    the hook raises.
    """
    if len(data) > limits.body_bytes:
        raise MessageTooLarge(f"message: got {len(data)} bytes, the limit is {limits.body_bytes}")
    msgpack = require("msgpack")
    count = 0

    def counted(values: Any) -> Any:
        nonlocal count
        count += len(values) + 1
        if count > limits.items:
            raise MessageTooLarge(f"message: more than {limits.items} values; send arrays instead of lists")
        return hook(values) if isinstance(values, dict) else values

    try:
        value = msgpack.unpackb(
            data,
            object_hook=counted,
            list_hook=counted,
            ext_hook=_refuse,
            strict_map_key=False,
            max_array_len=limits.items,
            max_map_len=limits.items,
        )
    except InvalidInput:
        raise
    except (msgpack.exceptions.UnpackException, ValueError, TypeError, OverflowError) as error:
        if "exceeds max_" in str(error):  # msgpack has no class of its own for it
            raise MessageTooLarge(f"message: {error}; send arrays instead of lists") from error
        raise MalformedMessage(f"message: no msgpack ({type(error).__name__}: {str(error)[:100]})") from error
    require_plain(value, limits.depth)
    return value


def pack(value: Any, default: Callable[[Any], Any]) -> bytes:
    """`value` as msgpack; `default` gives maps for what it does not know, such as arrays."""
    packed: bytes = require("msgpack").packb(value, default=default)
    return packed


def _refuse(code: int, _data: bytes) -> Any:
    raise MalformedMessage(f"message: got an extension type, {code}; want plain values and arrays")
