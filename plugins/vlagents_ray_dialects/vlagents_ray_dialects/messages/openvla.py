"""The bodies of OpenVLA's REST interface: JSON with arrays in the format of `json-numpy`.

`{"__numpy__": base64, "dtype": "|u1", "shape": [H, W, 3]}` is an array. Clients that do not patch
their json module encode twice: a request is `{"encoded": "<the JSON>"}`, and its reply is a JSON
string that contains the JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, shown
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, MessageLimits
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects.messages.layouts import ALOHA_ACTION, ALOHA_STATE, libero_state


def decode(body: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> tuple[dict[str, Any], bool]:
    """Decode a request.

    Args:
        body: The body.
        limits: The limits of its size and content.

    Returns:
        The observation, and whether the body was encoded twice.

    Raises:
        MalformedMessage: The body is not a request in this format.
        MessageTooLarge: The body exceeds a limit.
    """
    if len(body) > limits.body_bytes:
        raise MessageTooLarge(f"body: expected at most {limits.body_bytes} bytes, got {len(body)}")

    payload = _load(body, limits)
    is_encoded_twice = "encoded" in payload
    if is_encoded_twice:
        if len(payload) != 1 or not isinstance(payload["encoded"], str):
            raise MalformedMessage(
                f"body: expected 'encoded' alone, and text in it, got {shown(payload)}"
            )
        payload = _load(payload["encoded"].encode("utf-8", "replace"), limits)
    return payload, is_encoded_twice


def encode(
    value: np.ndarray | Sequence[np.ndarray] | Mapping[str, Any], twice: bool = False
) -> bytes:
    """Return the body with an action or an observation.

    Args:
        value: The action, as an array or a list of rows, or the observation.
        twice: Whether the body is encoded twice.
    """
    text = json_numpy.dumps(value)
    return (json.dumps(text) if twice else text).encode()


def _load(text: bytes, limits: MessageLimits) -> dict[str, Any]:
    """Return the object in a JSON text."""
    payload = json_numpy.loads(text, limits)
    if not isinstance(payload, dict):
        raise MalformedMessage(f"body: expected an object, got {type(payload).__name__}")
    return payload


def decode_action(body: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> np.ndarray | None:
    """Decode a reply.

    Args:
        body: The body.
        limits: The limits of its size and content.

    Returns:
        The action, (D,) or (H, D); None if the reply is "error", the error of OpenVLA's own server.

    Raises:
        MalformedMessage: The body is something else.
        MessageTooLarge: The body exceeds a limit.
    """
    value = json_numpy.loads(body, limits)
    if isinstance(value, str) and value != "error":  # encoded twice
        value = json_numpy.loads(value, limits)
    if isinstance(value, str):
        return None
    if isinstance(value, list):
        value = json_numpy.rows(value)
    if not isinstance(value, np.ndarray):
        raise MalformedMessage(
            f"action: expected an array, or a list of rows, got {type(value).__name__}"
        )
    return value


# Mappings of the clients of OpenVLA and OpenVLA-OFT.

PRESETS: dict[str, dict[str, Any]] = {
    # openvla, vla-scripts/deploy.py
    "openvla": {
        "cameras": {"front": "image"},
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": {"index": 6, "open": 1.0, "closed": 0.0},
    },
    # openvla-oft: observations as in experiments/robot/libero. vla-scripts/deploy.py replies with
    # the output of the model, 1 = open, which its clients convert to LIBERO's -1 themselves
    # (normalize_gripper_action, invert_gripper_action).
    "openvla-oft": {
        "cameras": {"front": "full_image", "wrist": {"key": "wrist_image", "optional": True}},
        **libero_state("state"),
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": {"index": 6, "open": 1.0, "closed": 0.0},
    },
    # openvla-oft, experiments/robot/aloha/run_aloha_eval.py: `state` is qpos, (14,)
    "openvla-oft-aloha": {
        "cameras": {
            "front": "full_image",
            "left_wrist": {"key": "left_wrist_image", "optional": True},
            "right_wrist": {"key": "right_wrist_image", "optional": True},
        },
        "state": ALOHA_STATE,
        "instruction": "instruction",
        "info": {"unnorm_key": "unnorm_key"},
        "action_gripper": ALOHA_ACTION,
    },
}
