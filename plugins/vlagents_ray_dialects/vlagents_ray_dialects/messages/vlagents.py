"""Observations and actions in the format of the package `vlagents`, versions 0.2 and 0.3: JSON with
arrays.

In 0.3 an observation contains named robots and the instruction; 0.2 has one unnamed robot, and the
instruction in its `reset`. A camera is an array, a JPEG file in base64, or the name of a
shared-memory segment of the client.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeGuard

import numpy as np

from vlagents_ray.errors import (
    InvalidAction,
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    shown,
)
from vlagents_ray.images.codecs import decode_files
from vlagents_ray.interface import GOAL_IMAGE, Act, Obs
from vlagents_ray.protocol.frame_layout import read_array
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Budget, MessageLimits
from vlagents_ray.protocol.values import is_number
from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects.messages import rpyc

RAW, JPEG, SHARED = "raw", "jpeg_encoded", "shared_memory"  # formats of a camera
_TOP_3 = {"obs", "language_instruction", "goal_image", "goal_image_data_type"}
_ROBOT_3 = {"cameras", "camera_data_type", "gripper", "joints", "xyzrpy", "tquat", "info"}
_ROBOT_2 = {"cameras", "camera_data_type", "gripper", "state", "info"}
_LEVELS = 4  # levels of nesting above the values in `info`: message, robots, robot, info
_STATE_NAMES = ("joints", "xyzrpy", "tquat", "state")
# Arguments of `reset` that are not options.
_NO_OPTIONS = {"self", "obs", "instruction", "contract"}


class Segments(Protocol):
    """Reads a client's shared memory."""

    def read(self, name: str, size: int) -> bytearray:
        """Return a copy of the first bytes of a segment.

        Args:
            name: The name of the segment.
            size: The number of bytes.

        Raises:
            InvalidObservation: The segment cannot be read.
        """


@dataclass(frozen=True, slots=True)
class RobotColumns:
    """The columns of one robot in a row of actions, with indices as in Python: -1 is the last
    column.
    """

    start: int | None = None
    stop: int | None = None
    # The column that becomes `SingleAct.gripper` instead of a number of `action`.
    gripper: int | None = None
    gripper_open: float = 1.0  # the value of an open gripper, which vlagents writes as 1
    gripper_closed: float = 0.0  # the value of a closed gripper, which vlagents writes as 0

    def split(self, row: np.ndarray) -> tuple[np.ndarray, float | None]:
        """Split a row of the policy's actions.

        Args:
            row: The row, (D,) float32.

        Returns:
            The action of the robot, (d,), and its gripper in [0, 1] with 1 = open, or None.

        Raises:
            InvalidAction: The row has no such columns.
        """
        columns = np.arange(len(row))[self.start : self.stop]
        if not len(columns):
            raise InvalidAction(
                f"vlagents: columns {self.start}:{self.stop} of a row of {len(row)} are none"
            )
        if self.gripper is None:
            return row[columns], None
        if not -len(row) <= self.gripper < len(row):
            raise InvalidAction(
                f"vlagents: no column {self.gripper} for the gripper in a row of {len(row)}"
            )

        width = self.gripper_open - self.gripper_closed
        opening = (float(row[self.gripper]) - self.gripper_closed) / width
        action_columns = columns[columns != self.gripper % len(row)]
        return row[action_columns], min(1.0, max(0.0, opening))


@dataclass(frozen=True, slots=True)
class ObservationRequest:
    """The observation in a client's call."""

    obs: Obs
    instruction: str | None
    # The robots' names in order; empty for vlagents 0.2, which has no names.
    robots: tuple[str, ...]


def read_act(text: str | bytes, budget: Budget, segments: Segments) -> ObservationRequest:
    """Read the argument of the method `act`, and count it as a request.

    Args:
        text: The argument, JSON.
        budget: Counts the requests and the images.
        segments: Reads the shared memory of the client.
    """
    budget.begin("act")
    return _read(json_numpy.loads(text, budget.limits, _LEVELS), budget, segments)


def read_reset(
    text: str | bytes, budget: Budget, segments: Segments
) -> tuple[ObservationRequest, dict[str, Any]]:
    """Read the argument of the method `reset` of vlagents 0.2, and count it as a request.

    Args:
        text: The argument, JSON.
        budget: Counts the requests and the images.
        segments: Reads the shared memory of the client.

    Returns:
        The observation and the options.
    """
    budget.begin("reset")
    document = json_numpy.loads(text, budget.limits, _LEVELS)
    if not (isinstance(document, list) and len(document) == 3):
        raise MalformedMessage(
            f"reset: expected [observation, instruction, options], got {shown(document)}"
        )

    request = _read(document[0], budget, segments)
    kwargs = _mapping(document[2], "reset: options")
    no_options = kwargs.keys() & _NO_OPTIONS
    if no_options:
        raise MalformedMessage(
            f"reset: expected options of the policy, got {sorted(no_options)}, which the server "
            "sets"
        )

    instruction = _instruction(document[1], budget.limits)
    return ObservationRequest(request.obs, instruction, request.robots), kwargs


