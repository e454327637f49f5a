"""An environment that LeRobot finds with `--env.discover_packages_path=lerobot_env_mirror
--env.type=mirror`. It gives a reward of 1 for each action that `mirror_policy.MirrorPolicy` returns
to a session that belongs to this environment alone.
"""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from mirror_policy import CAMERA, ROWS, SIDE, mirrored

STEPS, INSTRUCTION = 5, "mirror it"
_ID = "gym_mirror/Mirror-v0"


class Mirror(gym.Env):
    """An environment whose state is the last action, and whose images all differ in colour."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012 - Gymnasium's
    observation_space = gym.spaces.Dict(
        {
            "pixels": gym.spaces.Dict({CAMERA: gym.spaces.Box(0, 255, (SIDE, SIDE, 3), np.uint8)}),
            "agent_pos": gym.spaces.Box(-np.inf, np.inf, (3,), np.float32),
        }
    )
    action_space = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def __init__(self, render_mode: str = "rgb_array") -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.state = self.np_random.random(3).astype(np.float32)
        self.pixel, self.steps = int(self.np_random.integers(256)), 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        if self.steps % ROWS == 0:
            self.chunk = mirrored(self.state, self.pixel, self.steps // ROWS + 1, INSTRUCTION)
        right = np.array_equal(action, self.chunk[self.steps % ROWS])
        self.state, self.steps, self.pixel = (
            np.array(action, np.float32),
            self.steps + 1,
            (self.pixel + 37) % 256,
        )
        return self._observation(), float(right), False, False, {"is_success": right}

    def render(self) -> Any:
        return self._observation()["pixels"][CAMERA]

    def _observation(self) -> dict[str, Any]:
        return {
            "pixels": {CAMERA: np.full((SIDE, SIDE, 3), self.pixel, np.uint8)},
            "agent_pos": self.state,
        }


gym.register(_ID, entry_point=Mirror, max_episode_steps=STEPS)


def _features() -> dict[str, PolicyFeature]:
    return {
        "action": PolicyFeature(FeatureType.ACTION, (3,)),
        "agent_pos": PolicyFeature(FeatureType.STATE, (3,)),
        f"pixels/{CAMERA}": PolicyFeature(FeatureType.VISUAL, (SIDE, SIDE, 3)),
    }


@EnvConfig.register_subclass("mirror")
@dataclass
class MirrorEnvConfig(EnvConfig):
    task: str | None = "Mirror-v0"
    features: dict[str, PolicyFeature] = field(default_factory=_features)
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            "action": "action",
            "agent_pos": "observation.state",
            f"pixels/{CAMERA}": f"observation.images.{CAMERA}",
        }
    )

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {}
