"""A benchmark for vla-eval, written as its documentation asks; imported with the peers' Python
only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult

STEPS = 7


class Pictures(StepBenchmark):
    """Each step shows another picture; an episode succeeds if every action names the one that it
    answers.
    """

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": "task 3"}]

    def reset(self, task: dict[str, Any]) -> int:
        self.at = self.right = 0
        return self.at

    def step(self, action: dict[str, Any]) -> StepResult:
        pixel, _, acts, number = np.asarray(action["actions"])[:4]
        self.right += (pixel, acts, number) == (self.at, self.at + 1, 3)
        self.at += 1
        return StepResult(obs=self.at, reward=0.0, done=self.at == STEPS, info={})

    def make_obs(self, raw_obs: int, task: dict[str, Any]) -> dict[str, Any]:
        picture = np.full((64, 64, 3), raw_obs, np.uint8)
        return {
            "images": {"front": picture},
            "task_description": task["name"],
            "state": np.zeros(7),
        }

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        return {"success": self.right == STEPS}
