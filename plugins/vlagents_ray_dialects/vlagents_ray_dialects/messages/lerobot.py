"""The pickled messages of LeRobot's asynchronous inference: policy instructions, observations and
chunks of actions.

Sources: `async_inference/helpers.py` and `robot_client.py` of LeRobot 0.4.4, which are equivalent
in 0.6.1. A client pickles its data classes. Here they are read as data, see `pickles`, and the
chunk is written as a pickle that refers to the client's own `TimedAction` and `torch.tensor`.
"""

from __future__ import annotations

import enum
import math
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import (
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    MissingCamera,
    MissingState,
)
from vlagents_ray.protocol.frame_layout import Buffer
from vlagents_ray.protocol.messages import Budget, MessageLimits
from vlagents_ray.protocol.values import is_number
from vlagents_ray_dialects.messages.pickles import NUMPY_CALLS, Name, fields_of, read_pickle

HELPERS = "lerobot.async_inference.helpers"
# The module of the same classes before LeRobot 0.4.0, which a pickle names at its beginning.
_OLD_HELPERS, _HEAD_BYTES = b"lerobot.scripts.server.helpers", 128
SETUP, OBSERVATION = Name(HELPERS, "RemotePolicyConfig"), Name(HELPERS, "TimedObservation")
# The fields of the data classes that a client pickles.
_REQUESTS: Mapping[Name, Sequence[str]] = {
    SETUP: (
        "policy_type",
        "pretrained_name_or_path",
        "lerobot_features",
        "actions_per_chunk",
        "device",
        "rename_map",
    ),
    OBSERVATION: ("timestamp", "timestep", "observation", "must_go"),
}
_STEPS = 2**31  # upper limit of time steps, so that they fit into a pickle's plain integers
_SHOWN = 40  # maximum number of a client's keys in an error, and of characters of each key


@dataclass(frozen=True, slots=True)
class PolicyInstructions:
    """A client's settings of itself and of the policy, sent before its first observation."""

    policy_type: str
    checkpoint: str  # the checkpoint that LeRobot's own server would load
    state: tuple[str, ...]  # the names of the numbers of `observation.state`, in order
    cameras: tuple[str, ...]
    actions_per_chunk: int


@dataclass(frozen=True, slots=True)
class RobotObservation:
    """An observation with the robot's names."""

    timestamp: float  # the client's clock, s since 1970
    timestep: int  # the number of the last action that the client executed
    values: Mapping[str, Any]  # numbers, texts and arrays by the robot's names
    must_go: bool  # whether the client has no action left


def read_instructions(data: Buffer, limits: MessageLimits) -> PolicyInstructions:
    """Read policy instructions.

    Args:
        data: The pickle.
        limits: The limits of its size and content.

    Raises:
        InvalidObservation: The client has features that are not supported.
        MalformedMessage: The pickle is something else.
        MessageTooLarge: The pickle exceeds a limit.
    """
    fields = _pickled_fields(data, limits, SETUP)
    policy_type = _text(fields, "policy_type")
    checkpoint = _text(fields, "pretrained_name_or_path")
    rows = fields["actions_per_chunk"]
    features = fields["lerobot_features"]
    renames = fields["rename_map"]

    if type(rows) is not int or rows < 1:
        raise MalformedMessage(
            f"actions_per_chunk: expected an integer of 1 or more, got {_shown(rows)}"
        )
    if not (isinstance(features, dict) and isinstance(renames, dict)):
        raise MalformedMessage(
            f"lerobot_features, rename_map: expected dicts, got {_shown(features)}, "
            f"{_shown(renames)}"
        )
    if renames:
        raise InvalidObservation(
            "rename_map: expected no names, got some; rename them in dialects.lerobot.mapping"
        )

    state: tuple[str, ...] = ()
    for name, feature in features.items():
        if not isinstance(feature, dict):
            raise MalformedMessage(
                f"lerobot_features: {name[:_SHOWN]!r}: expected a dict, got {_shown(feature)}"
            )
        dtype = _text(feature, "dtype")
        if name == STATE and dtype == "float32":
            state = _names(feature)
        elif not (name.startswith(IMAGES) and dtype in ("image", "video")):
            raise InvalidObservation(
                f"lerobot_features: expected {STATE!r} of float32, and images "
                f"{IMAGES + 'NAME'!r}, got {name[:_SHOWN]!r} of {dtype[:_SHOWN]!r}"
            )

    cameras = tuple(name.removeprefix(IMAGES) for name in features if name != STATE)
    if len(cameras) > limits.cameras or len(state) > limits.state_values:
        raise MessageTooLarge(
            f"lerobot_features: expected at most {limits.cameras} cameras and "
            f"{limits.state_values} numbers of state, got {len(cameras)} and {len(state)}"
        )
    return PolicyInstructions(policy_type, checkpoint, state, cameras, rows)


