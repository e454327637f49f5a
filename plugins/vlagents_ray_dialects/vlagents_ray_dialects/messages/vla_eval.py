"""vla-eval's messages: msgpack maps of type, payload, seq and timestamp, protocol version 1.

Arrays are maps with the key "__ndarray__"; images are maps with the key "__image__", raw, PNG or
JPEG. The module `vla_eval.protocol` of version 0.8.0 defines the format.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import MalformedMessage, MessageTooLarge, shown
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.protocol.frame_layout import read_array
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, MessageLimits
from vlagents_ray_dialects.messages.layouts import ALOHA_ACTION, ALOHA_STATE
from vlagents_ray_dialects.messages.msgpack import pack, unpack

PROTOCOL_VERSION = 1
Kind = Literal["hello", "observation", "action", "episode_start", "episode_end", "error"]


@dataclass(slots=True)
class VlaEvalMessage:
    """One message, in either direction; a reply has the sequence number of its request."""

    kind: Kind
    payload: dict[str, Any]
    seq: int = 0


# vla-eval's names of rotations and grippers (`vla_eval.specs`). A gripper is named by the values
# that open and close it.
_ROTATIONS = {
    "axis_angle": ("axis_angle", 3),
    "euler_xyz": ("euler_xyz", 3),
    "quat_xyzw": ("quaternion_xyzw", 4),
    "quat_wxyz": ("quaternion_wxyz", 4),
}
_GRIPPERS = {
    (-1.0, 1.0): "binary_close_positive",
    (1.0, -1.0): "binary_close_negative",
    (1.0, 0.0): "continuous_01",
    (0.0, 1.0): "binary_close_01",
}


def action_spec(
    action: ActionSpec, opens_and_closes: tuple[float, float] | None
) -> dict[str, dict[str, Any]]:
    """Return the parts of an action that the contract declares, as vla-eval's `DimSpec.to_dict`
    does, for a policy that commands the pose of one arm; empty for any other.

    Args:
        action: The action of the contract.
        opens_and_closes: The values that open and close the gripper for the client; None if they
            are not known.
    """
    if action.space != "ee_pose" or len(action.arms or ("",)) != 1:
        return {}
    spec: dict[str, dict[str, Any]] = {}
    if action.relative is not None:
        kind = "delta_xyz" if action.relative else "absolute_xyz"
        spec["position"] = {"name": "position", "dims": 3, "format": kind}
    if action.rotation in _ROTATIONS:
        kind, size = _ROTATIONS[action.rotation]
        spec["rotation"] = {"name": "rotation", "dims": size, "format": kind}
    gripper = None if opens_and_closes is None else _GRIPPERS.get(opens_and_closes)
    if gripper is not None:
        spec["gripper"] = {"name": "gripper", "dims": 1, "format": gripper}
    return spec


def observation_spec(contract: Contract) -> dict[str, dict[str, Any]]:
    """Return the parts of an observation that the policy needs, as `action_spec` does. A state is
    not among them, since a contract does not describe the order of vla-eval's state.
    """
    spec: dict[str, dict[str, Any]] = {}
    if contract.cameras:
        spec["image"] = {"name": "image", "dims": 0, "format": "rgb_hwc_uint8"}
    if contract.instruction:
        spec["language"] = {"name": "language", "dims": 0, "format": "language"}
    return spec


class _File(bytes):
    """A JPEG or PNG image that is not decoded yet."""


def decode(data: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> VlaEvalMessage:
    """Decode a message.

    Args:
        data: The message.
        limits: The limits of its size and content.

    Returns:
        The message. Its JPEG and PNG images are still encoded, see `decode_images`.

    Raises:
        MalformedMessage: The message is invalid.
        MessageTooLarge: The message exceeds a limit.
    """
    image_count = 0

    def array(node: dict[Any, Any]) -> Any:
        """Return the array or the image in a map."""
        nonlocal image_count
        if "__image__" in node:
            image_count += 1
            if image_count > limits.cameras:
                raise MessageTooLarge(f"message: more than {limits.cameras} images")
            return _image(node)
        if "__ndarray__" in node:
            return read_array(node.get("data"), node.get("dtype"), node.get("shape"))  # type: ignore[arg-type]
        return node

    raw = unpack(data, limits, array)
    if not isinstance(raw, dict) or not raw.keys() >= {"type", "payload", "seq"}:
        raise MalformedMessage(
            f"message: expected a map with type, payload and seq, got {shown(raw)}"
        )

    kind, payload, seq = raw["type"], raw["payload"], raw["seq"]
    if not isinstance(kind, str) or kind not in get_args(Kind):
        raise MalformedMessage(f"type: expected one of {list(get_args(Kind))}, got {shown(kind)}")
    if not isinstance(payload, dict):
        raise MalformedMessage(f"payload: expected a map, got {type(payload).__name__}")
    if type(seq) is not int or not 0 <= seq < 2**63:
        raise MalformedMessage(f"seq: expected a whole number, got {shown(seq)}")
    return VlaEvalMessage(kind, payload, seq)  # type: ignore[arg-type]  # the kind was checked above


def decode_images(payload: dict[str, Any], budget: Budget) -> dict[str, Any]:
    """Decode the images of an observation.

    Args:
        payload: The payload of a message from `decode`.
        budget: Counts the decoded images; raises an error beyond its limits.

    Returns:
        The payload with images, (H, W, 3) uint8 RGB.
    """
    files: dict[int, _File] = {}
    names: dict[int, str] = {}

    def find(node: Any, path: str) -> None:
        """Add the files within a node, with their paths."""
        if isinstance(node, _File):
            files[id(node)] = node
            names.setdefault(id(node), path)
        elif isinstance(node, (dict, list)):
            for key, item in node.items() if isinstance(node, dict) else enumerate(node):
                find(item, f"{path}/{key}" if path else str(key))

    find(payload, "")
    decoded = decode_files(list(files.values()), budget, list(names.values()))
    images = dict(zip(files, decoded, strict=True))

    def filled(node: Any) -> Any:
        """Return a node with images in place of its files."""
        if isinstance(node, _File):
            return images[id(node)]
        if isinstance(node, dict):
            return {key: filled(item) for key, item in node.items()}
        return [filled(item) for item in node] if isinstance(node, list) else node

    return {key: filled(item) for key, item in payload.items()}


def encode(message: VlaEvalMessage) -> bytes:
    """Encode a message with the current time."""
    fields = {
        "type": message.kind,
        "payload": message.payload,
        "seq": message.seq,
        "timestamp": time.time(),
    }
    return pack(fields, _node)


def _image(node: dict[Any, Any]) -> np.ndarray | _File:
    """Return the image in a map, which is still encoded unless it is raw."""
    data, form = node.get("data"), node.get("format")
    if form == "raw":
        return read_array(data, node.get("dtype"), node.get("shape"))  # type: ignore[arg-type]  # it checks
    if form not in ("png", "jpeg") or not isinstance(data, bytes):
        raise MalformedMessage(
            f"image: expected the format raw, png or jpeg, and bytes, got {shown(form, 20)}"
        )
    return _File(data)


def _node(value: Any) -> Any:
    """Return the map with an array, or the number in a scalar of numpy, for msgpack."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "biuf":
        return {
            "__ndarray__": True,
            "data": value.tobytes(),
            "dtype": value.dtype.str,
            "shape": list(value.shape),
        }
    if isinstance(value, np.generic) and value.dtype.kind in "biuf":
        return value.item()
    raise TypeError(
        f"cannot send {type(value).__name__}; expected plain values and arrays of numbers"
    )


