"""Many environments of one ManiSkill task in one simulator, on a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import one_row
from vlagents_ray.envs.batch import BatchEnv, Options, Steps, episodes_of
from vlagents_ray.envs.maniskill import benchmark_protocol, factory
from vlagents_ray.envs.maniskill.simulator import Simulator
from vlagents_ray.envs.rendering.graphics import Renderer
from vlagents_ray.errors import ConfigError, NotReset
from vlagents_ray.interface import Act, Obs

ON_GPU = ("gpu", "cuda", "physx_cuda")


class ManiSkillBatch(BatchEnv):
    """`num_envs` environments of one ManiSkill task; observations and actions are those of `ManiSkill`.

    Physics on the GPU is not that on the CPU to the bit: results of the two do not mix.
    """

    def __init__(
        self,
        task: str = "PushCube-v1",
        *,
        num_envs: int,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] | None = None,
        control_mode: str | None = None,
        instruction: str | None = None,
        max_steps: int | None = None,
        sim_backend: str = "physx_cuda",
        render_backend: str = "auto",
        shader: str | None = None,
        reward_mode: str | None = None,
        reconfigure: bool = True,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environments with the options of `ManiSkill`, whose errors this raises.

        `sim_backend` "physx_cpu" simulates a single environment, and `record_size` must be None.
        """
        if record_size is not None:
            raise ConfigError(f"maniskill/{task}: record_size is for single environments; leave it out")
        if sim_backend not in ON_GPU and num_envs > 1:
            raise ConfigError(
                f"maniskill/{task}: {sim_backend} simulates one environment, not {num_envs}; want physx_cuda"
            )
        self._own_limit = factory.registered_limit(task)
        self.num_envs = num_envs
        self.max_steps = factory.step_limit(f"maniskill/{task}", max_steps, self._own_limit)
        self._task = task
        self._instruction = instruction
        self._reconfigure = reconfigure
        self._playing = self._steps = 0
        self._simulator = Simulator(
            f"maniskill/{task}",
            task,
            num_envs=num_envs,
            obs_mode="rgb+state",
            cameras=cameras,
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
    def instructions(self) -> list[str]:
        own = self._simulator.instructions() if self._instruction is None else [self._instruction] * self.num_envs
        return own[: self._playing]

    def reset(self, *, seeds: Sequence[int], options: Sequence[Options | None] | None = None) -> list[Obs]:
        """Begin the episodes of `seeds`, taken modulo 2^32; the options go to ManiSkill's own reset."""
        self._playing, self._steps = episodes_of(seeds, self.num_envs), 0
        spare = self.num_envs - self._playing
        every = [*seeds, *[seeds[-1]] * spare]
        given: list[Options] = [*(option or {} for option in options or [{}] * self._playing), *[{}] * spare]
        if self._reconfigure:
            self._simulator.reset(every, {"reconfigure": True})
        return self._simulator.reset_each(every, given).obs[: self._playing]

    def step(self, acts: Sequence[Act | None]) -> Steps:
        if not self._playing:
            raise NotReset(f"maniskill/{self._task}: step before reset; call reset(seeds=...) first")
        actions = np.zeros((self.num_envs, self._contract.action.dim or 0), np.float32)
        for i, act in enumerate(acts):
            if act is not None:
                actions[i] = one_row(act, self._contract)
        now = self._simulator.step(actions, look=self.looked_at)
        self._steps += 1
        n = self._playing
        over = self._steps >= self.max_steps
        infos = [{"success": success} for success in now.success[:n]]
        return now.obs[:n], now.rewards[:n], [False] * n, [over] * n, infos

    def renderer(self) -> Renderer | None:
        return self._simulator.renderer()

    def describe(self) -> dict[str, Any]:
        rules = benchmark_protocol.described(
            reconfigure=self._reconfigure, max_steps=self.max_steps, own_limit=self._own_limit
        )
        return {**self._simulator.describe(), "reconfigure": self._reconfigure, "protocol": rules}

    def close(self) -> None:
        self._playing = 0
        self._simulator.close()
