"""LeRobot: `lerobot-eval` with a policy that does nothing and the environment that all systems run.

`lerobot-eval` steps `workers` environments in its own process, one after another, with one call of
the policy. (Environments in separate processes, `--eval.use_async_envs`, end with an error in
0.4.4, which expects an attribute `envs`.) It always makes videos of the first ten episodes, and
resets an environment again at the end of an episode.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
import peer
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from lerobot.scripts.lerobot_eval import eval_main

PLAN: dict[str, Any] = json.loads(sys.argv[4])


class TimedGym(gym.Env):  # type: ignore[misc]
    """The environment with Gymnasium's interface and LeRobot's names."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}

    def __init__(self) -> None:
        from benchmarks.environments import TimedEnv
        from vlagents_ray.interface import Act

        self._env, self._act, self._seed = TimedEnv(**PLAN["env"]), Act, PLAN["seed"]
        self._max_episode_steps = self._env.max_steps
        obs = self._named(self._env.reset(seed=self._seed)[0])
        self.task = self._env.instruction
        spaces: dict[str, Any] = {
            name: gym.spaces.Box(0, 255, one.shape, np.uint8) for name, one in obs["pixels"].items()
        }
        state = gym.spaces.Box(-np.inf, np.inf, obs["agent_pos"].shape, np.float32)
        self.observation_space = gym.spaces.Dict(
            {"pixels": gym.spaces.Dict(spaces), "agent_pos": state}
        )
        self.action_space = gym.spaces.Box(-1, 1, (self._env.contract.action.dim,), np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        self._seed = self._seed if seed is None else seed
        return self._named(self._env.reset(seed=self._seed)[0]), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        obs, reward, terminated, truncated, info = self._env.step(self._act(action))
        return self._named(obs), reward, terminated, truncated, {"is_success": info["success"]}

    def render(self) -> np.ndarray:
        return self._last

    def close(self) -> None:
        self._env.close()

    def _named(self, obs: Any) -> dict[str, Any]:
        self._last: np.ndarray = next(iter(obs.cameras.values()))
        return {"pixels": dict(obs.cameras), "agent_pos": np.concatenate(list(obs.state.values()))}


@EnvConfig.register_subclass("timed")
@dataclass
class TimedEnvConfig(EnvConfig):
    """LeRobot's settings of the environment, which is registered as `gym_timed/episodes`."""

    task: str | None = "episodes"

    def __post_init__(self) -> None:
        action = PolicyFeature(type=FeatureType.ACTION, shape=(PLAN["action_dim"],))
        self.features, self.features_map = {"action": action}, {"action": "action"}

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}


@PreTrainedConfig.register_subclass("nothing")
@dataclass
class NothingConfig(PreTrainedConfig):
    """The settings of the policy, which has none."""

    observation_delta_indices = action_delta_indices = reward_delta_indices = None

    def get_optimizer_preset(self) -> None:
        return None

    def get_scheduler_preset(self) -> None:
        return None

    def validate_features(self) -> None:
        pass


class NothingPolicy(PreTrainedPolicy):  # type: ignore[misc]
    """Answers each observation with zeros."""

    config_class, name = NothingConfig, "nothing"

    def reset(self) -> None:
        pass

    def get_optim_params(self) -> dict[str, Any]:
        return {}

    def forward(self, batch: dict[str, torch.Tensor]) -> tuple[torch.Tensor, None]:
        return torch.zeros(()), None

    def select_action(self, batch: dict[str, torch.Tensor], **_: Any) -> torch.Tensor:
        return torch.zeros(len(batch["observation.state"]), PLAN["action_dim"])

    def predict_action_chunk(self, batch: dict[str, torch.Tensor], **_: Any) -> torch.Tensor:
        return self.select_action(batch)[:, None]


def make_nothing_pre_post_processors(
    *_: Any, **__: Any
) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
    """Return processors that do nothing. LeRobot derives this function's name from the policy's
    name.
    """
    actions = {
        "to_transition": policy_action_to_transition,
        "to_output": transition_to_policy_action,
    }
    return PolicyProcessorPipeline(steps=[]), PolicyProcessorPipeline(steps=[], **actions)


def main() -> None:
    """Run `lerobot-eval`, and write a line when it has ended."""
    peer.die_with_parent()
    out = peer.own_stdout()
    gym.register("gym_timed/episodes", entry_point=TimedGym)
    sys.argv[1:] = [
        "--env.type=timed",
        "--policy.type=nothing",
        "--policy.push_to_hub=false",
        "--policy.device=cpu",
        f"--eval.n_episodes={PLAN['episodes']}",
        f"--eval.batch_size={PLAN['workers']}",
        f"--seed={PLAN['seed']}",
        f"--output_dir={PLAN['folder']}/lerobot",
    ]
    eval_main()
    print(json.dumps({}), file=out, flush=True)


if __name__ == "__main__":
    main()
