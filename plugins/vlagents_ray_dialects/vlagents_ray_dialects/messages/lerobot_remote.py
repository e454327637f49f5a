"""The messages of LeRobot's remote inference: msgpack maps with an envelope, in which arrays and
images are records.

LeRobot's modules `remote_inference/{protocol,codec,chunk_contract}.py` (commits 0c72316c, 91f903c8)
define the format. A message has the ids of an instance, a session, a generation and a request,
which its reply repeats; a client discards a reply to any other request.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np

from vlagents_ray.errors import (
    DeadlineExceeded,
    InvalidObservation,
    MalformedMessage,
    Overloaded,
    TooManyRequests,
    VLAgentsError,
    shown,
)
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, MessageLimits
from vlagents_ray_dialects.messages.msgpack import pack, unpack

PROTOCOL_VERSION = 1
MessageType = Literal[
    "describe",
    "descriptor",
    "open",
    "accepted",
    "control",
    "ack",
    "observation",
    "action",
    "language_request",
    "language_result",
    "error",
]
# Types of messages that belong to a session, and therefore need all ids.
_OF_A_SESSION = ("control", "ack", "observation", "action", "language_request", "language_result")
# The values of an observation that its action repeats.
IDENTITY = ("artifact_identity", "observation_id", "capture_time", "task", "task_version")
# The optional ways in which a robot merges chunks: aligned by the observations to which the chunks
# belong (two versions), and with blended rows.
MERGES = ("chunk_alignment_v1", "chunk_alignment_v2", "chunk_blending_v1")

_ENVELOPE = (
    "version",
    "message_type",
    "instance_id",
    "session_id",
    "generation",
    "request_id",
    "body",
)
HEAD_BYTES, _INIT = 3, 0x01
_SEGMENT = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,127}\Z")
_RECORD = "__lerobot_type__"
_INTEGERS = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64")
_DTYPES = frozenset(["bool", *_INTEGERS, "float16", "float32", "float64"])
# Maximum number of characters of an error's text, as in LeRobot's own server.
_ERROR_CHARACTERS = 2048


@dataclass(frozen=True, slots=True)
class Envelope:
    """One message, in either direction."""

    message_type: MessageType
    instance_id: str = ""
    session_id: str = ""
    generation: int = 0
    request_id: str = ""
    body: Mapping[str, Any] = field(default_factory=dict)

    def reply(self, message_type: MessageType, body: Mapping[str, Any]) -> Envelope:
        """Return the reply to this message, with its ids."""
        return replace(self, message_type=message_type, body=body)


class _JpegImage(bytes):
    """A JPEG image in a message, which is not decoded yet."""

    shape: tuple[int, ...]  # the shape that the message declares


def is_segment(text: object) -> bool:
    """Return whether a value may be part of a Zenoh key, as the name of a deployment or an id."""
    return isinstance(text, str) and _SEGMENT.match(text) is not None


def equals(value: object, expected: object) -> bool:
    """Return whether a value of a client equals a plain value, also if the client sends an array in
    its place.
    """
    if isinstance(expected, dict):
        return (
            isinstance(value, dict)
            and value.keys() == expected.keys()
            and all(equals(value[name], item) for name, item in expected.items())
        )
    if isinstance(expected, list):
        return (
            isinstance(value, list)
            and len(value) == len(expected)
            and all(map(equals, value, expected))
        )
    return type(value) is type(expected) and value == expected


def check_head(head: bytes) -> None:
    """Raise `MalformedMessage` unless a connection begins with `HEAD_BYTES` bytes of Zenoh's
    protocol: the size of a batch, and the header of the first message of a handshake.
    """
    if head[2] & 0x3F != _INIT:
        raise MalformedMessage(
            "expected the handshake of Zenoh, got other bytes; use LeRobot's remote inference"
        )


def decode(data: bytes, limits: MessageLimits = DEFAULT_LIMITS) -> Envelope:
    """Decode a message.

    Args:
        data: The message.
        limits: The limits of its size and content.

    Returns:
        The message. Its JPEG images are still encoded, see `decode_images`.

    Raises:
        MalformedMessage: The message is invalid.
        MessageTooLarge: The message exceeds a limit.
    """
    raw = unpack(data, limits, _record)
    if not isinstance(raw, dict) or not raw.keys() >= set(_ENVELOPE):
        raise MalformedMessage(f"message: expected a map with {list(_ENVELOPE)}, got {shown(raw)}")
    if not equals(raw["version"], PROTOCOL_VERSION):
        raise MalformedMessage(
            f"version: expected {PROTOCOL_VERSION}, got {shown(raw['version'], 20)}"
        )

    kind = raw["message_type"]
    if not isinstance(kind, str) or kind not in get_args(MessageType):
        raise MalformedMessage(
            f"message_type: expected one of {list(get_args(MessageType))}, got {shown(kind)}"
        )
    generation = raw["generation"]
    if type(generation) is not int or not 0 <= generation < 2**63:
        raise MalformedMessage(f"generation: expected a whole number, got {shown(generation)}")
    for name in ("instance_id", "session_id", "request_id"):
        is_needed = kind in _OF_A_SESSION
        if not is_segment(raw[name]) and (is_needed or not equals(raw[name], "")):
            raise MalformedMessage(
                f"{name}: expected 1 to 128 letters, digits, '_', '.' and '-', got "
                f"{shown(raw[name])}"
            )
    if not isinstance(raw["body"], dict):
        raise MalformedMessage(f"body: expected a map, got {type(raw['body']).__name__}")
    return Envelope(
        kind,  # type: ignore[arg-type]  # it was checked above
        raw["instance_id"],
        raw["session_id"],
        generation,
        raw["request_id"],
        raw["body"],
    )


def decode_images(values: Mapping[str, Any], budget: Budget) -> dict[str, Any]:
    """Decode the JPEG images among the features of an observation.

    Args:
        values: The features by name.
        budget: Counts the decoded images; raises an error beyond its limits.

    Returns:
        The features by name; images are (H, W, 3) uint8 RGB.

    Raises:
        MalformedMessage: An image cannot be decoded, or its size differs from the declared shape.
        MessageTooLarge: The images exceed a limit.
    """
    names = [name for name, value in values.items() if isinstance(value, _JpegImage)]
    images = decode_files([values[name] for name in names], budget, names)
    decoded = dict(values)
    for name, image in zip(names, images, strict=True):
        if image.shape != values[name].shape:
            raise MalformedMessage(
                f"{name}: expected the shape {values[name].shape} that the record declares, got "
                f"{image.shape}"
            )
        decoded[name] = image
    return decoded


def encode(envelope: Envelope) -> bytes:
    """Encode a message; its arrays are numpy arrays."""
    fields = {
        "version": PROTOCOL_VERSION,
        "message_type": envelope.message_type,
        "instance_id": envelope.instance_id,
        "session_id": envelope.session_id,
        "generation": envelope.generation,
        "request_id": envelope.request_id,
        "body": envelope.body,
    }
    return pack(fields, _plain)


def error_body(error: VLAgentsError) -> dict[str, Any]:
    """Return the body of the message with an error, whose code is one of LeRobot's."""
    code = "execution"
    if isinstance(error, (StaleMessage, IncompatibleRequest, UnsupportedRequest)):
        code = error.code
    elif isinstance(error, (TooManyRequests, Overloaded)):
        code = "busy"
    elif isinstance(error, DeadlineExceeded):
        code = "timeout"
    elif isinstance(error, InvalidObservation):
        code = "incompatible"
    elif error.status < 500:
        code = "malformed"
    return {"code": code, "message": str(error)[:_ERROR_CHARACTERS]}


