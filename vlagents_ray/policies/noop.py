"""A policy that returns zeros after an adjustable time, to measure the overhead around a policy."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs


class NoopConfig(BaseModel, extra="forbid"):
    """The size of the zero action, and the latency of the simulated model."""

    action_dim: int = Field(default=7, ge=1, description="number of action values, D")
    delta: bool | None = Field(
        default=None, description="whether the contract declares relative actions"
    )
    chunk: int = Field(
        default=1, ge=1, description="rows of a chunk; 1 returns a single action, (D,)"
    )
    base_ms: float = Field(default=0.0, ge=0, description="duration of a batch of any size")
    per_item_ms: float = Field(default=0.0, ge=0, description="time that each item of a batch adds")


class Noop(Agent):
    """Returns zeros, (D,) or (chunk, D).

    A batch of B takes `base_ms + per_item_ms * B` milliseconds, in a single sleep.
    """

    Config: ClassVar[type] = NoopConfig
    shared: ClassVar[tuple[str, ...]] = ("config",)

    def __init__(self, config: NoopConfig | None = None) -> None:
        self.config = config or NoopConfig()

    @property
    def contract(self) -> Contract:
        """Actions of the configured size; the policy needs no observation."""
        return Contract(
            action=ActionSpec(dim=self.config.action_dim, delta=self.config.delta),
            chunk=self.config.chunk,
        )

    def act(self, obs: Obs) -> Act:
        self._sleep(1)
        return self._zeros()

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> list[Act | Exception]:
        self._sleep(len(obs))
        return [self._zeros() for _ in obs]

    def _zeros(self) -> Act:
        shape = (self.config.chunk, self.config.action_dim)
        return Act(np.zeros(shape[1:] if self.config.chunk == 1 else shape, np.float32))

    def _sleep(self, batch: int) -> None:
        milliseconds = self.config.base_ms + self.config.per_item_ms * batch
        if milliseconds > 0:
            time.sleep(milliseconds / 1000)
