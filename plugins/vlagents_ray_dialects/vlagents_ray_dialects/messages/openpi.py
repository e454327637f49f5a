"""The messages of `openpi-client`: msgpack, in which a map with the key b"__ndarray__" is an array.

The module `openpi_client.msgpack_numpy` of version 0.1.2 defines the format; RoboArena's client has
a copy of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.frame_layout import plain_dtype, read_array
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, MessageLimits
from vlagents_ray_dialects.messages.layouts import ALOHA_ACTION, ALOHA_STATE, libero_state
from vlagents_ray_dialects.messages.msgpack import pack, unpack


def decode(data: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> dict[str, Any]:
    """Decode a message that is a map.

    Args:
        data: The message.
        limits: The limits of its size and content.

    Returns:
        The map. Arrays are read-only views, and an array of text becomes a list.

    Raises:
        MalformedMessage: The message is something else.
        MessageTooLarge: The message exceeds a limit.
    """
    value = decode_any(data, limits)
    if not isinstance(value, dict):
        raise MalformedMessage(f"message: expected a map, got {type(value).__name__}")
    return value


def decode_any(data: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> Any:
    """Decode a message that may be of any type; otherwise like `decode`."""
    return unpack(data, limits, lambda node: _array(node, limits.items))


def encode(value: Any) -> bytes:
    """Return the message for a value that consists of plain values and arrays."""
    return pack(value, _node)


def _array(node: dict[Any, Any], most: int) -> Any:
    """Return the array or number in a map, or the map itself; an array of text may have at most
    `most` texts.
    """
    if b"__ndarray__" in node:
        data, dtype, shape = node.get(b"data"), node.get(b"dtype"), node.get(b"shape")
        if isinstance(dtype, str) and dtype.startswith("<U") and isinstance(data, bytes):
            return _texts(data, dtype, most)
        return read_array(data, dtype, shape)  # type: ignore[arg-type]  # it checks

    if b"__npgeneric__" in node:
        value = node.get(b"data")
        if not isinstance(value, (bool, int, float)):
            raise MalformedMessage(f"scalar: expected a number, got {type(value).__name__}")
        dtype = plain_dtype(node.get(b"dtype"))
        try:
            if dtype.kind in "iu" and not np.iinfo(dtype).min <= value <= np.iinfo(dtype).max:
                raise OverflowError
            return dtype.type(value)
        except (OverflowError, ValueError) as error:
            raise MalformedMessage(f"scalar: {shown(value)} is no {dtype}") from error
    return node


def _texts(data: bytes, dtype: str, most: int) -> list[str]:
    """Return an array of at most `most` texts as a flat list; some clients send a prompt in this
    form.
    """
    length = dtype.removeprefix("<U")
    size = 4 * int(length) if length.isascii() and length.isdigit() and len(length) < 9 else 0
    if not size or len(data) % size:
        raise MalformedMessage(f"array: expected texts of {dtype[:20]!r}, got {len(data)} bytes")
    if len(data) // size > most:
        raise MessageTooLarge(f"array: expected at most {most} more texts, got {len(data) // size}")

    texts = []
    try:
        for begin in range(0, len(data), size):
            text = data[begin : begin + size].decode("utf-32-le")
            texts.append(text.rstrip("\0"))
    except UnicodeDecodeError as error:
        raise MalformedMessage(f"array: no text ({error.reason})") from error
    return texts


def _node(value: Any) -> Any:
    """Return the map with an array, or the number in a scalar of numpy, for msgpack."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {
            b"__ndarray__": True,
            b"data": value.tobytes(),
            b"dtype": value.dtype.str,
            b"shape": value.shape,
        }
    if isinstance(value, np.generic) and value.dtype.kind in "biuf":
        return value.item()
    if isinstance(value, Mapping):
        return dict(value)
    raise TypeError(
        f"cannot send {type(value).__name__}; expected plain values and arrays of numbers"
    )


# Mappings of the example clients of openpi, and of RoboArena's client. openpi's servers accept
# images as (H, W, 3) or (3, H, W), in uint8 or floats in [0, 1]: see `_parse_image` in openpi's
# src/openpi/policies/libero_policy.py and droid_policy.py, and `convert_image` in aloha_policy.py.

PRESETS: dict[str, dict[str, Any]] = {
    # openpi, examples/libero/main.py
    "openpi-libero": {
        "cameras": {
            "front": {"key": "observation/image", "layout": "any"},
            "wrist": {"key": "observation/wrist_image", "layout": "any"},
        },
        **libero_state("observation/state"),
        "instruction": "prompt",
        "action_gripper": {"index": 6, "open": -1.0, "closed": 1.0},
    },
    # openpi, examples/droid/main.py; DROID's observed gripper is 0 when it is open
    "openpi-droid": {
        "cameras": {
            "front": {"key": "observation/exterior_image_1_left", "layout": "any"},
            "wrist": {"key": "observation/wrist_image_left", "layout": "any"},
        },
        "state": {"joints": {"key": "observation/joint_position", "stop": 7}},
        "gripper": {"key": "observation/gripper_position", "open": 0.0, "closed": 1.0},
        "instruction": "prompt",
        "action_gripper": {"index": 7, "open": 0.0, "closed": 1.0},
    },
    # openpi, examples/aloha_sim/env.py
    "openpi-aloha": {
        "cameras": {
            "front": {"key": "images/cam_high", "layout": "chw"},
            "left_wrist": {"key": "images/cam_left_wrist", "layout": "chw", "optional": True},
            "right_wrist": {"key": "images/cam_right_wrist", "layout": "chw", "optional": True},
        },
        "state": ALOHA_STATE,
        "instruction": "prompt",
        "action_gripper": ALOHA_ACTION,
    },
}

ROBOARENA: dict[str, dict[str, Any]] = {
    # The keys are those of openpi's DROID client, but the camera numbers begin with 0.
    "roboarena": PRESETS["openpi-droid"]
    | {
        "cameras": {
            "front": {"key": "observation/exterior_image_0_left", "layout": "any"},
            "front_2": {
                "key": "observation/exterior_image_1_left",
                "layout": "any",
                "optional": True,
            },
            "wrist": {"key": "observation/wrist_image_left", "layout": "any", "optional": True},
        },
        "info": {"session_id": "session_id"},
    }
}
