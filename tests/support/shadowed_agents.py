"""Policies whose actions depend on all that they get, to be compared to the bit."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.contract import ActionSpec, Contract


class Seeded(Agent):
    """Four rows that depend on the pixels, the joints, the instruction, the seed and the acts before."""

    contract = Contract(action=ActionSpec(dim=7), chunk=4)

    def __init__(self, ms: float = 0.0, offset: float = 0.0, fails: str = "") -> None:
        self.ms = ms
        self.offset = offset
        self.fails = Path(fails) if fails else None

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.rng = np.random.default_rng([kwargs["seed"], len(instruction or "")])
        return {}

    def act(self, obs: Obs) -> Act:
        time.sleep(self.ms / 1e3)
        if self.fails is not None and self.fails.exists():
            raise RuntimeError("the file is there")
        rows = self.rng.normal(size=(4, 7)) + obs.cameras["front"].mean() + obs.state["joints"] + self.offset
        return Act(rows.astype(np.float32))


class Unstated(Seeded):
    """States its contract only once it has loaded: eight numbers."""

    contract = None  # type: ignore[assignment]

    def initialize(self) -> None:
        self.contract = Contract(action=ActionSpec(dim=8))  # type: ignore[misc]
