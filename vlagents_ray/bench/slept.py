"""An environment that takes time and no CPU: many of them run on few cores, so that only what is around them shows."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.envs.base import EvalEnv, one_row
from vlagents_ray.interface import Act, Obs

SLEPT = "vlagents_ray.bench.slept:Slept"  # its name for `make_env`
ACTION_DIM = 4


class Slept(EvalEnv):
    """Each step sleeps `step_ms`, on the clock; an episode is `max_steps` of them. The image is black."""

    def __init__(self, *, step_ms: float = 20.0, max_steps: int = 50, size: int = 224) -> None:
        """`size` in pixels a side, of the one camera."""
        self.max_steps = max_steps
        self._step_s = step_ms / 1e3
        self._contract = Contract(cameras={"front": CameraSpec(size, size)}, action=ActionSpec(dim=ACTION_DIM))
        self._obs = Obs(cameras={"front": np.zeros((size, size, 3), np.uint8)})
        self._steps = 0

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return "let time pass"

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        self._steps = 0
        return self._obs, {"success": False}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        one_row(act, self._contract)
        time.sleep(self._step_s)
        self._steps += 1
        return self._obs, 0.0, False, self._steps >= self.max_steps, {"success": False}

    def close(self) -> None:
        """Nothing is held."""
