"""Experts for ManiSkill's PushCube and PickCube, which use the simulator's state."""

from __future__ import annotations

import numpy as np

from vlagents_ray.interface import Act, Obs
from vlagents_ray.policies.experts import sim_vector

_UNIT_M = 0.1  # motion that an action of 1.0 commands
_OPEN, _CLOSED = 1.0, -1.0
_CURE = "this expert needs the env's default robot, in the control mode pd_ee_delta_pose"


class _CubeExpert:
    """Moves the tool in phases; the first phase is "over"."""

    _SIZE: int  # length of the simulator's state

    def __init__(self, env_name: str) -> None:
        self._name, self._phase, self._closing, self._hand = env_name, "over", 0, _Hand()

    def reset(self, obs: Obs, instruction: str) -> None:
        self._state(obs)
        self._phase, self._closing, self._hand = "over", 0, _Hand()

    def _state(self, obs: Obs) -> np.ndarray:
        return sim_vector(obs, self._SIZE, self._name, _CURE).astype(np.float64)


class PushCube(_CubeExpert):
    """Moves behind the cube and down to the table, and pushes the cube along x onto the target."""

    _SIZE = 35
    _BEHIND_M = 0.12  # distance of the tool behind the cube before the push
    _OVER_M = 0.15  # height of the tool above the cube before it moves down
    _LOW_M = 0.02  # height of the tool while pushing: the cube's middle
    _FAR_M = 0.28  # distance of the target centre from the table's centre along x
    _PLACED_M = 0.03  # distance of the cube from the target's centre; success needs 0.1

    def act(self, obs: Obs) -> Act:
        """Return the next action of the push, (7,)."""
        # The state: qpos 9, qvel 9, tool pose 7, goal 3, cube pose 7.
        state = self._state(obs)
        tool, goal, cube = state[18:21], state[25:28], state[28:31]
        over = np.array([cube[0] - self._BEHIND_M, cube[1], self._OVER_M])
        low = np.array([cube[0] - self._BEHIND_M, cube[1], self._LOW_M])

        if self._phase == "over" and np.linalg.norm(tool[:2] - over[:2]) < 0.02:
            self._phase = "down"
        if self._phase == "down" and tool[2] < self._LOW_M + 0.015:
            self._phase = "push"
        if self._phase == "push" and np.linalg.norm(cube[:2] - goal[:2]) < self._PLACED_M:
            self._phase = "hold"

        if self._phase == "over":
            return self._hand.move(tool, over, _CLOSED)
        if self._phase == "down":
            return self._hand.move(tool, low, _CLOSED)
        if self._phase == "push":
            # Near the end of its reach the arm lags behind, so the cube must slide the last
            # centimetres.
            speed = 0.8 if goal[0] > self._FAR_M else 0.5
            target = np.array([goal[0], goal[1], self._LOW_M])
            return self._hand.move(tool, target, _CLOSED, limit=speed)
        return self._hand.move(tool, tool, _CLOSED)


class PickCube(_CubeExpert):
    """Moves over the cube and down, grasps it, moves it to the goal and holds it there."""

    _SIZE = 42
    _OVER_M = 0.08  # height of the tool over the cube before it descends
    _GRASP_STEPS = 3  # number of steps until the fingers hold the cube
    # Number of steps without contact on both fingers after which the expert tries again.
    _GIVE_UP_STEPS = 8

    def act(self, obs: Obs) -> Act:
        """Return the next action of the pick, (7,)."""
        # The state: qpos 9, qvel 9, grasped 1, tool pose 7, goal 3, cube pose 7, tool to cube 3,
        # cube to goal 3.
        state = self._state(obs)
        grasped, tool, goal, cube = state[18] > 0.5, state[19:22], state[26:29], state[29:32]

        if self._phase == "over" and np.linalg.norm(tool[:2] - cube[:2]) < 0.01:
            self._phase = "down"
        if self._phase == "down" and np.linalg.norm(tool - cube) < 0.012:
            self._phase, self._closing = "grasp", 0
        if self._phase == "grasp":
            self._closing += 1
            if grasped and self._closing > self._GRASP_STEPS:
                self._phase = "carry"
            elif self._closing > self._GIVE_UP_STEPS:
                self._phase = "over"

        if self._phase == "over":
            return self._hand.move(tool, cube + np.array([0.0, 0.0, self._OVER_M]), _OPEN)
        if self._phase == "down":
            return self._hand.move(tool, cube, _OPEN, limit=0.5)
        if self._phase == "grasp":
            return self._hand.move(tool, tool, _CLOSED)
        # The cube, not the tool, must reach the target; shorter steps let the arm settle.
        return self._hand.move(tool, tool + 0.8 * (goal - cube), _CLOSED, limit=0.6)


class _Hand:
    """Converts remaining distances to actions, with shorter steps while the arm does not follow
    its commands.
    """

    _STUCK_M = 0.001  # largest motion of an arm that counts as stuck after a longer command

    def __init__(self) -> None:
        self._at: np.ndarray | None = None  # (3,) m, position at the last step
        self._commanded_m = 0.0
        self._scale = 1.0

    def move(self, tool: np.ndarray, target: np.ndarray, gripper: float, limit: float = 1.0) -> Act:
        """Return an action that moves the tool towards a target.

        Args:
            tool: The position of the tool, (3,) m.
            target: The target position, (3,) m.
            gripper: The command of the gripper.
            limit: The largest command along each axis, units.
        """
        moved_m = np.inf if self._at is None else float(np.linalg.norm(tool - self._at))
        stuck = moved_m < self._STUCK_M and self._commanded_m > 10 * self._STUCK_M
        self._scale = max(self._scale / 2, 0.1) if stuck else min(self._scale * 2, 1.0)
        action = np.zeros(7, dtype=np.float32)
        action[:3] = np.clip((target - tool) / _UNIT_M, -limit, limit) * self._scale
        action[6] = gripper
        self._at, self._commanded_m = tool, _UNIT_M * float(np.linalg.norm(action[:3]))
        return Act(action=action)
