"""An environment as a robot of the control loop, so that a human can drive a simulation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vlagents_ray.interface import Act, Obs

if TYPE_CHECKING:
    from vlagents_ray.envs.base import EvalEnv


class EnvRobot:
    """One episode of an environment as a `Robot`: each command is a step, and without one, time stands still.

    Args:
        env: The environment; the caller closes it.
        seed: The seed of the episode.
        endless: Whether the step limit of the environment is ignored, as a human takes longer than a policy.
    """

    simulated = True

    def __init__(self, env: EvalEnv, seed: int, *, endless: bool = False) -> None:
        self._env, self._endless = env, endless
        self._obs, _ = env.reset(seed=seed)
        self.success = False  # the task was solved
        self.ended = False  # by success, or as the environment says
        self.steps = 0

    def observe(self) -> Obs:
        """Return the observation after the last step."""
        return self._obs

    def apply(self, action: np.ndarray) -> None:
        """Make a step, if the episode has not ended."""
        if self.ended:
            return
        self._obs, _, terminated, truncated, info = self._env.step(Act(action))
        self.steps += 1
        self.success = bool(info.get("success", False))
        self.ended = self.success or terminated or (truncated and not self._endless)

    def stop(self) -> None:
        """Do nothing: the simulation makes a step only at a command."""