def write_act(
    act: Act, robots: Sequence[str], columns: Mapping[str, RobotColumns] | None = None
) -> str:
    """Return the result of the method `act`.

    Args:
        act: The policy's action.
        robots: The names of the robots in the request; empty for vlagents 0.2.
        columns: The columns of each robot in a row; by default, each robot has the whole row.
    """
    if not robots:
        return json_numpy.dumps({"action": act.action, "done": act.done, "info": act.info})

    rows = act.rows()
    columns_by_robot = columns or dict.fromkeys(robots, RobotColumns())
    steps = []
    for number, row in enumerate(rows):
        step = {}
        for robot, robot_columns in columns_by_robot.items():
            action, gripper = robot_columns.split(row)
            step[robot] = {
                "action": action,
                "gripper": gripper,
                "done": act.done and number == len(rows) - 1,
                "info": act.info if number == 0 else {},
            }
        steps.append(step)
    return json_numpy.dumps({"acts": steps})


def _read(document: Any, budget: Budget, segments: Segments) -> ObservationRequest:
    """Return the observation in a decoded document of either version."""
    limits = budget.limits
    top = _mapping(document, "observation")
    if "obs" not in top:
        _require_known(top, _ROBOT_2, "observation")
        return ObservationRequest(_robot(top, "", budget, segments), None, ())

    _require_known(top, _TOP_3, "observation")
    robots = _mapping(top["obs"], "observation.obs")
    if not robots:
        raise InvalidObservation("observation.obs: expected one robot or more, got none")
    if len(robots) > limits.cameras:
        raise MessageTooLarge(
            f"observation.obs: expected at most {limits.cameras} robots, got {len(robots)}"
        )

    # The cameras of all robots are counted before the first image is decoded.
    views = [robot.get("cameras") for robot in robots.values() if isinstance(robot, dict)]
    cameras = sum(len(view) for view in views if isinstance(view, dict))
    if cameras > limits.cameras:
        raise MessageTooLarge(f"cameras: expected at most {limits.cameras}, got {cameras}")

    obs = Obs()
    for name, fields in robots.items():
        robot = _mapping(fields, f"observation.obs[{name[:40]!r}]")
        _require_known(robot, _ROBOT_3, f"observation.obs[{name[:40]!r}]")
        prefix = "" if len(robots) == 1 else f"{name}/"
        robot_obs = _robot(robot, prefix, budget, segments)
        obs.cameras |= robot_obs.cameras
        obs.state |= robot_obs.state
        obs.info |= robot_obs.info
        obs.gripper = robot_obs.gripper

    goal = top.get("goal_image")
    if goal is not None:
        image_format = top.get("goal_image_data_type", RAW)
        obs.info[GOAL_IMAGE] = _image(goal, image_format, GOAL_IMAGE, budget, segments)

    instruction = _instruction(top.get("language_instruction"), limits)
    return ObservationRequest(obs, instruction, tuple(robots))


def _robot(robot: Mapping[str, Any], prefix: str, budget: Budget, segments: Segments) -> Obs:
    """Return the observation of one robot.

    Args:
        robot: The decoded observation.
        prefix: Added to all names; with a prefix, the gripper becomes a part of the state, (1,).
        budget: Counts the images.
        segments: Reads the shared memory of the client.
    """
    limits = budget.limits
    cameras = _mapping(robot.get("cameras") or {}, "cameras")
    if len(cameras) > limits.cameras:
        raise MessageTooLarge(f"cameras: expected at most {limits.cameras}, got {len(cameras)}")

    image_format = robot.get("camera_data_type", RAW)
    obs = Obs()
    for name, image in cameras.items():
        obs.cameras[prefix + name] = _image(image, image_format, name, budget, segments)
    for name, value in _mapping(robot.get("info") or {}, "info").items():
        obs.info[prefix + name] = value
    for name in _STATE_NAMES:
        vector = robot.get(name)
        if vector is not None:
            obs.state[prefix + name] = _vector(vector, name, limits)

    gripper = robot.get("gripper")
    if gripper is not None:
        if isinstance(gripper, np.ndarray) and gripper.size == 1:
            gripper = gripper.item()
        if not is_number(gripper):
            raise InvalidObservation(
                f"gripper: expected a number in [0, 1] where 1 = open, got {shown(gripper)}"
            )
        if prefix:
            obs.state[f"{prefix}gripper"] = np.array([gripper], np.float32)
        else:
            obs.gripper = float(gripper)
    return obs


