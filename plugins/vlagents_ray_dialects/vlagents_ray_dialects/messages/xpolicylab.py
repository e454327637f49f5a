"""XPolicyLab's messages: msgpack maps of type, ids and payload, with arrays as the package
`msgpack_numpy` writes them.

The modules `client_server/ws/protocol/{schemas,codec,messages}.py` of XPolicyLab define the format:
commit 7198143e has the first generation of the protocol, in which a client sends only `infer`. The
second generation adds `call`, which names a method of the policy. Observations have XPolicyLab's
data format v1.0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import Any

import numpy as np

from vlagents_ray.errors import (
    DeadlineExceeded,
    MalformedMessage,
    MessageTooLarge,
    VLAgentsError,
    shown,
)
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.protocol.messages import NAME_CHARACTERS, Budget
from vlagents_ray_dialects.messages.layouts import ALOHA_ACTION
from vlagents_ray_dialects.messages.msgpack import (
    is_packed,
    pack,
    read_packed,
    unpack,
    write_packed,
)

# The type of the answer to each message; a `close` has no answer.
ANSWERS = {
    "hello": "hello_ack",
    "prepare_case": "prepare_case_ack",
    "reset": "reset_result",
    "infer": "infer_result",
    "call": "call_result",
    "trial_end": "trial_end_ack",
    "heartbeat": "heartbeat_ack",
}
CLOSE, ERROR = "close", "error"

_FAILED = {"infer": "infer_failed", "call": "call_failed", "reset": "reset_failed"}
_IMAGE_KEYS = ("color", "colors", "rgb", "image")  # image keys of a camera
# The comment in a JPEG whose channels are red, green, blue. In a JPEG without it the channels are
# reversed, since OpenCV wrote it from RGB pixels (`encode_image_bit` in XPolicyLab's
# process_data.py).
_RGB_COMMENT = b"\xff\xfe\x00\x0aXPL-RGB1"
_HEADER_BYTES = 4096  # the number of bytes in which the comment is searched


@dataclass(frozen=True, slots=True)
class Frame:
    """One message, in either direction.

    Attributes:
        kind: The type of the message; empty if the message has none.
        message_id: The id of the message, which stays the same when a client repeats the message;
            empty if the message has none.
        labels: The fields that an answer repeats: the ids of evaluation, case and trial, and two
            numbers.
        payload: The content.
    """

    kind: str
    message_id: str
    labels: dict[str, Any]
    payload: Any

    def require_valid(self) -> None:
        """Raise `MalformedMessage` if the message has no id, an unknown type, or a payload that is
        not a map.
        """
        if not self.message_id:
            raise MalformedMessage(
                f"message_id: expected a text of 1 to {NAME_CHARACTERS} characters, got none"
            )
        if not self.labels["evaluation_id"]:
            raise MalformedMessage("evaluation_id: expected a text, got none")
        if self.kind not in ANSWERS and self.kind != CLOSE:
            raise MalformedMessage(
                f"message_type: expected one of {[*ANSWERS, CLOSE]}, got {shown(self.kind)}"
            )
        if not isinstance(self.payload, dict):
            raise MalformedMessage(f"payload: expected a map, got {type(self.payload).__name__}")


NO_FRAME = Frame("", "", {"evaluation_id": ""}, {})  # stands for a message that cannot be read


def decode(data: bytes, budget: Budget) -> Frame:
    """Decode a message.

    Args:
        data: The message.
        budget: The limits of its size and content.

    Returns:
        The message, which `Frame.require_valid` checks. Arrays are read-only views of `data`, and
        images that are files are still encoded, see `read_observation`.

    Raises:
        MalformedMessage: The message is not a map.
        MessageTooLarge: The message exceeds a limit.
    """
    raw = unpack(data, budget.limits, _node)
    if not isinstance(raw, dict):
        raise MalformedMessage(f"message: expected a map, got {type(raw).__name__}")

    labels = {
        "evaluation_id": _text(raw.get("evaluation_id")) or "",
        "action_case_id": _text(raw.get("action_case_id")),
        "trial_id": _text(raw.get("trial_id")),
        "repeat_index": _number(raw.get("repeat_index")),
        "step": _number(raw.get("step")) or 0,
    }
    payload = raw.get("payload")
    return Frame(
        kind=_text(raw.get("message_type")) or "",
        message_id=_text(raw.get("message_id")) or "",
        labels=labels,
        payload={} if payload is None else payload,
    )


def encode(frame: Frame) -> bytes:
    """Encode a message with the current time."""
    fields = {
        "message_type": frame.kind,
        "message_id": frame.message_id,
        **frame.labels,
        "sent_at": datetime.now(timezone.utc).isoformat(timespec="microseconds"),
        "payload": frame.payload,
    }
    return pack(fields, write_packed)


def answer(frame: Frame, payload: Mapping[str, Any]) -> bytes:
    """Return the answer to a message."""
    return encode(replace(frame, kind=ANSWERS[frame.kind], payload=payload))


def error_answer(frame: Frame, error: VLAgentsError, request_id: str) -> bytes:
    """Return the answer to a message that failed.

    Args:
        frame: The message; `NO_FRAME` if it could not be read.
        error: The error.
        request_id: The id of the request in the server's log.
    """
    payload = {
        "code": _error_code(frame, error),
        "message": f"{error} (request {request_id})",
        "details": {"code": error.code, "request_id": request_id},
    }
    return encode(replace(frame, kind=ERROR, payload=payload))


def digest(value: Any) -> bytes:
    """Return the SHA-256 of a value in a message, whose arrays may be views of the message."""
    hasher = hashlib.sha256()
    _hash(value, hasher.update)
    return hasher.digest()


def batch_of(value: Any, most: int) -> list[dict[str, Any]]:
    """Return the observations of a batch.

    Args:
        value: The list of observations that a client sent.
        most: The largest number of observations.

    Raises:
        MalformedMessage: The value is not a list of maps.
        MessageTooLarge: The list has too many observations.
    """
    if not isinstance(value, list) or not value:
        raise MalformedMessage(f"obs: expected a list of observations, got {shown(value)}")
    if len(value) > most:
        raise MessageTooLarge(f"obs: expected at most {most} observations, got {len(value)}")
    for observation in value:
        require_observation(observation)
    return value


def require_observation(value: Any) -> dict[str, Any]:
    """Return an observation; raise `MalformedMessage` if the value is not a map."""
    if not isinstance(value, dict):
        raise MalformedMessage(f"observation: expected a map, got {type(value).__name__}")
    return value


def environment_of(observation: Mapping[str, Any], default: int = 0) -> int:
    """Return the index of the environment of an observation.

    Args:
        observation: The observation.
        default: The index if the observation has none.

    Raises:
        MalformedMessage: The value is not an index.
    """
    return environment_index(observation.get("env_idx", default))


def environment_index(value: Any) -> int:
    """Return the index of an environment; raise `MalformedMessage` for any other value."""
    if isinstance(value, np.ndarray) and value.dtype.kind in "iu" and value.size == 1:
        value = value.item()
    if type(value) is not int or not 0 <= value < 2**31:
        raise MalformedMessage(f"env_idx: expected the index of an environment, got {shown(value)}")
    return value


def read_observation(observation: Mapping[str, Any], budget: Budget) -> dict[str, Any]:
    """Decode the images of an observation, and choose its instruction.

    Args:
        observation: The observation of a client.
        budget: Counts the decoded images; raises an error beyond its limits.

    Returns:
        The observation with images, (H, W, 3) uint8 RGB, under `vision/NAME/color`, and one
        `instruction`.

    Raises:
        MalformedMessage: An image cannot be decoded.
        MessageTooLarge: There are too many images, or they are too large.
    """
    vision = observation.get("vision")
    cameras = dict(vision) if isinstance(vision, Mapping) else {}
    if len(cameras) > budget.limits.cameras:
        raise MessageTooLarge(
            f"vision: expected at most {budget.limits.cameras} cameras, got {len(cameras)}"
        )

    files: dict[str, bytes] = {}
    for name, camera in cameras.items():
        views = dict(camera) if isinstance(camera, Mapping) else {"color": camera}
        cameras[name] = views
        image = next((views[key] for key in _IMAGE_KEYS if key in views), None)
        if isinstance(image, np.ndarray) and image.dtype == np.uint8 and image.ndim == 1:
            image = image.tobytes()
        if isinstance(image, bytes):
            # XPolicyLab stores images in a column of HDF5, which pads them.
            files[name] = image.rstrip(b"\0")
        elif image is not None:
            views["color"] = image

    decoded = decode_files(list(files.values()), budget, list(files))
    for (name, file), image in zip(files.items(), decoded, strict=True):
        is_rgb = _RGB_COMMENT in file[:_HEADER_BYTES]
        cameras[name]["color"] = image if is_rgb else np.ascontiguousarray(image[..., ::-1])

    read: dict[str, Any] = dict(observation)
    if isinstance(vision, Mapping):
        read["vision"] = cameras
    texts = observation.get("instructions")
    if "instruction" not in observation and isinstance(texts, list) and texts:
        read["instruction"] = texts[0]
    return read


def read_observations(
    observations: Sequence[Mapping[str, Any]], budget: Budget
) -> list[dict[str, Any]]:
    """Read each observation with `read_observation`."""
    return [read_observation(observation, budget) for observation in observations]


def action_maps(columns: Mapping[str, np.ndarray]) -> list[dict[str, np.ndarray]]:
    """Return a chunk in the client's format, one map for each row.

    Args:
        columns: The columns of the chunk by the client's names, each (H, n) float32.
    """
    rows = len(next(iter(columns.values())))
    maps = []
    for row in range(rows):
        maps.append({name: column[row] for name, column in columns.items()})
    return maps


def _error_code(frame: Frame, error: VLAgentsError) -> str:
    """Return XPolicyLab's code for an error."""
    if frame.kind and frame.kind not in ANSWERS and frame.kind != CLOSE:
        return "unknown_message_type"
    if isinstance(error, DeadlineExceeded):
        return "timeout"
    if isinstance(error, MalformedMessage | MessageTooLarge):
        return "invalid_frame"
    return _FAILED.get(frame.kind, "internal")


