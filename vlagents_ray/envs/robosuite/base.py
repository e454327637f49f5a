"""What environments in robosuite's simulator share: episodes, seeds, cameras, and the opening of the gripper."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.envs.base import EvalEnv, one_row
from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.envs.rendering.render_probe import failing
from vlagents_ray.envs.robosuite.simulation import CameraRenderer, seeded
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import HIGH_RES, Act, Obs

_OPEN_M = 0.04  # a finger's travel from closed to open


class RobosuiteEnv(EvalEnv):
    """One environment of robosuite's; a subclass makes the simulator and hands it to `_use`.

    `info["sim_state"]`, for scripted experts only, has the positions and quaternions xyzw of objects.
    """

    _raw: Mapping[str, str] = {}
    """What robosuite calls parts of the contract's state, of those that it calls otherwise."""

    def __init__(
        self,
        name: str,
        *,
        protocol: BenchmarkProtocol,
        width: int | None,
        height: int | None,
        max_steps: int | None,
        ends_on_success: bool,
        record_size: Sequence[int] | None,
    ) -> None:
        self._name, self._protocol, self._ends_on_success = name, protocol, ends_on_success
        for option, value in (("width", width), ("height", height), ("max_steps", max_steps)):
            if value is not None and value < 1:
                raise ConfigError(f"{name}: {option} is {value}, want at least 1")
        self._record_size = record_size_of(record_size, name)
        self.max_steps = max_steps or protocol.max_steps
        self._steps: int | None = None
        self._env: Any = None
        prepare_rendering()

    def _use(self, simulator: Any) -> None:
        self._env = simulator
        self._renderer = CameraRenderer(simulator, self._record_size)

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
        action = self._command(one_row(act, self.contract).astype(np.float64))
        with failing(self._name, "step"):
            self._renderer.open = self.looked_at
            raw, *_ = env.step(action)
            success = bool(env._check_success())
        self._steps += 1
        obs = self._observe(raw, look=self.looked_at)
        ended = success and self._ends_on_success
        return obs, float(success), ended, self._steps >= self.max_steps, {"success": success}

    def describe(self) -> dict[str, Any]:
        simulator, _, task = self._name.partition("/")
        return {
            "simulator": simulator,
            "task": task,
            "mujoco": version("mujoco"),
            "control_mode": "OSC_POSE",
            "render_backend": os.environ.get("MUJOCO_GL", "glfw"),
        }

    def close(self) -> None:
        env, self._env, self._steps = self._env, None, None
        if env is not None:
            self._renderer.make_current()
            env.close()

    def _command(self, action: np.ndarray) -> np.ndarray:
        """Turn an action of the contract into robosuite's."""
        return action

    def _sim_state(self, raw: Mapping[str, Any]) -> dict[str, np.ndarray]:
        return {
            name: np.asarray(value, np.float64)
            for name, value in raw.items()
            if name.endswith(("_pos", "_quat")) and not {"robot0", "robot1", "to"} & set(name.split("_"))
        }

    def _observe(self, raw: Mapping[str, Any], *, look: bool = True) -> Obs:
        contract = self.contract
        cameras = list(contract.cameras or {}) if look else []
        info: dict[str, Any] = {"sim_state": self._sim_state(raw)}
        if look and self._renderer.views:
            info[HIGH_RES] = {name: _upright(self._renderer.views[name]) for name in cameras}
        fingers = float(raw["robot0_gripper_qpos"][0])
        return Obs(
            cameras={name: _upright(raw[f"{name}_image"]) for name in cameras},
            gripper=min(max(fingers / _OPEN_M, 0.0), 1.0) if contract.gripper else None,
            state={name: np.asarray(raw[self._raw.get(name, name)], np.float32) for name in contract.state or {}},
            info=info,
        )

    def _alive(self) -> Any:
        if self._env is None:
            raise EnvFailed(f"{self._name} is closed; make a new one")
        return self._env


def _upright(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1])