def _vector(value: Any, name: str, limits: MessageLimits) -> np.ndarray:
    """Return a part of the state, a list or an array of numbers, as (D,) float32."""
    if isinstance(value, list) and all(map(is_number, value)):
        value = np.asarray(value, np.float32)
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise InvalidObservation(f"{name}: expected (D,) float32, got {type(value).__name__}")
    if value.size > limits.state_values:
        raise MessageTooLarge(
            f"{name}: expected at most {limits.state_values} values, got {value.size}"
        )
    return value.astype(np.float32).reshape(-1)


def _image(
    image: Any, image_format: Any, name: str, budget: Budget, segments: Segments
) -> np.ndarray:
    """Return the image of a camera, (H, W, 3) uint8; the last frame if there are several, (N, H, W,
    3).
    """
    limits = budget.limits
    if image_format == JPEG:
        file = json_numpy.decode_base64(image, f"camera {name[:40]!r}")
        [frame] = decode_files([file], budget, [name])
    elif image_format == SHARED:
        frame = _shared(_mapping(image, f"camera {name[:40]!r}"), budget, segments)
    elif image_format == RAW:
        if not isinstance(image, np.ndarray):
            raise InvalidObservation(
                f"camera {name[:40]!r}: expected an array, got {type(image).__name__}"
            )
        frame = image
    else:
        raise MalformedMessage(
            f"camera_data_type: expected {RAW!r}, {JPEG!r} or {SHARED!r}, got {shown(image_format)}"
        )

    if frame.ndim == 4 and len(frame) == 1:
        frame = frame[0]
    if frame.ndim == 4:
        raise InvalidObservation(
            f"camera {name[:40]!r}: expected one frame, got {len(frame)}; send the newest one"
        )
    if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
        raise InvalidObservation(
            f"camera {name[:40]!r}: expected (H, W, 3) uint8 RGB, got {frame.shape} {frame.dtype}"
        )
    if frame.shape[0] * frame.shape[1] > limits.pixels:
        raise MessageTooLarge(
            f"camera {name[:40]!r}: expected at most {limits.pixels} pixels, got {frame.shape[:2]}"
        )
    return frame


def _shared(payload: Mapping[str, Any], budget: Budget, segments: Segments) -> np.ndarray:
    """Return a copy of an image in the client's shared memory."""
    _require_known(payload, {"shm_name", "shape", "dtype"}, "shared memory")
    name, shape = payload.get("shm_name"), payload.get("shape")
    if not isinstance(name, str) or payload.get("dtype", "uint8") != "uint8":
        raise MalformedMessage(
            f"shared memory: expected a name, and pixels of uint8, got {shown(payload)}"
        )
    if not _is_shape(shape):
        raise MalformedMessage(f"shared memory: expected the shape (H, W, 3), got {shown(shape)}")

    size = math.prod(shape)
    if size > budget.limits.body_bytes:
        raise MessageTooLarge(
            f"shared memory: expected at most {budget.limits.body_bytes} bytes, got {size}"
        )
    budget.hold(size)
    return read_array(memoryview(segments.read(name, size)), "|u1", shape)


def _is_shape(value: object) -> TypeGuard[list[int]]:
    """Return whether a value is a list of one to four sizes."""
    if not isinstance(value, list) or not 0 < len(value) <= 4:
        return False
    return all(type(size) is int and size > 0 for size in value)


def _instruction(value: Any, limits: MessageLimits) -> str | None:
    """Return an instruction, which may be missing."""
    if value is not None and not isinstance(value, str):
        raise MalformedMessage(f"instruction: expected text, got {type(value).__name__}")
    if value is not None and len(value) > limits.text:
        raise MessageTooLarge(
            f"instruction: expected at most {limits.text} characters, got {len(value)}"
        )
    return value


def _mapping(value: Any, path: str) -> dict[str, Any]:
    """Return a JSON object; raise `MalformedMessage` for anything else."""
    if not isinstance(value, dict):
        raise MalformedMessage(f"{path}: expected an object, got {type(value).__name__}")
    return value


def _require_known(value: Mapping[str, Any], known_keys: set[str], path: str) -> None:
    """Raise `MalformedMessage` if an object has keys that are not known."""
    unknown = value.keys() - known_keys
    if unknown:
        raise MalformedMessage(
            f"{path}: expected only the keys {sorted(known_keys)}, got {shown(sorted(unknown))}"
        )


# The client's side of the package `vlagents`, 0.3: calls of a server's methods over RPyC, and their
# results. The server sends a reference to its root once; a call consists of this reference and the
# name of a method. This process offers no object to the server; the server returns text, a truth
# value, or an error.

_ACTION_LEVELS = 4  # levels of nesting above an action: reply, acts, step, robot
_ERROR = 2000  # maximum number of characters of an error that are kept


@dataclass(frozen=True, slots=True)
class RemoteError:
    """An error that the server's method raised."""

    text: str


