"""A ManiSkill task as an environment for evaluations."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, check_action
from vlagents_ray.envs.base import EvalEnv
from vlagents_ray.envs.maniskill import making
from vlagents_ray.envs.maniskill.robot import Robot, action_spec
from vlagents_ray.envs.maniskill.tasks import INSTRUCTIONS, instruction_for
from vlagents_ray.envs.probe import render_probe, vulkan_device_name
from vlagents_ray.errors import ConfigError, EnvFailed, InvalidAction, NotReset
from vlagents_ray.interface import Act, Obs


class ManiSkill(EvalEnv):
    """One environment of one ManiSkill task.

    Observation: the task's cameras; in `state` the arm's `joints` (without the fingers), `tquat` and
    `xyzrpy`, the pose of the tool centre point in the robot's base frame; `gripper`; and in
    `info["sim_state"]`, (D,) float32, ManiSkill's flat state observation, which knows where the
    objects are: for scripted experts only. Some goals, such as PickCube's, are hidden from cameras.

    Action, in the default control mode `pd_ee_delta_pose`: (7,) in [-1, 1], of which the first three
    move the tool by 0.1 m a unit along the base's axes; the next three turn it about the base's axes
    by **minus** 0.1 rad a unit, since ManiSkill scales them by their lower bound; the last is the
    gripper, 1 open, -1 closed. A robot without gripper takes (6,). The arm lags behind its commands:
    a constant 1.0 moves it some 0.03 m a step.

    The env goes on after success, so that success once and success at the end can both be measured,
    and never reports `terminated`.
    """

    def __init__(
        self,
        task: str = "PushCube-v1",
        *,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] | None = None,
        control_mode: str | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
        sim_backend: str = "physx_cpu",
        render_backend: str = "auto",
        shader: str | None = None,
        reward_mode: str | None = None,
        reconfigure: bool = True,
    ) -> None:
        """Raises `UnknownEnv`, `ConfigError`, `MissingDependency`, or `EnvFailed` with its cure.

        Args:
            task: ManiSkill's id.
            width: of each image, pixels.
            height: of each image, pixels.
            cameras: which of the task's cameras to give; None is all.
            control_mode: None is `pd_ee_delta_pose`, or the robot's own default if it lacks that.
            instruction: None is the task's, see `instruction_for`.
            max_steps: None is the task's own limit.
            sim_backend: "physx_cpu", the faster for a single environment, or "physx_cuda".
            render_backend: "cpu", "gpu", or "auto": the GPU if both SAPIEN and torch can use it.
            shader: ManiSkill's name, e.g. "minimal", "default"; None is the task's own.
            reward_mode: ManiSkill's name; None is the task's own.
            reconfigure: rebuild the scene for each episode. Without it some tasks' dynamics
                (PlugCharger, PushT) depend on the episode before; it saves about 15 ms a reset.
        """
        own_limit = making.step_limit(task)
        limit = own_limit if max_steps is None else max_steps
        if limit is None:
            raise ConfigError(f"maniskill/{task} has no step limit of its own; set max_steps")
        for name, value in (("width", width), ("height", height), ("max_steps", limit)):
            if value < 1:
                raise ConfigError(f"maniskill/{task}: {name} is {value}, want at least 1")
        sensors = {"width": width, "height": height} | ({"shader_pack": shader} if shader else {})
        self.max_steps = limit
        self._task = task
        self._instruction = instruction
        self._rebuild = {"reconfigure": True} if reconfigure else {}
        self._steps: int | None = None
        self._env: Any = making.make(
            task,
            control_mode,
            obs_mode="rgb+state",
            reward_mode=reward_mode,
            sim_backend=sim_backend,
            render_backend=making.render_backend(render_backend),
            sensor_configs=sensors,
        )
        try:
            self._check_usable()
            self._cameras = self._choose(cameras)
            self._robot = Robot(self._env.agent)
            self._contract = self._state_contract()
        except BaseException:
            self.close()
            raise

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        if self._instruction is not None:
            return self._instruction
        own = getattr(self._env, "get_language_instruction", None)
        return str(own()[0]) if own is not None else instruction_for(self._task)

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32; `options` go to ManiSkill's own reset."""
        env = self._alive()
        with self._failing("reset"):
            raw, info = env.reset(seed=seed % 2**32, options={**(options or {}), **self._rebuild})
        self._steps = 0
        for name in set(env.scene.sensors) - set(self._cameras):
            del env.scene.sensors[name]  # rendering is most of a step: not for a camera that nobody asked for
        return self._observe(raw), {"success": bool(info["success"])}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        env = self._alive()
        if self._steps is None:
            raise NotReset(f"maniskill/{self._task}: step before reset; call reset(seed=...) first")
        action = check_action(act.action, self._contract)
        if action.ndim != 1:
            dim = self._contract.action.dim
            raise InvalidAction(f"action: got {action.shape}, want ({dim},); step through a chunk row by row")
        with self._failing("step"):
            # a copy: torch shares the memory, and warns of a read-only array, such as Ray hands out
            raw, reward, _, _, info = env.step(action.copy())
        self._steps += 1
        outcome = {"success": bool(info["success"])}
        return self._observe(raw), float(reward), False, self._steps >= self.max_steps, outcome

    @classmethod
    def tasks(cls) -> list[str]:
        return sorted(INSTRUCTIONS)

    @classmethod
    def missing(cls) -> str | None:
        """The first call in a process renders one frame in a child, which takes some seconds."""
        for module in ("mani_skill", "sapien", "gymnasium", "torch"):
            if importlib.util.find_spec(module) is None:
                return f"{module} is not installed; pip install 'vlagents-ray[maniskill]'"
        probe = render_probe()
        return None if probe.ok else f"ManiSkill finds no Vulkan device to render on ({probe.error}); {probe.cure}"

    def describe(self) -> dict[str, Any]:
        env = self._alive()
        return {
            "simulator": "maniskill",
            "task": self._task,
            "mani_skill": version("mani-skill"),
            "sapien": version("sapien"),
            "robot": env.agent.uid,
            "control_mode": env.control_mode,
            "obs_mode": env.obs_mode,
            "reward_mode": env.reward_mode,
            "sim_backend": env.backend.sim_backend,
            "render_backend": env.backend.render_backend,
            "render_device": vulkan_device_name(on_gpu=env.backend.render_device.is_cuda()),
            "shaders": {name: env.scene.sensors[name].config.shader_config.shader_pack for name in self._cameras},
            "reconfigure": bool(self._rebuild),
        }

    def close(self) -> None:
        env, self._env, self._steps = self._env, None, None
        if env is not None:
            env.close()

    def _check_usable(self) -> None:
        if not hasattr(self._env.agent, "robot"):  # none at all, or several
            raise ConfigError(f"maniskill/{self._task}: want a task with exactly one robot")
        if "success" not in self._env.get_info():
            raise ConfigError(f"maniskill/{self._task} does not say what success is: there is nothing to evaluate")

    def _choose(self, cameras: Sequence[str] | None) -> dict[str, CameraSpec]:
        seen = self._env.single_observation_space["sensor_data"]
        sizes = {name: textures["rgb"].shape[:2] for name, textures in seen.items() if "rgb" in textures.spaces}
        unknown = sorted(set(cameras or ()) - set(sizes))
        if unknown:
            raise ConfigError(f"maniskill/{self._task} has no camera {unknown}: want some of {sorted(sizes)}")
        chosen = sizes if cameras is None else cameras
        return {name: CameraSpec(height=sizes[name][0], width=sizes[name][1]) for name in chosen}

    def _state_contract(self) -> Contract:
        env, robot = self._env, self._robot
        return Contract(
            cameras=self._cameras,
            state=robot.gives,
            gripper=robot.has_gripper,
            instruction=True,
            action=action_spec(env.control_mode, env.single_action_space, has_gripper=robot.has_gripper),
            control_hz=float(env.control_freq),
        )

    def _observe(self, raw: Any) -> Obs:
        state, gripper = self._robot.read(self._env.agent)
        images = raw["sensor_data"]
        return Obs(
            cameras={name: np.ascontiguousarray(images[name]["rgb"][0].cpu().numpy()) for name in self._cameras},
            gripper=gripper,
            state=state,
            info={"sim_state": raw["state"][0].cpu().numpy()},
        )

    def _alive(self) -> Any:
        if self._env is None:
            raise EnvFailed(f"maniskill/{self._task} is closed; make a new one")
        return self._env

    @contextlib.contextmanager
    def _failing(self, doing: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            raise EnvFailed(f"maniskill/{self._task} failed in {doing}: {type(error).__name__}: {error}") from error
