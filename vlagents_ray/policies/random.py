"""Uniformly random actions: the floor that any policy has to beat."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import NotReset
from vlagents_ray.interface import Act, Agent, Obs


class RandomConfig(BaseModel, extra="forbid"):
    """Bounds and size of the actions; `seed` is mixed with the seed of each episode."""

    action_dim: int = Field(default=7, ge=1)
    chunk: int = Field(default=1, ge=1, description="rows an `act` returns; 1 gives a single action, (D,)")
    low: float = Field(default=-1.0, allow_inf_nan=False)
    high: float = Field(default=1.0, allow_inf_nan=False)
    seed: int = Field(default=0, ge=0)

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low and high: got [{self.low}, {self.high}], want low <= high")
        return self


class Random(Agent):
    """Actions uniform in [low, high], a pure function of the config's seed and the episode's."""

    Config: ClassVar[type] = RandomConfig
    shared: ClassVar[tuple[str, ...]] = ("config",)

    def __init__(self, config: RandomConfig | None = None) -> None:
        self.config = config or RandomConfig()
        self._rng: np.random.Generator | None = None

    @property
    def contract(self) -> Contract:
        config = self.config
        return Contract(action=ActionSpec(dim=config.action_dim, low=config.low, high=config.high), chunk=config.chunk)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin the episode of `kwargs["seed"]` (an int, 0 if not given)."""
        # numpy takes no negative seed; each int64 has its own number modulo 2**64
        self._rng = np.random.default_rng([self.config.seed, int(kwargs.get("seed") or 0) % 2**64])
        return {}

    def act(self, obs: Obs) -> Act:
        if self._rng is None:
            raise NotReset("random: act before reset; call reset(obs, instruction, seed=...) first")
        shape = (self.config.chunk, self.config.action_dim)
        action = self._rng.uniform(self.config.low, self.config.high, shape).astype(np.float32)
        return Act(action[0] if self.config.chunk == 1 else action)