def get_root(sequence: int) -> bytes:
    """Return the frame that requests the server's root."""
    return rpyc.request(sequence, rpyc.Handler.GETROOT, (rpyc.VALUE, ()))


def call(sequence: int, root: tuple[Any, ...], method: str, *args: str) -> bytes:
    """Return the frame that calls a method of the server's root with text arguments."""
    boxes = [(rpyc.LOCAL, root), *((rpyc.VALUE, value) for value in (method, args, ()))]
    return rpyc.request(sequence, rpyc.Handler.CALLATTR, (rpyc.TUPLE, tuple(boxes)))


def read_result(body: bytes | bytearray, compressed: bool, limit: int) -> tuple[int, Any] | None:
    """Read a reply.

    Args:
        body: The body of a frame, after the header.
        compressed: Whether the message is compressed.
        limit: Largest size of the message after decompression, bytes.

    Returns:
        The sequence number of the request, and the value or a `RemoteError`; None if the message is
        not a reply.
    """
    message = rpyc.read_reply(body, compressed, limit)
    if message is None:
        return None

    sequence, ok, content = message
    if not ok:
        text = content[:_ERROR] if isinstance(content, str) else shown(content, _ERROR)
        return sequence, RemoteError(text)
    if not (isinstance(content, tuple) and len(content) == 2):
        raise MalformedMessage(f"rpyc: expected (label, value), got {shown(content)}")
    return sequence, content[1]


def write_observation(observation: Mapping[str, Any]) -> str:
    """Return the argument of the method `act`.

    Args:
        observation: The instruction, and the cameras, state and gripper, (1,), of each robot.
    """
    robots = {}
    for name, robot in observation.items():
        if not isinstance(robot, Mapping):
            continue

        gripper = robot.get("gripper")
        robots[name] = {
            "cameras": dict(robot.get("cameras", {})),
            "camera_data_type": "raw",
            "gripper": float(gripper[0]) if isinstance(gripper, np.ndarray) else gripper,
            "joints": robot.get("joints"),
            "xyzrpy": robot.get("xyzrpy"),
            "tquat": robot.get("tquat"),
            "info": dict(robot.get("info", {})),
        }
    document = {
        "obs": robots,
        "language_instruction": observation.get("language_instruction"),
        "goal_image": None,
        "goal_image_data_type": "raw",
    }
    return json_numpy.dumps(document)


def read_actions(text: str, limits: MessageLimits = DEFAULT_LIMITS) -> dict[str, np.ndarray]:
    """Read the result of the method `act`.

    Args:
        text: The result, JSON.
        limits: The limits of its size and content.

    Returns:
        The actions of each robot, (H, D); the last column is the gripper, 1 = open, if there is
        one.

    Raises:
        MalformedMessage: The text is something else.
    """
    document = json_numpy.loads(text, limits, _ACTION_LEVELS)
    steps = document.get("acts") if isinstance(document, dict) else None
    if not _are_steps(steps):
        raise MalformedMessage(
            "vlagents: expected `acts`, a list of one step or more, with the robots of each, got "
            f"{shown(steps)}"
        )
    if any(step.keys() != steps[0].keys() for step in steps):
        raise MalformedMessage(
            "vlagents: expected the same robots in each step of `acts`, got others than "
            f"{shown(list(steps[0]))}"
        )

    actions = {}
    try:
        for robot in steps[0]:
            actions[robot] = np.stack([_row(robot, step[robot]) for step in steps])
    except ValueError as error:
        if isinstance(error, MalformedMessage):
            raise
        raise MalformedMessage(f"vlagents: steps of different lengths ({error})") from error
    return actions


def _are_steps(value: object) -> TypeGuard[list[dict[str, Any]]]:
    """Return whether a value is a list of steps, each with at least one robot."""
    if not isinstance(value, list) or not value:
        return False
    return all(isinstance(step, dict) and step for step in value)


def _row(robot: str, act: Any) -> np.ndarray:
    """Return the action of a robot in a step, with the gripper as the last number."""
    action = act.get("action") if isinstance(act, dict) else None
    if isinstance(action, list) and all(map(is_number, action)):
        action = np.asarray(action)
    if not isinstance(action, np.ndarray) or action.ndim != 1 or action.dtype.kind not in "fiu":
        raise MalformedMessage(
            f"vlagents: action of {robot[:40]!r}: expected (D,) numbers, got {shown(action)}"
        )

    gripper = act.get("gripper")
    if gripper is None:
        return action
    if isinstance(gripper, np.ndarray) and gripper.size == 1:
        gripper = gripper.item()
    if not is_number(gripper):
        raise MalformedMessage(
            f"vlagents: gripper of {robot[:40]!r}: expected a number, got {type(gripper).__name__}"
        )
    return np.append(action, gripper)
