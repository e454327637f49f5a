"""An expert for SIMPLER's Bridge tasks: grasps the object from above and sets it down on its target."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from vlagents_ray.errors import InvalidObservation
from vlagents_ray.interface import Act, Obs

_OPEN, _CLOSED = 1.0, 0.0
_STEP_M = 0.04  # commanded along an axis, at most
_OVER_M = 0.08  # of the gripper over the object before it goes down, and over the target after it let go
_LIFT_M = 0.10
_DROP_M = 0.04  # of the object's middle over the target's, when it is let go


class _Stage(NamedTuple):
    name: str
    gripper: float
    steps: int  # after so many the next begins
    near_m: float  # or when the gripper is so near to the goal


_STAGES = (
    _Stage("over", _OPEN, 8, 0.012),
    _Stage("down", _OPEN, 6, 0.006),
    _Stage("grasp", _CLOSED, 4, 0.0),
    _Stage("lift", _CLOSED, 5, 0.01),
    _Stage("across", _CLOSED, 9, 0.006),
    _Stage("lower", _CLOSED, 6, 0.006),
    _Stage("release", _OPEN, 3, 0.0),
    _Stage("away", _OPEN, 5, 0.01),
)


class SimplerExpert:
    """Needs `info["sim_state"]` of `vlagents_ray.envs.simpler`; solves most episodes, not all."""

    def __init__(self, env_name: str) -> None:
        self._name = env_name
        self._stage = self._steps = 0
        self._goal = np.zeros(3)  # of the gripper in this stage, m in the base's frame

    def reset(self, obs: Obs, instruction: str) -> None:
        """Begin an episode; raises `InvalidObservation` without the simulator's state."""
        self._begin(0, self._places(obs))

    def act(self, obs: Obs) -> Act:
        """The next action, (7,) float32."""
        places = self._places(obs)
        _, _, gripper, commanded = places
        stage = _STAGES[self._stage]
        arrived = float(np.linalg.norm(gripper - self._goal)) < stage.near_m
        if self._stage + 1 < len(_STAGES) and self._steps and (arrived or self._steps >= stage.steps):
            self._begin(self._stage + 1, places)
            stage = _STAGES[self._stage]
        self._steps += 1
        action = np.zeros(7, dtype=np.float32)
        action[:3] = np.clip(self._goal - commanded, -_STEP_M, _STEP_M)
        action[6] = stage.gripper
        return Act(action=action)

    def _begin(self, stage: int, places: np.ndarray) -> None:
        self._stage, self._steps = stage, 0
        thing, target, gripper, _ = places
        up = np.array([0.0, 0.0, 1.0])
        held = gripper - thing  # from the object to the gripper, once it is grasped
        name = _STAGES[stage].name
        if name == "over":
            self._goal = thing + _OVER_M * up
        elif name == "down":
            self._goal = self._goal - _OVER_M * up
        elif name == "lift":
            self._goal = self._goal + _LIFT_M * up
        elif name == "across":
            self._goal = np.array([*(target + held)[:2], gripper[2]])
        elif name == "lower":
            self._goal = target + held + _DROP_M * up
        elif name == "away":
            self._goal = self._goal + _OVER_M * up

    def _places(self, obs: Obs) -> np.ndarray:
        """Where object, target and gripper are, and where the gripper is commanded to, (4, 3) m."""
        state = obs.info.get("sim_state")
        if not isinstance(state, np.ndarray) or state.shape != (12,):
            got = f"shape {state.shape}" if isinstance(state, np.ndarray) else type(state).__name__
            raise InvalidObservation(f"info['sim_state']: got {got}, want (12,) float32; this expert is for {self._name}")
        return state.astype(np.float64).reshape(4, 3)
