"""A task of robosuite as an environment for evaluations."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.envs.base import EvalEnv, one_row, require_known
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.envs.rendering.render_probe import failing, without, without_egl
from vlagents_ray.envs.robosuite.importing import importing_robosuite
from vlagents_ray.envs.robosuite.simulation import CameraRenderer, seeded
from vlagents_ray.envs.robosuite.tasks import CONTROL_HZ, TASKS, contract
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import HIGH_RES, Act, Obs
from vlagents_ray.registry import require

_CURE = (
    "run `vlagents-ray env make requirements/robosuite.txt` and give the evaluation's workers that environment's Python"
)
_OPEN_M = 0.04  # a finger's travel from closed to open


class Robosuite(EvalEnv):
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
        self._name, self._task = f"robosuite/{task}", TASKS[task]
        for name, value in (("width", width), ("height", height), ("max_steps", max_steps)):
            if value is not None and value < 1:
                raise ConfigError(f"{self._name}: {name} is {value}, want at least 1")
        record = record_size_of(record_size, self._name)
        self._contract = self.known_contract({"task": task, "width": width, "height": height, "cameras": cameras})
        self.max_steps = max_steps or self._task.max_steps
        self._instruction = instruction or self._task.instruction
        self._ends_on_success = ends_on_success
        self._steps: int | None = None
        self._env: Any = None
        prepare_rendering()
        with importing_robosuite("robosuite"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # warnings of upstream code
            simulator = require("robosuite")
        if task not in simulator.ALL_ENVIRONMENTS:
            raise ConfigError(f"{self._name}: robosuite {simulator.__version__} has no such task, 1.5 has; {_CURE}")
        images = self._contract.cameras or {}
        with failing(self._name, "make"), seeded(0):
            self._env = simulator.make(
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
                self._env.modify_observable(f"{arm}_joint_pos", "active", modifier=True)
        self._renderer = CameraRenderer(self._env, record)

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

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32; there are no options."""
        if options:
            raise ConfigError(f"{self._name}: unknown reset options {sorted(options)}, want none")
        env, seed = self._alive(), seed % 2**32
        with failing(self._name, "reset"), seeded(seed):
            if hasattr(env, "rng"):  # robosuite 1.5 has a generator of its own, which its parts share
                env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
            self._renderer.make_current()  # the last episode's rendering resources are freed in their own context
            self._renderer.open = True
            raw = env.reset()
        self._steps = 0
        return self._observe(raw), {"success": False}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute an action; the reward is 1 if the task is solved, else 0."""
        env = self._alive()
        if self._steps is None:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract)
        with failing(self._name, "step"):
            self._renderer.open = self.looked_at
            raw, *_ = env.step(action.astype(np.float64))
            success = bool(env._check_success())
        self._steps += 1
        obs = self._observe(raw, look=self.looked_at)
        ended = success and self._ends_on_success
        return obs, float(success), ended, self._steps >= self.max_steps, {"success": success}

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
        return {
            "simulator": "robosuite",
            "task": self._name.partition("/")[2],
            "robosuite": version("robosuite"),
            "mujoco": version("mujoco"),
            "control_mode": "OSC_POSE",
            "render_backend": os.environ.get("MUJOCO_GL", "glfw"),
            "protocol": self._task.protocol.describe(max_steps=self.max_steps, ends_on_success=self._ends_on_success),
        }

    def close(self) -> None:
        env, self._env, self._steps = self._env, None, None
        if env is not None:
            self._renderer.make_current()
            env.close()

    def _observe(self, raw: Mapping[str, Any], *, look: bool = True) -> Obs:
        cameras = list(self._contract.cameras or {}) if look else []
        info: dict[str, Any] = {"sim_state": self._sim_state(raw)}
        if look and self._renderer.views:
            info[HIGH_RES] = {name: _upright(self._renderer.views[name]) for name in cameras}
        fingers = float(raw["robot0_gripper_qpos"][0])
        return Obs(
            cameras={name: _upright(raw[f"{name}_image"]) for name in cameras},
            gripper=min(max(fingers / _OPEN_M, 0.0), 1.0) if self._contract.gripper else None,
            state={name: np.asarray(raw[name], np.float32) for name in self._contract.state or {}},
            info=info,
        )

    def _sim_state(self, raw: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """The positions and orientations of objects in robosuite's observation, and the place where one belongs."""
        env = self._alive()
        found = {
            name: np.asarray(value, np.float64)
            for name, value in raw.items()
            if name.endswith(("_pos", "_quat")) and not {"robot0", "robot1", "to"} & set(name.split("_"))
        }
        if hasattr(env, "target_bin_placements"):
            found["target_pos"] = np.array(env.target_bin_placements[env.object_id], np.float64)
        elif hasattr(env, "peg1_body_id"):
            found["target_pos"] = np.array(env.sim.data.body_xpos[env.peg1_body_id], np.float64)
        return found

    def _alive(self) -> Any:
        if self._env is None:
            raise EnvFailed(f"{self._name} is closed; make a new one")
        return self._env


def _controllers(simulator: Any) -> Any:
    """Return OSC_POSE with robosuite's own settings, which are robomimic's."""
    if hasattr(simulator, "load_composite_controller_config"):  # 1.5
        return simulator.load_composite_controller_config(robot="Panda")
    return simulator.load_controller_config(default_controller="OSC_POSE")


def _upright(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1])
