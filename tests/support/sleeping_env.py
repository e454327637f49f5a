"""An environment whose steps sleep, so that many environments run on few cores."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.envs.base import EvalEnv, one_row
from vlagents_ray.interface import Act, Obs

_SIZE = 32  # width and height of the only camera, pixels
_OBS = Obs(cameras={"front": np.zeros((_SIZE, _SIZE, 3), np.uint8)})


class SleepingEnv(EvalEnv):
    """An environment whose episodes have `max_steps` steps of `step_ms` each."""

    instruction = "let time pass"
    contract = Contract(cameras={"front": CameraSpec(_SIZE, _SIZE)}, action=ActionSpec(dim=4))

    def __init__(self, *, step_ms: float, max_steps: int) -> None:
        self.max_steps = max_steps
        self._step_s = step_ms / 1e3
        self._steps = 0

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        self._steps = 0
        return _OBS, {"success": False}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        one_row(act, self.contract)
        time.sleep(self._step_s)
        self._steps += 1
        return _OBS, 0.0, False, self._steps >= self.max_steps, {"success": False}

    def close(self) -> None:
        """Do nothing: no resource is held."""
