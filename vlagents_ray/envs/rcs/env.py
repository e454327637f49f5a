"""A task of RCS or DuoBench as an environment for evaluations."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any, ClassVar

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract
from vlagents_ray.envs.base import EvalEnv, one_row, require_known
from vlagents_ray.envs.mapping import plain
from vlagents_ray.envs.rcs import factory
from vlagents_ray.envs.rcs.arms import Arms
from vlagents_ray.envs.rcs.tasks import DUOBENCH_TASKS, RCS_TASKS, ControlMode, RcsTask
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import HIGH_RES, Act, Obs
from vlagents_ray.registry import require


class Rcs(EvalEnv):
    """One environment of one task: "pick", or the id of any scene with a task that RCS has registered.

    Observation: the scene's cameras; of each arm `joints` rad, `tquat` and `xyzrpy`, the tool's pose
    in the frame that all arms share; the gripper, 1 = open: see `Arms` for the names with several.
    `info["objects"]` is {joint: (7,) float64}, the pose of each loose body in the world's frame, metres
    and quaternion wxyz: for scripted experts only.

    Action: for each arm its command in `control_mode`, then its gripper, which closes at 0.5 and below.

    Success is the simulator's, and ends the episode. The seed places the objects.
    """

    suite: ClassVar[str] = "rcs"
    known: ClassVar[Mapping[str, RcsTask]] = RCS_TASKS
    packages: ClassVar[tuple[str, ...]] = ("rcs",)

    def __init__(
        self,
        task: str | None = None,
        *,
        module: str | None = None,
        control_mode: ControlMode | None = None,
        delta: bool = False,
        control_hz: float | None = None,
        binary_gripper: bool = True,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] | None = None,
        record_size: Sequence[int] | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: One of `tasks()`, or Gymnasium's id of a scene, "lab/shelf"; None is the first of `tasks()`.
            module: Imported first, because it registers the id; by default the id's namespace.
            control_mode: "joints", "tquat" or "xyzrpy"; None is the protocol's.
            delta: Commands are relative to where the arm is.
            control_hz: Steps a second; None is the protocol's.
            binary_gripper: It opens or closes; False: the command is its opening.
            width: Of each image, pixels.
            height: Of each image, pixels.
            cameras: Which of the scene's to give; None is all.
            record_size: (height, width) in pixels of a second view of each camera, for the record alone.
            instruction: None is the task's.
            max_steps: None is the protocol's limit.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator or its assets cannot be loaded.
        """
        task = self.tasks()[0] if task is None else task
        self._name = f"{self.suite}/{task}"
        self._task = self._find(task, module)
        protocol = self._task.protocol
        limit = protocol.max_steps if max_steps is None and protocol is not None else max_steps
        if limit is None:
            raise ConfigError(f"{self._name} has no step limit of its own; set max_steps")
        sizes = {"width": width, "height": height, "max_steps": limit}
        for name, value in sizes.items():
            if value < 1:
                raise ConfigError(f"{self._name}: {name} is {value}, want at least 1")
        self.max_steps = limit
        self._mode = control_mode or self._task.control_mode
        self._given_instruction = instruction
        self._instruction = ""
        record = record_size_of(record_size, self._name)
        self._recording = record is not None
        self._steps: int | None = None
        self._env: Any = None
        hz = control_hz or self._task.control_hz
        maker = factory.creator(self._task, self._name)
        config = maker.config()
        self._task.prepare(config)
        factory.configure(
            config,
            control_mode=self._mode,
            delta=delta,
            control_hz=hz,
            binary_gripper=binary_gripper,
            size=(height, width),
            cameras=cameras,
            record_size=record,
        )
        with self._failing("make"):
            self._env = maker.create_env(config)
            self._sim = self._env.get_wrapper_attr("sim")
            self._loose = _loose_joints(self._sim.model)
            self._arms = Arms(self._env.action_space, self._env.observation_space, self._mode)
        self._contract = Contract(
            cameras={name: CameraSpec(height, width) for name in config.camera_cfgs or () if not _for_the_record(name)},
            state=self._arms.state,
            gripper=self._arms.has_gripper,
            instruction=True,
            action=self._arms.action_spec(delta=delta),
            control_hz=hz,
        )

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._given_instruction or self._instruction or self._task.instruction

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32; there are no options."""
        if options:
            raise ConfigError(f"{self._name}: unknown reset options {sorted(options)}, want none")
        env = self._alive()
        with self._failing("reset"):
            raw, info = env.reset(seed=seed % 2**32)
        self._steps = 0
        self._instruction = str(info.get("instruction", ""))
        if not self.instruction:
            raise ConfigError(f"{self._name} states no instruction; set the option `instruction`")
        return self._observe(raw), {"success": bool(info.get("success", False))}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        env = self._alive()
        if self._steps is None:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract)
        with self._failing("step"):
            raw, reward, terminated, _, info = env.step(self._arms.command(action))
        if "success" not in info:
            raise ConfigError(f"{self._name} does not say what success is: want a scene with a task")
        self._steps += 1
        task_info = {key: value for key, value in info.items() if key not in self._arms.names}  # without that of arms
        outcome = {**plain(task_info), "success": bool(info["success"])}
        return self._observe(raw), float(reward), bool(terminated), self._steps >= self.max_steps, outcome

    @classmethod
    def require_task(cls, task: str | None) -> None:
        if "/" not in (task or ""):
            require_known(cls.suite, task, cls.tasks(), ", or an id, as in 'lab/shelf'")

    @classmethod
    def tasks(cls) -> list[str]:
        return sorted(cls.known)

    @classmethod
    def missing(cls) -> str | None:
        return factory.missing(*cls.packages)

    def describe(self) -> dict[str, Any]:
        control = f"{self._mode}, delta" if self._contract.action.delta else self._mode
        played = {"max_steps": self.max_steps, "control_hz": self._contract.control_hz, "control": control}
        protocol = self._task.protocol
        return {
            "simulator": "rcs",
            "task": self._task.id,
            **{name: version(name) for name in ("rcs-core", *self.packages[1:], "mujoco")},
            "robots": {name: robot.get_config().robot_type.id for name, robot in self._robots().items()},
            "protocol": protocol.describe(**played) if protocol is not None else played,
        }

    def close(self) -> None:
        env, self._env, self._steps = self._env, None, None
        if env is not None:
            env.close()

    def _find(self, task: str, module: str | None) -> RcsTask:
        if task in self.known:
            found = self.known[task]
            return replace(found, module=module) if module is not None else found
        self.require_task(task)
        return RcsTask(id=task, module=module)

    def _observe(self, raw: Mapping[str, Any]) -> Obs:
        state, gripper = self._arms.read(raw)
        images = {name: frame["rgb"]["data"] for name, frame in raw.get("frames", {}).items()}
        info: dict[str, Any] = {"objects": {name: np.array(self._sim.data.joint(name).qpos) for name in self._loose}}
        if self._recording:
            info[HIGH_RES] = {
                name.removeprefix(factory.RECORD): np.ascontiguousarray(image)
                for name, image in images.items()
                if _for_the_record(name)
            }
        return Obs(
            cameras={name: np.ascontiguousarray(image) for name, image in images.items() if not _for_the_record(name)},
            gripper=gripper,
            state=state,
            info=info,
        )

    def _robots(self) -> dict[str, Any]:
        robots: dict[str, Any] = self._alive().get_wrapper_attr("robot")
        return robots

    def _alive(self) -> Any:
        if self._env is None:
            raise EnvFailed(f"{self._name} is closed; make a new one")
        return self._env

    @contextlib.contextmanager
    def _failing(self, doing: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            raise EnvFailed(f"{self._name} failed in {doing}: {type(error).__name__}: {error}") from error


class DuoBench(Rcs):
    """DuoBench's eleven tasks of two FR3 arms, "left" and "right", named without "duobench/".

    An action has 16 numbers: the left arm's seven joints, rad, its gripper, then the right arm's. The
    reward is the share of the task's stages reached; a step's info has `stage` and `max_stage`.
    """

    suite: ClassVar[str] = "duobench"
    known: ClassVar[Mapping[str, RcsTask]] = DUOBENCH_TASKS
    packages: ClassVar[tuple[str, ...]] = ("rcs", "duobench")


def _loose_joints(model: Any) -> list[str]:
    free = int(require("mujoco").mjtJoint.mjJNT_FREE)
    return [model.joint(i).name for i in range(model.njnt) if model.jnt_type[i] == free]


def _for_the_record(camera: str) -> bool:
    return camera.startswith(factory.RECORD)