def read_observation(data: Buffer, budget: Budget) -> RobotObservation:
    """Read an observation.

    Args:
        data: The pickle. Arrays of the result are views of its memory.
        budget: Counts the sizes of the arrays.

    Raises:
        MalformedMessage: The pickle is something else.
        MessageTooLarge: The pickle exceeds a limit.
    """
    fields = _pickled_fields(data, budget.limits, OBSERVATION)
    timestamp, timestep, values, must_go = (fields[name] for name in _REQUESTS[OBSERVATION])

    if not is_number(timestamp) or not math.isfinite(timestamp):
        raise MalformedMessage(f"timestamp: expected a finite number, got {_shown(timestamp)}")
    if type(timestep) is not int or not 0 <= timestep < _STEPS:
        raise MalformedMessage(
            f"timestep: expected an integer in [0, 2**31), got {_shown(timestep)}"
        )
    if type(must_go) is not bool:
        raise MalformedMessage(f"must_go: expected a bool, got {_shown(must_go)}")
    if not isinstance(values, dict):
        raise MalformedMessage(f"observation: expected a dict, got {_shown(values)}")

    for name, value in values.items():
        if isinstance(value, np.ndarray):
            budget.count(value.nbytes)
        elif not (isinstance(value, (str, bool)) or is_number(value)):
            raise MalformedMessage(
                f"observation: {name[:_SHOWN]!r}: expected a number, text or numpy array, got "
                f"{_shown(value)}"
            )
    return RobotObservation(float(timestamp), timestep, values, must_go)


def frame(observation: RobotObservation, robot: PolicyInstructions) -> dict[str, Any]:
    """Convert an observation to the names of LeRobot's datasets, as LeRobot's own server does
    before it calls a policy.

    Args:
        observation: The observation.
        robot: The policy instructions of its client.

    Returns:
        `observation.state`, (D,) float32, in the order of the robot's features,
        `observation.images.NAME`, and `task`.

    Raises:
        MissingState: The observation lacks a number of the robot's features.
        MissingCamera: The observation lacks an image of the robot's features.
        InvalidObservation: A value of the state is not a number.
    """
    values = observation.values
    have = [name[:_SHOWN] for name in values][:_SHOWN]
    frame_values: dict[str, Any] = {}

    if robot.state:
        numbers = []
        for name in robot.state:
            if name not in values:
                raise MissingState(name[:_SHOWN], have=have)
            value = values[name]
            if isinstance(value, np.ndarray) and value.size == 1:
                value = value.item()
            if not is_number(value):
                raise InvalidObservation(
                    f"{name[:_SHOWN]!r}: expected a number, got {_shown(value)}"
                )
            numbers.append(value)
        # Numbers that are too large become infinite, as in LeRobot.
        with np.errstate(over="ignore"):
            frame_values[STATE] = np.array(numbers, np.float64).astype(np.float32)

    for name in robot.cameras:
        if name not in values:
            raise MissingCamera(name[:_SHOWN], have=have)
        frame_values[IMAGES + name] = values[name]

    if TASK in values:
        frame_values[TASK] = values[TASK]
    return frame_values


def write_chunk(rows: np.ndarray, timestamp: float, timestep: int, period_s: float) -> bytes:
    """Return the pickle of a chunk: a list of `TimedAction`, which the client unpickles.

    The pickle has the form of LeRobot's own, except that each tensor is a call of `torch.tensor`
    with its float32 numbers. So this process needs no torch, and the pickle contains no archive.

    Args:
        rows: The chunk, (H, D) float32.
        timestamp: The time of the observation and of the first action, s.
        timestep: The number of the observation and of the first action.
        period_s: The time between two actions, s.

    Raises:
        InvalidObservation: The numbers of the actions would be too large.
    """
    if timestep + len(rows) > _STEPS:
        raise InvalidObservation(
            f"timestep: expected a number that leaves room for {len(rows)} actions, got {timestep}"
        )

    opcodes = [
        b"\x80\x02",
        _global(0, HELPERS, "TimedAction"),
        _global(1, "torch", "tensor"),
        b"](",
    ]
    for number, row in enumerate(rows):
        values = b"".join(b"G" + struct.pack(">d", value) for value in row.tolist())
        opcodes += [
            b"h\0)\x81}(",
            _text_opcodes("timestamp"), b"G", struct.pack(">d", timestamp + number * period_s),
            _text_opcodes("timestep"), b"J", struct.pack("<i", timestep + number),
            _text_opcodes("action"), b"h\1](", values, b"e\x85R",
            b"ub",
        ]  # fmt: skip
    return b"".join([*opcodes, b"e."])


def _text_opcodes(value: str) -> bytes:
    """Return the opcodes that push a text."""
    data = value.encode()
    return b"X" + struct.pack("<I", len(data)) + data


def _global(memo: int, module: str, name: str) -> bytes:
    """Return the opcodes that store a class or function in the memo."""
    return f"c{module}\n{name}\n".encode() + bytes([ord("q"), memo, ord("0")])


