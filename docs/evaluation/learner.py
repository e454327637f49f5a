"""A simulated learner for the picture of the report: the scripted expert, whose error shrinks with
the training step.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray import Act, Obs
from vlagents_ray.policies.scripted import Scripted


class LearnerConfig(BaseModel, extra="forbid"):
    """Task of the scripted expert, training step of the checkpoint, and size of the error."""

    task: str | None = None
    checkpoint_step: int = Field(default=0, ge=0)
    drift: float = Field(
        default=0.3, ge=0, description="standard deviation of the drift before training, per action"
    )


class Learner(Scripted):
    """Adds a constant drift to all actions of an episode. The drift's standard deviation halves
    every 5000 training steps.
    """

    Config: ClassVar[type] = LearnerConfig

    def __init__(self, config: LearnerConfig | None = None) -> None:
        super().__init__()
        self.config: Any = config or LearnerConfig()
        self._drift = np.zeros(1, np.float32)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        info = super().reset(obs, instruction, **kwargs)
        scale = self.config.drift * 0.5 ** (self.config.checkpoint_step / 5000)
        rng = np.random.default_rng([int(kwargs.get("seed") or 0), len(kwargs.get("env") or "")])
        self._drift = rng.normal(0.0, scale, 3).astype(np.float32)
        return info

    def act(self, obs: Obs) -> Act:
        action = np.array(super().act(obs).action)
        action[..., :3] = np.clip(action[..., :3] + self._drift, -1.0, 1.0)
        return Act(action)
