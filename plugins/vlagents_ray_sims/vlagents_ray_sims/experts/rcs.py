"""An expert for RCS's pick task, from the pose of the cuboid."""

from __future__ import annotations

import math

import numpy as np

from vlagents_ray.errors import InvalidObservation, MissingState
from vlagents_ray.interface import Act, Obs

_OPEN, _CLOSED = 1.0, 0.0
_CUBOID = "PickTask_box_joint"


class RcsPick:
    """Moves above the cuboid, aligns with it, moves down, closes the gripper, and lifts.

    Its actions are those of the control mode `tquat`, absolute, (8,): metres and quaternion xyzw in
    the robot's base frame, then the gripper, 1 open, 0 closed. The hand points down, and its
    fingers close along the cuboid's shorter side, 32 mm.
    """

    _STEP_M = 0.02  # largest change of the commanded position in a step
    _OVER_M = 0.12  # height of the tool above the cuboid's middle before it goes down
    _ARRIVED_M = 0.006
    _GRASP_STEPS = 12  # until the fingers have closed
    _LIFT_M = 0.2  # above the cuboid's first position; success needs about 5 cm

    def __init__(self, env_name: str) -> None:
        self._name = env_name
        self._phase = "over"
        self._closing = 0
        self._commanded = np.zeros(3)
        self._lay = np.zeros(3)

    def reset(self, obs: Obs, instruction: str) -> None:
        self._phase, self._closing = "over", 0
        self._commanded = _tool(obs)
        self._lay = self._cuboid(obs)[:3]

    def act(self, obs: Obs) -> Act:
        tool, cuboid = _tool(obs), self._cuboid(obs)
        over = cuboid[:3] + np.array([0.0, 0.0, self._OVER_M])
        if self._phase == "over" and np.linalg.norm(tool - over) < self._ARRIVED_M:
            self._phase = "down"
        if self._phase == "down" and np.linalg.norm(tool - cuboid[:3]) < self._ARRIVED_M:
            self._phase, self._lay = "grasp", cuboid[:3]
        if self._phase == "grasp":
            self._closing += 1
            if self._closing > self._GRASP_STEPS:
                self._phase = "lift"
        target = {
            "over": over,
            "down": cuboid[:3],
            "grasp": self._lay,
            "lift": self._lay + np.array([0.0, 0.0, self._LIFT_M]),
        }[self._phase]
        self._commanded = self._commanded + _at_most(target - self._commanded, self._STEP_M)
        gripper = _OPEN if self._phase in ("over", "down") else _CLOSED
        pose = np.concatenate([self._commanded, _down(_turn(cuboid[3:])), [gripper]])
        return Act(action=pose.astype(np.float32))

    def _cuboid(self, obs: Obs) -> np.ndarray:
        pose = obs.info.get("objects", {}).get(_CUBOID)
        if not isinstance(pose, np.ndarray) or pose.shape != (7,):
            raise InvalidObservation(
                f"info['objects'][{_CUBOID!r}]: got {type(pose).__name__}, want (7,) float64; this "
                f"expert is for {self._name} in the control mode tquat"
            )
        return pose


def _tool(obs: Obs) -> np.ndarray:
    if "tquat" not in obs.state:
        raise MissingState("tquat", have=obs.state)
    return obs.state["tquat"][:3].astype(np.float64)


def _turn(wxyz: np.ndarray) -> float:
    """Return a lying cuboid's rotation about the vertical in [-pi/2, pi/2], as half a turn makes
    no difference.
    """
    turn = 2 * math.atan2(wxyz[3], wxyz[0])
    return math.remainder(turn, math.pi)


def _down(turn: float) -> list[float]:
    """Return the quaternion xyzw of a hand that points down, rotated about the vertical."""
    return [math.cos(turn / 2), math.sin(turn / 2), 0.0, 0.0]


def _at_most(way: np.ndarray, length: float) -> np.ndarray:
    return way * min(1.0, length / max(float(np.linalg.norm(way)), 1e-9))
