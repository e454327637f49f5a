"""ManiSkill 3: eleven table-top tasks without downloads, and any other task of ManiSkill.

    with ManiSkill("PushCube-v1", width=224, height=224) as env:
        obs, _ = env.reset(seed=0)
        obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(7, np.float32)))

It needs a Vulkan device, for example the software device of Mesa. `ManiSkill.missing()` reports
whether there is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import BatchEnv, Options, Steps, episodes_of, one_row
from vlagents_ray.envs.graphics import Renderer, render_probe
from vlagents_ray.envs.maniskill.simulator import INSTRUCTIONS, Simulator, step_limits
from vlagents_ray.envs.simulator import SimulatorEnv, require_sizes, without
from vlagents_ray.errors import ConfigError, NotReset
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import pip_install

ON_GPU = ("gpu", "cuda", "physx_cuda")


# Source: the section "Evaluation" of ManiSkill 3's guide to reinforcement learning.
PROTOCOL = {
    "ignore_terminations": True,  # an episode continues to the step limit after success or failure
    # The scene is rebuilt for each episode, with other objects if the task samples its objects.
    "reconfiguration_freq": 1,
    "metrics": ["success_once", "success_at_end"],
    "metric": "success_once",  # the metric with which ManiSkill's baselines are compared
    # Each episode has a seed, which determines all random draws in the episode.
    "seeds": "one an environment",
}


class ManiSkill(SimulatorEnv):
    """One environment of one ManiSkill task.

    Observation: the task's cameras. `state` contains the arm's `joints` (without the fingers), and
    `tquat` and `xyzrpy`, the pose of the tool centre point in the robot's base frame. `gripper` is
    its opening. `info["sim_state"]`, (D,) float32, is ManiSkill's flat state observation, which
    includes the positions of objects; only scripted experts should use it. Cameras do not show some
    goals, such as the goal of PickCube.

    Action, in the default control mode `pd_ee_delta_pose`: (7,) in [-1, 1], or (6,) for a robot
    without a gripper.

    - The first three values move the tool along the base's axes, by 0.1 m per unit.
    - The next three values rotate the tool about the base's axes, by **minus** 0.1 rad per unit,
      since ManiSkill scales them by their lower bound.
    - The last value is the gripper: 1 is open, -1 is closed.

    The arm lags behind its commands: a constant 1.0 moves it by about 0.03 m per step.

    The env continues after success, so that both success once and success at the end can be
    measured. The env never reports `terminated`.
    """

    suite, known = "maniskill", tuple(INSTRUCTIONS)

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
        """Create the environment; raises the errors of `make_env`. The other options are described
        in `SimulatorEnv`.

        Args:
            task: ManiSkill's id of the task.
            cameras: The cameras of the task to return; None selects all of them.
            control_mode: ManiSkill's name; None selects `pd_ee_delta_pose`, or the robot's default
                if the robot lacks that mode.
            instruction: The task in words; None selects the instruction of the task, see
                `instruction_for`.
            sim_backend: "physx_cpu", which is faster for a single environment, or "physx_cuda".
            render_backend: "cpu", "gpu", or "auto": the GPU if both SAPIEN and torch can use it.
            shader: ManiSkill's name, e.g. "minimal", "default"; None selects the task's shader.
            reward_mode: ManiSkill's name; None selects the task's mode.
            reconfigure: Whether to rebuild the scene for each episode. If False, a reset is about
                15 ms faster, but the dynamics of some tasks (PlugCharger, PushT) depend on the
                previous episode.
        """
        super().__init__(task)
        self.max_steps, self._task_limit = step_limits(self._name, task, max_steps)
        self._chosen_instruction = instruction
        self._reconfigure = reconfigure
        self._env = _simulator(
            task,
            width=width,
            height=height,
            shader=shader,
            cameras=cameras,
            sim_backend=sim_backend,
            render_backend=render_backend,
            control_mode=control_mode,
            reward_mode=reward_mode,
        )
        self._resources.callback(self._env.close)
        self._contract = self._env.contract()

    @property
    def instruction(self) -> str:
        """The instruction passed to the constructor, or else the task's instruction."""
        if self._chosen_instruction is not None:
            return self._chosen_instruction
        instructions: list[str] = self._alive().instructions()
        return instructions[0]

    def reset(self, *, seed: int, options: Options | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: The seed, taken modulo 2^32.
            options: The options of ManiSkill's reset.

        Returns:
            The first observation, and the info of the environment.
        """
        self._options = options or {}
        return super().reset(seed=seed)

    @classmethod
    def require_task(cls, task: str | None) -> None:
        """Accept every name, since only ManiSkill knows the registered ids."""

    @classmethod
    def not_installed(cls) -> str | None:
        return without(("mani_skill", "sapien", "gymnasium", "torch"), pip_install("maniskill"))

    @classmethod
    def missing(cls) -> str | None:
        """Return the reason why ManiSkill cannot run here, with the cure; None if it can run.

        The first call in a process renders one frame in a child process.
        """
        missing = cls.not_installed()
        if missing is not None:
            return missing

        probe = render_probe()
        if probe.ok:
            return None
        return f"ManiSkill finds no Vulkan device to render on ({probe.error}); {probe.cure}"

    @classmethod
    def batched(cls, num_envs: int, **options: Any) -> BatchEnv | None:
        """Create all environments in one simulator, if the simulator runs on a GPU."""
        if options.get("sim_backend") not in ON_GPU:
            return None
        return ManiSkillBatch(num_envs=num_envs, **options)

    def renderer(self) -> Renderer | None:
        renderer: Renderer | None = self._alive().renderer()
        return renderer

    def describe(self) -> dict[str, Any]:
        return _described(self._alive(), self._reconfigure, self.max_steps, self._task_limit)

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        options = dict(self._options)
        if self._reconfigure:
            options["reconfigure"] = True
        moment = self._env.reset([seed], options)
        return moment.obs[0], {"success": moment.success[0]}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        moment = self._env.step(action[np.newaxis], look=self.looked_at)
        return moment.obs[0], moment.rewards[0], False, {"success": moment.success[0]}


class ManiSkillBatch(BatchEnv):
    """Several environments of one ManiSkill task in one simulator.

    Observations and actions are as in `ManiSkill`. Physics on the GPU and on the CPU are not
    bit-identical: do not mix their results.
    """

    def __init__(
        self,
        task: str = "PushCube-v1",
        *,
        num_envs: int,
        instruction: str | None = None,
        max_steps: int | None = None,
        sim_backend: str = "physx_cuda",
        reconfigure: bool = True,
        **options: Any,
    ) -> None:
        """Create the environments; raises the errors of `ManiSkill`.

        Args:
            task: ManiSkill's id of the task.
            num_envs: The number of environments.
            instruction: As in `ManiSkill`.
            max_steps: As in `ManiSkill`.
            sim_backend: "physx_cuda", or "physx_cpu", which simulates a single environment.
            reconfigure: As in `ManiSkill`.
            options: Further options of `ManiSkill`.
        """
        if sim_backend not in ON_GPU and num_envs > 1:
            raise ConfigError(
                f"maniskill/{task}: expected num_envs 1 with {sim_backend}, got {num_envs}; use "
                "physx_cuda for several environments"
            )
        self.num_envs = num_envs
        self.max_steps, self._task_limit = step_limits(f"maniskill/{task}", task, max_steps)
        self._task, self._instruction, self._reconfigure = task, instruction, reconfigure
        self._playing = self._steps = 0
        self._simulator = _simulator(task, num_envs=num_envs, sim_backend=sim_backend, **options)
        self._contract = self._simulator.contract()

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instructions(self) -> list[str]:
        """The instruction passed to the constructor, or else the tasks' instructions."""
        if self._instruction is not None:
            return [self._instruction] * self._playing
        return self._simulator.instructions()[: self._playing]

    def reset(
        self, *, seeds: Sequence[int], options: Sequence[Options | None] | None = None
    ) -> list[Obs]:
        """Begin an episode for each seed.

        Args:
            seeds: The seeds, taken modulo 2^32.
            options: The options of ManiSkill's reset for each episode.

        Returns:
            The first observation of each episode.
        """
        self._playing, self._steps = episodes_of(seeds, self.num_envs), 0
        if not options:
            options = [None] * self._playing

        # Idle environments also begin an episode, whose results are not used.
        idle = self.num_envs - self._playing
        all_seeds = [*seeds, *[seeds[-1]] * idle]
        all_options: list[Options] = [env_options or {} for env_options in options]
        all_options += [{}] * idle
        if self._reconfigure:
            self._simulator.reset(all_seeds, {"reconfigure": True})
        return self._simulator.reset_each(all_seeds, all_options).obs[: self._playing]

    def step(self, acts: Sequence[Act | None]) -> Steps:
        """Execute an action in each episode, with one step of the simulator."""
        if not self._playing:
            raise NotReset(
                f"maniskill/{self._task}: step was called before reset; call reset(seeds=...) first"
            )
        actions = np.zeros((self.num_envs, self._contract.action.dim or 0), np.float32)
        for i, act in enumerate(acts):
            if act is not None:
                actions[i] = one_row(act, self._contract)

        moment = self._simulator.step(actions, look=self.looked_at)
        self._steps += 1
        count = self._playing
        is_truncated = self._steps >= self.max_steps
        infos = [{"success": success} for success in moment.success[:count]]
        terminated, truncated = [False] * count, [is_truncated] * count
        return moment.obs[:count], moment.rewards[:count], terminated, truncated, infos

    def renderer(self) -> Renderer | None:
        return self._simulator.renderer()

    def describe(self) -> dict[str, Any]:
        return _described(self._simulator, self._reconfigure, self.max_steps, self._task_limit)

    def close(self) -> None:
        self._playing = 0
        self._simulator.close()


def _simulator(
    task: str, *, width: int = 224, height: int = 224, shader: str | None = None, **options: Any
) -> Simulator:
    """Create the simulator of a task, with images of `size`, px."""
    name = f"maniskill/{task}"
    require_sizes(name, width=width, height=height)
    sensors: dict[str, Any] = {"width": width, "height": height}
    if shader:
        sensors["shader_pack"] = shader
    return Simulator(name, task, obs_mode="rgb+state", sensors=sensors, **options)


def _described(
    simulator: Simulator, reconfigure: bool, max_steps: int, task_limit: int | None
) -> dict[str, Any]:
    """Return the description for `describe`, with the deviations from the protocol."""
    deviations = []
    if not reconfigure:
        deviations.append("reconfigure is False: scenes are reused in later episodes")
    if max_steps != task_limit:
        deviations.append(f"max_steps is {max_steps}, the task's limit is {task_limit}")
    return simulator.describe() | {
        "reconfigure": reconfigure,
        "protocol": {**PROTOCOL, "deviations": deviations},
    }
