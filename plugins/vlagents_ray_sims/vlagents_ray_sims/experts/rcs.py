"""A scripted expert for RCS's pick task, which reads the pose of the cuboid."""

from __future__ import annotations

import math

import numpy as np

from vlagents_ray.errors import InvalidObservation, MissingState
from vlagents_ray.interface import Act, Obs

_OPEN, _CLOSED = 1.0, 0.0
_CUBOID = "PickTask_box_joint"


class RcsPick:
    """Moves above the cuboid, aligns with it, moves down, closes the gripper, and lifts.

    An action is (8,), absolute, for the control mode `tquat`: position, m, and quaternion xyzw in
    the robot's base frame, then the gripper, 1 open, 0 closed. The hand points down, and its
    fingers close along the cuboid's shorter side, 32 mm.
    """

    _STEP_M = 0.02  # largest change of the commanded position in a step
    _OVER_M = 0.12  # height of the tool above the cuboid's middle before it goes down
    _ARRIVED_M = 0.006  # distance to the target at which the tool has arrived
    _GRASP_STEPS = 12  # steps until the fingers have closed
    _LIFT_M = 0.2  # height of the target above the grasp; success needs about 5 cm

    def __init__(self, env_name: str) -> None:
        self._name = env_name
        self._phase = "over"
        self._closing_steps = 0
        self._commanded = np.zeros(3)  # the last commanded position, m
        self._grasp_position = np.zeros(3)  # position of the cuboid when the grasp begins, m

    def reset(self, obs: Obs, instruction: str) -> None:
        self._phase, self._closing_steps = "over", 0
        self._commanded = _tool(obs)
        self._grasp_position = self._cuboid(obs)[:3]

    def act(self, obs: Obs) -> Act:
        """Begin the next phase if the current phase is over, and move towards the phase's
        target.
        """
        tool, cuboid = _tool(obs), self._cuboid(obs)
        position, orientation = cuboid[:3], cuboid[3:]
        over = position + np.array([0.0, 0.0, self._OVER_M])

        if self._phase == "over" and np.linalg.norm(tool - over) < self._ARRIVED_M:
            self._phase = "down"
        if self._phase == "down" and np.linalg.norm(tool - position) < self._ARRIVED_M:
            self._phase, self._grasp_position = "grasp", position
        if self._phase == "grasp":
            self._closing_steps += 1
            if self._closing_steps > self._GRASP_STEPS:
                self._phase = "lift"

        targets = {
            "over": over,
            "down": position,
            "grasp": self._grasp_position,
            "lift": self._grasp_position + np.array([0.0, 0.0, self._LIFT_M]),
        }
        move = targets[self._phase] - self._commanded
        self._commanded = self._commanded + _shortened(move, self._STEP_M)
        gripper = _OPEN if self._phase in ("over", "down") else _CLOSED
        action = np.concatenate([self._commanded, _down(_yaw(orientation)), [gripper]])
        return Act(action=action.astype(np.float32))

    def _cuboid(self, obs: Obs) -> np.ndarray:
        """Return the cuboid's pose, (7,): position, m, and quaternion wxyz."""
        pose = obs.info.get("objects", {}).get(_CUBOID)
        if not isinstance(pose, np.ndarray) or pose.shape != (7,):
            raise InvalidObservation(
                f"info['objects'][{_CUBOID!r}]: expected (7,) float64, got {type(pose).__name__}; "
                f"use this expert with {self._name} in the control mode tquat"
            )
        return pose


def _tool(obs: Obs) -> np.ndarray:
    """Return the position of the tool in the base frame, (3,) m."""
    if "tquat" not in obs.state:
        raise MissingState("tquat", have=obs.state)
    return obs.state["tquat"][:3].astype(np.float64)


def _yaw(wxyz: np.ndarray) -> float:
    """Return a lying cuboid's rotation about the vertical, rad.

    Half a turn makes no difference to a cuboid, so the result is in [-pi/2, pi/2].
    """
    yaw = 2 * math.atan2(wxyz[3], wxyz[0])
    return math.remainder(yaw, math.pi)


def _down(yaw: float) -> list[float]:
    """Return the quaternion xyzw of a hand that points down, rotated about the vertical, rad."""
    return [math.cos(yaw / 2), math.sin(yaw / 2), 0.0, 0.0]


def _shortened(move: np.ndarray, max_length: float) -> np.ndarray:
    """Return a vector with the direction of `move` that is at most `max_length` long."""
    length = max(float(np.linalg.norm(move)), 1e-9)
    return move * min(1.0, max_length / length)
