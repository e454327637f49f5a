"""Train Pendulum, an environment of this package, with PPO of Stable-Baselines3, and print the
steps and the mean return.

pip install stable-baselines3 '.[learn,sim]'
python stable_baselines.py
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from vlagents_ray_learn import as_vector_env


class StableBaselinesEnv(VecEnv):
    """Adapts a `gymnasium.vector.VectorEnv` with autoreset "same_step" to the interface of
    Stable-Baselines3's `VecEnv`.
    """

    def __init__(self, envs: Any) -> None:
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> Any:
        observations, self.reset_infos = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> tuple[Any, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observations, rewards, terminated, truncated, infos = self.envs.step(self.actions)
        over = terminated | truncated
        each: list[dict[str, Any]] = [
            {"TimeLimit.truncated": bool(one)} for one in truncated & ~terminated
        ]
        for i in np.flatnonzero(over):
            each[i]["terminal_observation"] = infos["final_obs"][i]
        return observations, rewards.astype(np.float32), over, each

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.envs, attr_name, None)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


class Curve(BaseCallback):
    """Prints the mean return of the latest episodes after each rollout."""

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        returns = [episode["r"] for episode in self.model.ep_info_buffer]
        if returns:
            print(self.num_timesteps, f"{np.mean(returns):.1f}", flush=True)  # noqa: T201


def main(steps: int = 72_000) -> None:
    """Train for `steps` environment steps."""
    # Pendulum has no success; only its returns are used here.
    options = {"cameras": {}, "unit_actions": True, "success": "terminated"}
    envs = as_vector_env("gymnasium/Pendulum-v1", 8, observation="state", env_options=options)
    settings: dict[str, Any] = {
        "n_steps": 256,
        "batch_size": 128,
        "gamma": 0.9,
        "learning_rate": 1e-3,
        "seed": 0,
    }
    PPO("MlpPolicy", VecMonitor(StableBaselinesEnv(envs)), **settings).learn(
        steps, callback=Curve()
    )
    envs.close()


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