def _pickled_fields(data: Buffer, limits: MessageLimits, class_name: Name) -> dict[str, Any]:
    """Return the fields of the object of a data class in a pickle."""
    if _OLD_HELPERS in bytes(memoryview(data)[:_HEAD_BYTES]):
        raise MalformedMessage(
            "LeRobot: expected a client of version 0.4.0 or newer, got an older one; update it at "
            "the robot"
        )
    return fields_of(read_pickle(data, limits, _REQUESTS, NUMPY_CALLS), class_name)


def _text(fields: Mapping[str, Any], name: str) -> str:
    """Return the text in a field."""
    value = fields.get(name)
    if not isinstance(value, str):
        raise MalformedMessage(f"{name}: expected text, got {_shown(value)}")
    return value


def _shown(value: object) -> str:
    """Return a client's value for an error: a number itself, the type of any other value."""
    return repr(value) if is_number(value) else type(value).__name__


def _names(feature: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names of the numbers of a feature."""
    names = feature.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InvalidObservation(
            f"lerobot_features: {STATE!r}: expected `names`, a list of texts, got {_shown(names)}"
        )
    return tuple(names)


# The protobuf messages of LeRobot's `AsyncInference` service, which are read and written without
# protobuf's library.
#
# Source: `transport/services.proto` of LeRobot 0.4.4 and 0.6.1. `Observation` has the field 1,
# `transfer_state`, and the field 2, `data`; `PolicySetup` and `Actions` have the field 1, `data`;
# `Empty` has no field.

SERVICE = "transport.AsyncInference"
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5  # types of fields
_VARINT_BYTES = 10  # largest length of a number, bytes


class TransferState(enum.IntEnum):
    """The position of a piece in an observation that is sent in several pieces."""

    BEGIN = 1
    MIDDLE = 2
    END = 3


def read_observation_part(message: bytes) -> tuple[TransferState, memoryview]:
    """Read an `Observation`.

    Args:
        message: The message.

    Returns:
        The position of this piece, and the piece of a pickle.

    Raises:
        MalformedMessage: The message is something else.
    """
    number = 0
    data = memoryview(b"")
    for field, value in _protobuf_fields(message):
        if field == 1 and isinstance(value, int):
            number = value
        elif field == 2 and isinstance(value, memoryview):
            data = value
    try:
        return TransferState(number), data
    except ValueError as error:
        raise MalformedMessage(
            f"observation: expected transfer state 1, 2 or 3, got {number}"
        ) from error


def read_data(message: bytes) -> memoryview | None:
    """Return the pickle in a `PolicySetup` or an `Actions`; None if it has none."""
    for field, value in _protobuf_fields(message):
        if field == 1 and isinstance(value, memoryview):
            return value
    return None


def write_data(data: bytes) -> bytes:
    """Return a `PolicySetup` or an `Actions` with a pickle."""
    varint = bytearray()
    remaining = len(data)
    while remaining > 0x7F:
        varint.append(remaining & 0x7F | 0x80)
        remaining >>= 7
    return bytes([1 << 3 | _BYTES, *varint, remaining]) + data


EMPTY = b""  # an `Empty`, and an `Actions` without a pickle


def _protobuf_fields(message: bytes) -> Iterator[tuple[int, int | memoryview]]:
    """Yield the field number and the value of each integer or bytes field; skip other fields."""
    view = memoryview(message)
    offset = 0
    while offset < len(view):
        key, offset = _varint(view, offset)
        field, field_type = key >> 3, key & 7
        if field_type == _VARINT:
            number, offset = _varint(view, offset)
            yield field, number
            continue

        length = {_FIXED64: 8, _FIXED32: 4}.get(field_type)
        if field_type == _BYTES:
            length, offset = _varint(view, offset)
        if length is None or offset + length > len(view):
            raise MalformedMessage("protobuf: a field of an unknown type, or that ends too early")
        if field_type == _BYTES:
            yield field, view[offset : offset + length]
        offset += length


def _varint(view: memoryview, offset: int) -> tuple[int, int]:
    """Return the number that begins at an offset, and the offset of the byte after it."""
    number = 0
    for index, byte in enumerate(view[offset : offset + _VARINT_BYTES]):
        number |= (byte & 0x7F) << (7 * index)
        if byte < 0x80:
            return number, offset + index + 1
    raise MalformedMessage("protobuf: a number that ends too early")


# The mapping of LeRobot's robots. It reads the names of LeRobot's datasets, to which LeRobot's own
# server also converts the names of a robot.

STATE, IMAGES, TASK = "observation.state", "observation.images.", "task"

PRESETS: dict[str, dict[str, Any]] = {
    "lerobot": {
        "cameras": {"*": f"{IMAGES}*"},
        "state": {"joints": {"key": STATE, "optional": True}},
        "instruction": TASK,
    }
}