# The mappings of vla-eval's benchmarks.


def _two_arms(state_key: str, cameras: dict[str, str]) -> dict[str, Any]:
    """Return the mapping of a benchmark with two arms of six joints and a gripper each.

    Angles are in rad, grippers in [0, 1] with 1 open; the left arm comes first. Only the head
    camera is needed, as a benchmark may omit the other cameras.

    Args:
        state_key: The benchmark's name of the state, whose layout is also that of the actions.
        cameras: The benchmark's names of the cameras, by ours.
    """
    state = {}
    for name, source in ALOHA_STATE.items():
        state[name] = {**source, "key": state_key, "optional": True}
    mapped_cameras = {}
    for name, key in cameras.items():
        mapped_cameras[name] = {"key": f"images/{key}", "optional": name != "front"}
    return {
        "cameras": mapped_cameras,
        "state": state,
        "instruction": "task_description",
        "action_gripper": ALOHA_ACTION,
    }


PRESETS: dict[str, dict[str, Any]] = {
    # The benchmark chooses the names of cameras. Most benchmarks call the state `states`, which
    # vla-eval's own servers prefer; some call it `state`, as its types.py recommends. RoboTwin
    # calls it `joint_state`.
    "vla-eval": {
        "cameras": {"*": "images/*"},
        "state": {"state": {"key": "states|state|joint_state", "optional": True}},
        "instruction": "task_description",
    },
    # vla_eval/benchmarks/robodojo/benchmark.py: two ARX X5
    "robodojo": _two_arms(
        "state",
        {"front": "cam_head", "left_wrist": "cam_left_wrist", "right_wrist": "cam_right_wrist"},
    ),
    # vla_eval/benchmarks/robotwin/benchmark.py: two ALOHA arms
    "robotwin": _two_arms(
        "joint_state",
        {"front": "head_camera", "left_wrist": "left_camera", "right_wrist": "right_camera"},
    ),
}
