"""An expert for FetchReach of Gymnasium-Robotics, which uses the positions in the state."""

from __future__ import annotations

import numpy as np

from vlagents_ray.errors import MissingState
from vlagents_ray.interface import Act, Obs

_METRES_PER_UNIT = 0.05  # from MujocoFetchEnv._set_action of Gymnasium-Robotics
# Share of the remaining distance that each step covers, so that the arm does not overshoot.
_GAIN = 0.5


class FetchReach:
    """Moves the hand straight to the target and holds it there. Actions are (4,) in [-1, 1]."""

    def __init__(self, env_name: str) -> None:
        self._name = env_name

    def reset(self, obs: Obs, instruction: str) -> None:
        self._way(obs)

    def act(self, obs: Obs) -> Act:
        action = np.zeros(4, dtype=np.float32)
        action[:3] = np.clip(_GAIN * self._way(obs) / _METRES_PER_UNIT, -1.0, 1.0)
        return Act(action=action)

    def _way(self, obs: Obs) -> np.ndarray:
        """Return the vector from the gripper to the target, (3,) m."""
        for name in ("desired_goal", "achieved_goal"):
            if name not in obs.state:
                raise MissingState(name, have=obs.state)
        way: np.ndarray = obs.state["desired_goal"] - obs.state["achieved_goal"]
        return way