def _hash(value: Any, update: Callable[[bytes | memoryview], None]) -> None:
    """Hash a value with its type, so that no two values are written alike."""
    if isinstance(value, dict):
        update(b"map %d " % len(value))
        for key, item in value.items():
            _hash(key, update)
            _hash(item, update)
    elif isinstance(value, list):
        update(b"list %d " % len(value))
        for item in value:
            _hash(item, update)
    elif isinstance(value, np.ndarray):
        update(f"array {value.dtype.str} {value.shape} ".encode())
        update(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    else:
        data = value if isinstance(value, bytes) else repr(value).encode(errors="replace")
        update(f"{type(value).__name__} {len(data)} ".encode())
        update(data)


def _node(node: dict[Any, Any]) -> Any:
    """Return the array in a map, or the map with its keys as text, since a key may be the index of
    an environment.
    """
    if is_packed(node):
        return read_packed(node)
    if any(type(key) is int for key in node):
        return {str(key) if type(key) is int else key: value for key, value in node.items()}
    return node


def _text(value: Any) -> str | None:
    """Return an id; None if the message has none."""
    if value is None:
        return None
    text = str(value) if type(value) is int else value
    if not isinstance(text, str) or len(text) > NAME_CHARACTERS:
        raise MalformedMessage(
            f"message: expected ids of at most {NAME_CHARACTERS} characters, got {shown(value)}"
        )
    return text


def _number(value: Any) -> int | None:
    """Return a number of the envelope; None if the message has none."""
    if value is None:
        return None
    if type(value) is not int or not -(2**63) <= value < 2**63:
        raise MalformedMessage(f"message: expected whole numbers, got {shown(value)}")
    return value


# Mappings of XPolicyLab's robots. Angles are in rad, grippers in [0, 1] with 1 open, and poses are
# position in m and quaternion, scalar first.

_STATE_PARTS = {"joints": "arm_joint_state", "gripper": "ee_joint_state", "ee_pose": "ee_pose"}


def _states() -> dict[str, Any]:
    """Return the states of robots with one arm and with two, all optional."""
    states = {}
    for arm, prefix in (("", ""), ("left/", "left_"), ("right/", "right_")):
        for ours, theirs in _STATE_PARTS.items():
            states[f"{arm}{ours}"] = {"key": f"state/{prefix}{theirs}", "optional": True}
    return states


def _two_arms(part: str, size: int) -> dict[str, Any]:
    """Return the actions of two arms with a gripper each.

    Args:
        part: XPolicyLab's name of the arm's action.
        size: The number of its values.
    """
    actions = {}
    for index, side in enumerate(("left", "right")):
        start = index * (size + 1)
        actions[f"{side}_{part}"] = {"start": start, "stop": start + size}
        actions[f"{side}_ee_joint_state"] = {"start": start + size, "stop": start + size + 1}
    return actions


_OBSERVATION: dict[str, Any] = {
    "cameras": {
        "front": "vision/cam_head/color",
        "left_wrist": {"key": "vision/cam_left_wrist/color", "optional": True},
        "right_wrist": {"key": "vision/cam_right_wrist/color", "optional": True},
        "wrist": {"key": "vision/cam_wrist/color", "optional": True},
        "third_view": {"key": "vision/cam_third_view/color", "optional": True},
    },
    "state": _states(),
    "instruction": "instruction",
}

PRESETS: dict[str, dict[str, Any]] = {
    # Two arms of six joints: ARX X5, which RoboDojo uses, and Piper.
    "xpolicylab": {
        **_OBSERVATION,
        "action": _two_arms("arm_joint_state", 6),
        "action_gripper": ALOHA_ACTION,
    },
    # Two arms, whose poses are commanded.
    "xpolicylab-ee": {
        **_OBSERVATION,
        "action": _two_arms("ee_pose", 7),
        "action_gripper": [{"index": 7}, {"index": 15}],
    },
}
