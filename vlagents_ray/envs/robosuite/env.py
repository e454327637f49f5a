"""A task of robosuite as an environment for evaluations."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.envs.base import require_known
from vlagents_ray.envs.rendering.render_probe import failing, without, without_egl
from vlagents_ray.envs.robosuite.base import RobosuiteEnv
from vlagents_ray.envs.robosuite.importing import importing_robosuite
from vlagents_ray.envs.robosuite.simulation import seeded
from vlagents_ray.envs.robosuite.tasks import CONTROL_HZ, TASKS, contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

_CURE = (
    "run `vlagents-ray env make requirements/robosuite.txt` and give the evaluation's workers that environment's Python"
)


class Robosuite(RobosuiteEnv):
    """One environment of one of robosuite's tasks, e.g. "Lift".

    Observation: cameras by robosuite's names, upright; in `state`, by robomimic's names, for each arm
    `robot0_eef_pos` (3,) m and `robot0_eef_quat` (4,) xyzw of the hand in the world's frame, `robot0_gripper_qpos`
    (2,) m of the fingers, and `robot0_joint_pos` (7,) rad. In `info["sim_state"]`, for scripted experts only: the
    positions and quaternions xyzw of objects, and `target_pos`, where one of them belongs.

    Action: (7,) in [-1, 1] for each arm: the hand's target moves by 0.05 m a unit along the base's axes, and turns by
    0.5 rad a unit about them, axis-angle; the last is the gripper, -1 opens, 1 closes, and only its sign counts.
    """

    def __init__(
        self,
        task: str = "Lift",
        *,
        width: int | None = None,
        height: int | None = None,
        cameras: Sequence[str] | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
        ends_on_success: bool = True,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: robosuite's name, one of `tasks()`.
            width: Width of each image, pixels; None is robomimic's for the task.
            height: Height of each image, pixels; None is robomimic's for the task.
            cameras: MuJoCo's names; None are robomimic's for the task.
            instruction: The task in words; None is one for the task.
            max_steps: The step limit; None is the protocol's for the task.
            ends_on_success: As in robomimic; False: success at the end can be measured, too.
            record_size: Height and width of further views by the same cameras, for recordings only.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value, or the installed robosuite has no such task.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator cannot be loaded.
        """
        self.require_task(task)
        self._task = TASKS[task]
        super().__init__(
            f"robosuite/{task}",
            protocol=self._task.protocol,
            width=width,
            height=height,
            max_steps=max_steps,
            ends_on_success=ends_on_success,
            record_size=record_size,
        )
        self._contract = self.known_contract({"task": task, "width": width, "height": height, "cameras": cameras})
        self._instruction = instruction or self._task.instruction
        with importing_robosuite("robosuite"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of upstream code
            simulator = require("robosuite")
        if task not in simulator.ALL_ENVIRONMENTS:
            raise ConfigError(f"{self._name}: robosuite {simulator.__version__} has no such task, 1.5 has; {_CURE}")
        images = self._contract.cameras or {}
        with failing(self._name, "make"), seeded(0):
            made = simulator.make(
                task,
                robots=["Panda"] * len(self._task.arms),
                controller_configs=_controllers(simulator),
                control_freq=CONTROL_HZ,
                ignore_done=True,
                has_renderer=False,
                has_offscreen_renderer=bool(images),
                renderer="mujoco",  # with 1.5's own, a reset leaves the last episode's to a garbage collection
                use_camera_obs=bool(images),
                camera_names=list(images) or "agentview",
                camera_heights=[spec.height for spec in images.values()] or 1,
                camera_widths=[spec.width for spec in images.values()] or 1,
            )
            for arm in self._task.arms:  # which robosuite leaves out, and robomimic has
                made.modify_observable(f"{arm}_joint_pos", "active", modifier=True)
        self._use(made)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        task = TASKS[arguments["task"]]
        chosen = task.cameras if arguments["cameras"] is None else arguments["cameras"]
        size = CameraSpec(arguments["height"] or task.size, arguments["width"] or task.size)
        return contract(task, dict.fromkeys(chosen, size))

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("robosuite", task or "Lift", cls.tasks())

    @classmethod
    def tasks(cls) -> list[str]:
        return list(TASKS)

    @classmethod
    def missing(cls) -> str | None:
        """Say why robosuite cannot run here; the first call in a process renders one frame in a child."""
        return without(("robosuite", "mujoco"), _CURE) or without_egl("robosuite")

    def describe(self) -> dict[str, Any]:
        played = self._protocol.describe(max_steps=self.max_steps, ends_on_success=self._ends_on_success)
        return super().describe() | {"robosuite": version("robosuite"), "protocol": played}

    def _sim_state(self, raw: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """The positions and orientations of objects, and the place where one belongs."""
        env, found = self._alive(), super()._sim_state(raw)
        if hasattr(env, "target_bin_placements"):
            found["target_pos"] = np.array(env.target_bin_placements[env.object_id], np.float64)
        elif hasattr(env, "peg1_body_id"):
            found["target_pos"] = np.array(env.sim.data.body_xpos[env.peg1_body_id], np.float64)
        return found


def _controllers(simulator: Any) -> Any:
    """Return OSC_POSE with robosuite's own settings, which are robomimic's."""
    if hasattr(simulator, "load_composite_controller_config"):  # 1.5
        return simulator.load_composite_controller_config(robot="Panda")
    return simulator.load_controller_config(default_controller="OSC_POSE")
