"""PushT: a disc pushes a T-shaped block onto its outline; from Diffusion Policy, as packaged by gym-pusht."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.envs.base import require_known
from vlagents_ray.envs.gymnasium.env import Gymnasium
from vlagents_ray.interface import Obs

_ID = "gym_pusht/PushT-v0"
# What is observed in each task: options of `Gymnasium`.
_TASKS: dict[str, Mapping[str, Any]] = {
    "image": {},
    "keypoints": {"kwargs": {"obs_type": "environment_state_agent_pos"}, "cameras": {}},
}


class PushT(Gymnasium):
    """PushT by its published protocol, "image" or "keypoints".

    Observation: `state["agent_pos"]`, (2,) in pixels of the field, 512 by 512. With "image" also "front", (96, 96, 3)
    by default; with "keypoints" `state["environment_state"]`, (16,), x and y of eight points of the block, in pixels.
    In `info["sim_state"]`, (7,) float64, what the simulator knows: x, y of the agent and its velocity, pixels and
    pixels/s; x, y and angle of the block, pixels and rad.

    Action: (2,) in [0, 512]: where the disc shall go, in the same pixels.
    """

    def __init__(
        self,
        task: str = "image",
        *,
        width: int | None = None,
        height: int | None = None,
        max_steps: int | None = None,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: What is observed, "image" or "keypoints".
            width: The width to which the image is stretched, pixels.
            height: The height to which the image is stretched, pixels.
            max_steps: The step limit; 300 by default.
            record_size: Height and width of further copies of the image, for recordings only.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value.
            MissingDependency: gym-pusht is not installed.
        """
        self.require_task(task)
        super().__init__(_ID, **_TASKS[task], width=width, height=height, max_steps=max_steps, record_size=record_size)

    @classmethod
    def tasks(cls) -> list[str]:
        return list(_TASKS)

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("pusht", task or "image", cls.tasks())

    @classmethod
    def missing(cls) -> str | None:
        if importlib.util.find_spec("gym_pusht") is None:
            return "gym_pusht is not installed; pip install 'vlagents-ray[pusht]'"
        return None

    def _observe(self, nested: Any) -> Obs:
        obs = super()._observe(nested)
        agent, block = self._env.unwrapped.agent, self._env.unwrapped.block
        obs.info["sim_state"] = np.array([*agent.position, *agent.velocity, *block.position, block.angle])
        return obs
