"""A policy of uniformly random actions, as a lower bound for the success of other policies."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
from pydantic import BaseModel, Field, model_validator
from typing_extensions import Self

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import NotReset
from vlagents_ray.interface import DISTRIBUTION, SAMPLES, Act, Agent, Obs


class RandomConfig(BaseModel, extra="forbid"):
    """The bounds and size of the actions. `seed` is mixed with the seed of each episode."""

    action_dim: int = Field(default=7, ge=1, description="number of action values, D")
    chunk: int = Field(
        default=1, ge=1, description="rows of a chunk; 1 returns a single action, (D,)"
    )
    low: float = Field(default=-1.0, allow_inf_nan=False, description="smallest action value")
    high: float = Field(default=1.0, allow_inf_nan=False, description="largest action value")
    seed: int = Field(default=0, ge=0, description="mixed with the seed of each episode")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.low > self.high:
            raise ValueError(f"low and high: expected low <= high, got [{self.low}, {self.high}]")
        return self


class Random(Agent):
    """Returns random actions, uniform in [low, high].

    They depend only on the seeds of the config and of the episode. For an observation with
    `info["samples"] = N`, the answer also contains the distribution, as RL fine-tuning needs.
    """

    Config: ClassVar[type] = RandomConfig
    shared: ClassVar[tuple[str, ...]] = ("config",)

    def __init__(self, config: RandomConfig | None = None) -> None:
        self.config = config or RandomConfig()
        self._rng: np.random.Generator | None = None
        # The generator of samples, separate so that requesting samples changes no action.
        self._draws: np.random.Generator | None = None

    @property
    def contract(self) -> Contract:
        """Actions of the configured size and bounds; the policy needs no observation."""
        config = self.config
        return Contract(
            action=ActionSpec(dim=config.action_dim, low=config.low, high=config.high),
            chunk=config.chunk,
        )

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        """Begin an episode with the seed `kwargs["seed"]` (an int, by default 0)."""
        # Numpy accepts no negative seed. Modulo 2**64, distinct int64 values remain distinct.
        seeds = [self.config.seed, int(kwargs.get("seed") or 0) % 2**64]
        self._rng = np.random.default_rng(seeds)
        self._draws = np.random.default_rng([*seeds, 1])
        return {}

    def act(self, obs: Obs) -> Act:
        """Draw a chunk, (D,) or (chunk, D); with `info["samples"]` also samples of it."""
        if self._rng is None or self._draws is None:
            raise NotReset(
                "random: act was called before reset; call reset(obs, instruction, seed=...) first"
            )
        low, high, chunk = self.config.low, self.config.high, self.config.chunk
        shape = (self.config.action_dim,) if chunk == 1 else (chunk, self.config.action_dim)
        act = Act(self._rng.uniform(low, high, shape).astype(np.float32))

        samples = int(obs.info.get(SAMPLES) or 0)
        if samples:
            act.info[DISTRIBUTION] = {
                "mean": np.full(shape, (low + high) / 2, np.float32),
                "std": np.full(shape, (high - low) / math.sqrt(12), np.float32),
                "samples": self._draws.uniform(low, high, (samples, *shape)).astype(np.float32),
            }
        return act
