"""The client's side of the package `vlagents`, 0.3: calls of a server's methods over RPyC, and what they return.

A server's root is named by a reference that it sends once; its methods are called by that and their name. No object of
this process is ever offered to the server, and what it returns is text, a truth value, or an error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.errors import MalformedMessage, shown
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Limits
from vlagents_ray.protocol.observations import is_number
from vlagents_ray.wire import json_numpy
from vlagents_ray.wire.vlagents import rpyc

_LEVELS = 4  # levels of nesting above an action: reply, acts, step, robot
_ERROR = 2000  # characters of an error


@dataclass(frozen=True, slots=True)
class RemoteError:
    """An error that the server's method raised."""

    text: str


def get_root(sequence: int) -> bytes:
    """Return the frame that asks for the reference to the server's root."""
    return rpyc.request(sequence, rpyc.Handler.GETROOT, rpyc.boxed_value(()))


def call(sequence: int, root: tuple[Any, ...], method: str, *args: str) -> bytes:
    """Return the frame that calls a method of the server's root with texts."""
    return rpyc.request(
        sequence,
        rpyc.Handler.CALLATTR,
        rpyc.boxed_tuple(rpyc.boxed_reference(root), *map(rpyc.boxed_value, (method, args, ()))),
    )


def read(body: bytes | bytearray, compressed: bool, limit: int) -> tuple[int, Any] | None:
    """Return the sequence number and the value of a reply; None if the message is none.

    Args:
        body: A frame's bytes after the header.
        compressed: As the header says.
        limit: Most bytes of the message once it is decompressed.

    Returns:
        The value: None, bool, number, text, bytes, tuple, or a `RemoteError`.
    """
    message = rpyc.read_reply(body, compressed, limit)
    if message is None:
        return None
    sequence, ok, content = message
    if not ok:
        return sequence, RemoteError(content[:_ERROR] if isinstance(content, str) else shown(content, _ERROR))
    if not (isinstance(content, tuple) and len(content) == 2):
        raise MalformedMessage("rpyc: want (label, value)")
    return sequence, content[1]


def write_observation(observation: Mapping[str, Any]) -> str:
    """Return the argument of `act`.

    Args:
        observation: `language_instruction`, and for each robot a map of its `cameras`, `joints`, `xyzrpy`, `tquat` and
            `gripper`, (1,).
    """
    robots = {name: _robot(one) for name, one in observation.items() if isinstance(one, Mapping)}
    return json_numpy.dumps(
        {
            "obs": robots,
            "language_instruction": observation.get("language_instruction"),
            "goal_image": None,
            "goal_image_data_type": "raw",
        }
    )


def read_act(text: str, limits: Limits = DEFAULT_LIMITS) -> dict[str, np.ndarray]:
    """Return the actions in the reply to `act` by robot, each (H, D); a gripper is the last column, 1 = open."""
    document = json_numpy.loads(text, limits, _LEVELS)
    steps = document.get("acts") if isinstance(document, dict) else None
    if not isinstance(steps, list) or not steps or not all(isinstance(step, dict) and step for step in steps):
        raise MalformedMessage("vlagents: want `acts`, a list of one step or more, with the robots of each")
    if any(step.keys() != steps[0].keys() for step in steps):
        raise MalformedMessage("vlagents: want the same robots in each step of `acts`")
    try:
        return {robot: np.stack([_row(robot, step[robot]) for step in steps]) for robot in steps[0]}
    except ValueError as error:
        if isinstance(error, MalformedMessage):
            raise
        raise MalformedMessage(f"vlagents: steps of different lengths ({error})") from error


def _robot(one: Mapping[str, Any]) -> dict[str, Any]:
    known = {name: one.get(name) for name in ("joints", "xyzrpy", "tquat")}
    gripper = one.get("gripper")
    return {
        "cameras": dict(one.get("cameras", {})),
        "camera_data_type": "raw",
        "gripper": float(gripper[0]) if isinstance(gripper, np.ndarray) else gripper,
        **known,
        "info": dict(one.get("info", {})),
    }


def _row(robot: str, act: Any) -> np.ndarray:
    action = act.get("action") if isinstance(act, dict) else None
    if isinstance(action, list) and all(map(is_number, action)):
        action = np.asarray(action)
    if not isinstance(action, np.ndarray) or action.ndim != 1 or action.dtype.kind not in "fiu":
        raise MalformedMessage(f"vlagents: action of {robot[:40]!r}: want (D,) numbers")
    gripper = act.get("gripper")
    if gripper is None:
        return action
    if isinstance(gripper, np.ndarray) and gripper.size == 1:
        gripper = gripper.item()
    if not is_number(gripper):
        raise MalformedMessage(f"vlagents: gripper of {robot[:40]!r}: got {type(gripper).__name__}, want a number")
    return np.append(action, gripper)