class StaleMessage(MalformedMessage):
    """The message belongs to an instance, a session or a generation that has ended."""

    code = "stale"


class IncompatibleRequest(MalformedMessage):
    """The client's robot, or its observation, does not match the features of this deployment."""

    code = "incompatible"


class UnsupportedRequest(MalformedMessage):
    """The client requests something that this deployment does not offer."""

    code = "unsupported"


def _record(node: dict[Any, Any]) -> Any:
    """Return the array or the image in a map, or the map itself."""
    if any(not isinstance(key, str) for key in node):
        raise MalformedMessage("map: expected texts as keys")
    if _RECORD not in node:
        return node

    kind, data = node[_RECORD], node.get("data")
    shape = node.get("shape")
    if not isinstance(data, bytes):
        raise MalformedMessage(f"record: expected bytes as its data, got {shown(data)}")
    if (
        not isinstance(shape, list)
        or len(shape) > 8
        or not all(type(length) is int and length > 0 for length in shape)
    ):
        raise MalformedMessage(f"record: expected a shape of positive integers, got {shown(shape)}")
    if kind == "tensor":
        return _tensor(node, data, shape)
    if kind != "rgb" or node.get("dtype") != "uint8" or node.get("channel_order") != "RGB":
        raise MalformedMessage(
            f"record: expected a tensor, or an image of uint8 in the order RGB, got {shown(kind)}"
        )
    if len(shape) != 3 or shape[2] != 3:
        raise MalformedMessage(f"image: expected a shape (H, W, 3), got {shown(shape)}")
    if node.get("encoding") == "jpeg":
        image = _JpegImage(data)
        image.shape = tuple(shape)
        return image
    if node.get("encoding") != "raw":
        raise MalformedMessage(
            f"image: expected the encoding raw or jpeg, got {shown(node.get('encoding'), 20)}"
        )
    return _array(np.dtype(np.uint8), data, shape)


def _tensor(node: Mapping[str, Any], data: bytes, shape: list[int]) -> np.ndarray:
    """Return the array in a record."""
    name, order = node.get("dtype"), node.get("endianness")
    if not isinstance(name, str) or name not in _DTYPES or order not in ("little", "big"):
        raise MalformedMessage(
            f"tensor: expected a dtype such as float32 with its endianness, got {shown(name)} "
            f"{shown(order)}"
        )
    array = _array(np.dtype(name).newbyteorder("<" if order == "little" else ">"), data, shape)
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise MalformedMessage("tensor: expected finite numbers, got NaN or infinity")
    return array


def _array(dtype: np.dtype[Any], data: bytes, shape: list[int]) -> np.ndarray:
    """Return an array over `data`."""
    size = dtype.itemsize
    for length in shape:
        size *= length
    if size != len(data):
        raise MalformedMessage(
            f"record: expected {size} bytes for {dtype} of {shown(shape)}, got {len(data)}"
        )
    return np.frombuffer(data, dtype).reshape(shape)


def _plain(value: Any) -> Any:
    """Return the record of an array, for msgpack."""
    if isinstance(value, np.ndarray) and value.dtype.name in _DTYPES:
        array = np.ascontiguousarray(value, value.dtype.newbyteorder("<"))
        return {
            _RECORD: "tensor",
            "dtype": array.dtype.name,
            "shape": list(array.shape),
            "endianness": "little",
            "data": array.tobytes(),
        }
    raise TypeError(f"cannot send {type(value).__name__}")
