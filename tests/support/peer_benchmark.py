"""Benchmarks for vla-eval: one that follows vla-eval's documentation, and vla-eval's own RoboTwin
and RoboDojo with stand-ins for their simulators. Only the Python of the peers' environment imports
this module.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.benchmarks.robodojo.benchmark import RoboDojoBenchmark
from vla_eval.benchmarks.robotwin import RoboTwinBenchmark

STEPS = 7
CHUNK = 3  # number of rows that the policy returns, and after which RoboTwin renders its cameras


class Pictures(StepBenchmark):
    """Each step shows another picture. An episode succeeds if each action contains the value of the
    picture that it answers.
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


class _TwoArms:
    """A stand-in for a simulator, in which the picture and the left arm's state are the step's
    number.

    An episode succeeds if each action is a row of the chunk for the picture at the beginning of
    that chunk.
    """

    step_lim = STEPS

    def __init__(self) -> None:
        self.take_action_cnt = 0
        self.right = 0

    @property
    def eval_success(self) -> bool:
        return self.right == STEPS

    @property
    def success(self) -> list[bool]:
        return [self.eval_success]

    def is_episode_end(self) -> bool:
        return self.take_action_cnt == STEPS

    def execute(self, action: np.ndarray) -> None:
        """Count an action, (14,), if it is the expected one."""
        step = self.take_action_cnt
        begin = step - step % CHUNK
        acts = begin // CHUNK + 1
        expected = [begin, 6 * begin, acts, 3, step % CHUNK]
        self.right += len(action) == 14 and action[:5].tolist() == expected
        self.take_action_cnt += 1

    def picture(self) -> np.ndarray:
        return np.full((64, 64, 3), self.take_action_cnt, np.uint8)

    def left_arm(self) -> np.ndarray:
        return np.full(6, self.take_action_cnt, np.float32)


class _RoboTwinScene(_TwoArms):
    """The interface of RoboTwin's environments that vla-eval uses."""

    def take_action(self, action: np.ndarray, action_type: str) -> None:
        assert action_type == "qpos"
        self.execute(action)

    def get_obs(self) -> dict[str, Any]:
        names = ("head_camera", "left_camera", "right_camera")
        picture = self.picture()
        return {
            "observation": {name: {"rgb": picture} for name in names},
            "joint_action": {"vector": np.concatenate([self.left_arm(), np.zeros(8)])},
        }


class RoboTwin(RoboTwinBenchmark):
    """RoboTwin's benchmark, without SAPIEN."""

    def __init__(self) -> None:
        super().__init__("beat_block_hammer", render_every=CHUNK, test_num=1)

    def get_tasks(self) -> list[dict[str, Any]]:
        return [self._task_entry(100_000, 0, "task 3")]

    def reset(self, task: dict[str, Any]) -> Any:
        self._steps = 0
        self._env = _RoboTwinScene()
        return self._env.get_obs()

    def cleanup(self) -> None:
        """Do nothing, since there is no simulator."""


class _RoboDojoScene(_TwoArms):
    """The interface of RoboDojo's environments that vla-eval uses."""

    def take_action(self, action: dict[str, np.ndarray]) -> None:
        self.execute(np.concatenate(list(action.values())))

    def get_obs(self) -> dict[str, Any]:
        names = ("cam_head", "cam_left_wrist", "cam_right_wrist")
        picture = self.picture()
        return {
            "vision": {name: {"color": picture} for name in names},
            "state": {
                "right_arm_joint_state": np.zeros(6),
                "right_ee_joint_state": np.zeros(1),
                "left_ee_joint_state": np.zeros(1),
                "left_arm_joint_state": self.left_arm(),
            },
            "instruction": "task 3",
        }


class RoboDojo(RoboDojoBenchmark):
    """RoboDojo's benchmark, without Isaac Sim."""

    def get_tasks(self) -> list[dict[str, Any]]:
        return [{"name": "stack_blocks", "suite": "robodojo"}]

    def reset(self, task: dict[str, Any]) -> Any:
        self._env = _RoboDojoScene()
        return self._env.get_obs()

    def cleanup(self) -> None:
        """Do nothing, since there is no simulator."""
