"""A ManiSkill task as an environment for evaluations."""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import BatchEnv, EvalEnv, one_row
from vlagents_ray.envs.maniskill import benchmark_protocol, factory
from vlagents_ray.envs.maniskill.simulator import Simulator
from vlagents_ray.envs.maniskill.tasks import INSTRUCTIONS
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.envs.rendering.graphics import Renderer
from vlagents_ray.envs.rendering.render_probe import render_probe
from vlagents_ray.errors import NotReset
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

    The env continues after success, so that success once and success at the end can both be measured,
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
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: ManiSkill's id.
            width: Of each image, pixels.
            height: Of each image, pixels.
            cameras: Which of the task's cameras to give; None is all.
            control_mode: None is `pd_ee_delta_pose`, or the robot's own default if it lacks that.
            instruction: None is the task's, see `instruction_for`.
            max_steps: None is the task's own limit.
            sim_backend: "physx_cpu", the faster for a single environment, or "physx_cuda".
            render_backend: "cpu", "gpu", or "auto": the GPU if both SAPIEN and torch can use it.
            shader: ManiSkill's name, e.g. "minimal", "default"; None is the task's own.
            reward_mode: ManiSkill's name; None is the task's own.
            reconfigure: Rebuild the scene for each episode. Without it some tasks' dynamics
                (PlugCharger, PushT) depend on the episode before; it saves about 15 ms a reset.
            record_size: Height and width of further views by the same cameras, for the record only.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator or its assets cannot be loaded.
        """
        self._own_limit = factory.registered_limit(task)
        self.max_steps = factory.step_limit(f"maniskill/{task}", max_steps, self._own_limit)
        self._task = task
        self._instruction = instruction
        self._rebuild = {"reconfigure": True} if reconfigure else {}
        self._steps: int | None = None
        self._simulator = Simulator(
            f"maniskill/{task}",
            task,
            obs_mode="rgb+state",
            cameras=cameras,
            record_size=record_size_of(record_size, f"maniskill/{task}"),
            sim_backend=sim_backend,
            render_backend=render_backend,
            control_mode=control_mode,
            reward_mode=reward_mode,
            sensors=factory.sensor_settings(f"maniskill/{task}", width, height, shader),
        )
        self._contract = self._simulator.contract(self._simulator.action)

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._simulator.instructions()[0] if self._instruction is None else self._instruction

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32; `options` go to ManiSkill's own reset."""
        now = self._simulator.reset([seed], {**(options or {}), **self._rebuild})
        self._steps = 0
        return now.obs[0], {"success": now.success[0]}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        if self._steps is None:
            raise NotReset(f"maniskill/{self._task}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract)
        now = self._simulator.step(action[np.newaxis], look=self.looked_at)
        self._steps += 1
        outcome = {"success": now.success[0]}
        return now.obs[0], now.rewards[0], False, self._steps >= self.max_steps, outcome

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

    @classmethod
    def batched(cls, num_envs: int, **options: Any) -> BatchEnv | None:
        """Make all environments in one simulator, if it runs on a GPU."""
        from vlagents_ray.envs.maniskill.batch import ON_GPU, ManiSkillBatch

        if options.get("sim_backend") not in ON_GPU:
            return None
        return ManiSkillBatch(num_envs=num_envs, **options)

    def renderer(self) -> Renderer | None:
        return self._simulator.renderer()

    def describe(self) -> dict[str, Any]:
        reconfigure = bool(self._rebuild)
        rules = benchmark_protocol.described(
            reconfigure=reconfigure, max_steps=self.max_steps, own_limit=self._own_limit
        )
        return {**self._simulator.describe(), "reconfigure": reconfigure, "protocol": rules}

    def close(self) -> None:
        self._steps = None
        self._simulator.close()
