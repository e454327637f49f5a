"""A scripted expert for SIMPLER's Bridge tasks, which reads the simulator's state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.experts import sim_vector

_OPEN, _CLOSED = 1.0, 0.0
_STEP_M = 0.04  # maximum command along an axis
_STEP_RAD = 0.2  # maximum command about the vertical
# Height of the gripper above the object before the grasp, and above the target after the release.
_OVER_M = 0.08
_LIFT_M = 0.10
# Lowest height of the gripper above the robot's foot, at which the fingers do not yet press on the
# table.
_LOWEST_M = 0.0135
_DROP_M = 0.04  # height of the object's centre above the target's at the release


class _Stage(NamedTuple):
    """A stage of the motion, which ends when the gripper arrives, or after `steps`."""

    name: str
    gripper: float
    steps: int
    arrived_m: float  # distance to the goal at which the gripper has arrived


_STAGES = (
    _Stage("over", _OPEN, 12, 0.012),
    _Stage("down", _OPEN, 6, 0.006),
    _Stage("grasp", _CLOSED, 4, 0.0),
    _Stage("lift", _CLOSED, 5, 0.01),
    _Stage("across", _CLOSED, 9, 0.006),
    _Stage("lower", _CLOSED, 6, 0.006),
    _Stage("release", _OPEN, 3, 0.0),
    _Stage("away", _OPEN, 5, 0.01),
)


class SimplerExpert:
    """Solves the four tasks with `info["sim_state"]` of `vlagents_ray_sims.simpler`."""

    def __init__(self, env_name: str) -> None:
        self._name = env_name
        self._stage = self._steps = 0  # index of the stage, and number of its steps so far
        self._goal = np.zeros(3)  # position of the gripper in the base frame, m
        self._turn = 0.0  # remaining rotation about the vertical, rad

    def reset(self, obs: Obs, instruction: str) -> None:
        positions, yaw = self._state(obs)
        self._begin(0, positions)
        # The fingers may close across the object in either direction: choose the smaller turn.
        self._turn = (yaw + np.pi / 2) % np.pi - np.pi / 2

    def act(self, obs: Obs) -> Act:
        """Begin the next stage if the current stage is over, and move towards the stage's goal."""
        positions, _ = self._state(obs)
        _, _, gripper, commanded = positions
        stage = _STAGES[self._stage]
        distance = float(np.linalg.norm(gripper - self._goal))
        arrived = distance < stage.arrived_m and not self._turn
        is_over = self._steps > 0 and (arrived or self._steps >= stage.steps)
        if is_over and self._stage + 1 < len(_STAGES):
            self._begin(self._stage + 1, positions)
            stage = _STAGES[self._stage]
        self._steps += 1

        action = np.zeros(7, dtype=np.float32)
        action[:3] = np.clip(self._goal - commanded, -_STEP_M, _STEP_M)
        action[5] = np.clip(self._turn, -_STEP_RAD, _STEP_RAD)
        action[6] = stage.gripper

        if abs(self._turn) > _STEP_RAD:
            self._turn -= float(action[5])
        else:
            self._turn = 0.0  # The value is exact, although the action is rounded to float32.
        return Act(action=action)

    def _begin(self, stage: int, positions: np.ndarray) -> None:
        """Begin a stage, and set its goal from the positions that `_state` returns."""
        self._stage, self._steps = stage, 0
        position, target, gripper, _ = positions
        up = np.array([0.0, 0.0, 1.0])
        # Vector from the object to the gripper when the object is grasped.
        grip = gripper - position
        name = _STAGES[stage].name
        if name == "over":
            self._goal = np.maximum(position, [-np.inf, -np.inf, _LOWEST_M]) + _OVER_M * up
        elif name == "down":
            self._goal = self._goal - _OVER_M * up
        elif name == "lift":
            self._goal = self._goal + _LIFT_M * up
        elif name == "across":
            self._goal = np.array([*(target + grip)[:2], gripper[2]])
        elif name == "lower":
            self._goal = target + grip + _DROP_M * up
        elif name == "away":
            self._goal = self._goal + _OVER_M * up

    def _state(self, obs: Obs) -> tuple[np.ndarray, float]:
        """Return positions, (4, 3) m, and the object's yaw, rad.

        The positions are those of the object, the target, the gripper and the commanded gripper.
        """
        exact = sim_vector(obs, 13, self._name).astype(np.float64)
        return exact[:12].reshape(4, 3), float(exact[12])
