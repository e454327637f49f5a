"""A LIBERO task as an environment for evaluations."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import EvalEnv, one_row
from vlagents_ray.envs.libero import assets as asset_files
from vlagents_ray.envs.libero import robot, variants
from vlagents_ray.envs.libero.benchmark_protocol import LiberoProtocol
from vlagents_ray.envs.libero.simulation import LiberoSimulation, SimulatorObs
from vlagents_ray.envs.libero.tasks import find_task, read_states, require_suite, task_names
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.envs.rendering.render_probe import failing, without, without_egl
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import HIGH_RES, Act, Obs


class Libero(EvalEnv):
    """One environment of one LIBERO task, e.g. "libero_spatial/0", or of one that varies it, "libero_goal_swap/0".

    Observation: cameras "front" (LIBERO's agentview) and "wrist" (its eye in hand), turned as policies
    expect it, see `LiberoProtocol`; in `state` what policies for LIBERO take: `xyz_axis_angle` (6,), the end
    effector in the world's frame, whose axes are the robot base's, m and rad, the angle in [0, 2 pi] as
    robosuite's quaternion gives it; `gripper_qpos` (2,) m, of the fingers; and `joints` (7,) rad. In
    `info["sim_state"]`, for scripted experts only: `positions` of objects (3,) m in the world's frame, and
    the `goal`.

    Action: (7,) in [-1, 1]: the end effector's target moves by 0.05 m a unit along the base's axes, and
    turns by 0.5 rad a unit about them, axis-angle; the last is the gripper, -1 opens, 1 closes, and only
    its sign counts.

    An episode is a pure function of its initial state, `options["init_state"]`; where that is not given,
    the seed chooses it, and otherwise the seed is the policy's alone.
    """

    def __init__(
        self,
        task: str = "libero_spatial/0",
        *,
        width: int = 256,
        height: int = 256,
        record_size: Sequence[int] | None = None,
        max_steps: int | None = None,
        settling_steps: int | None = None,
        simulator_seed: int | None = None,
        stop_at_success: bool = True,
        gripper_open: float | None = None,
        gripper_closed: float | None = None,
        instruction: str | None = None,
        assets: str | None = None,
        files: str | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: "SUITE/NUMBER", or "SUITE/NAME" with LIBERO's name.
            width: Width of each image, pixels.
            height: Height of each image, pixels.
            record_size: (height, width) of further views of each camera, for recordings only.
            max_steps: None is the protocol's for the suite.
            settling_steps: None is the protocol's.
            simulator_seed: Seed of whatever an initial state leaves open; None is the protocol's.
            stop_at_success: Report `terminated` when the task is solved.
            gripper_open: The action's last number that opens the gripper; None is LIBERO's -1. OpenVLA
                says 1, and 0 to close, which openvla's evaluation turns into LIBERO's as this does.
            gripper_closed: The one that closes it; None is LIBERO's 1.
            instruction: None is the task's own.
            assets: The folder with LIBERO's meshes and textures; None is what LIBERO_ASSETS names.
            files: The folder with `bddl_files` and `init_files` of suites that vary LIBERO's, such as LIBERO-PRO's;
                None is what LIBERO_FILES names.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator or its assets cannot be loaded.
        """
        for name, value in (("width", width), ("height", height), ("max_steps", max_steps)):
            if value is not None and value < 1:
                raise ConfigError(f"libero/{task}: {name} is {value}, want at least 1")
        record = record_size_of(record_size, f"libero/{task}")
        if (settling_steps or 0) < 0:
            raise ConfigError(f"libero/{task}: settling_steps is {settling_steps}, want 0 or more")
        self._task = find_task(task, files)
        self._assets = asset_files.find_assets(assets)
        self._protocol = LiberoProtocol.of(
            self._task.suite,
            image_size=(height, width),
            max_steps=max_steps,
            settling_steps=settling_steps,
            simulator_seed=simulator_seed,
            stop_at_success=stop_at_success,
            gripper_open=gripper_open,
            gripper_closed=gripper_closed,
        )
        if self._protocol.gripper_open == self._protocol.gripper_closed:
            raise ConfigError(f"libero/{task}: the gripper opens and closes at {gripper_open}; want two numbers")
        self.max_steps = self._protocol.max_steps
        self._instruction = instruction or self._task.language
        self._steps: int | None = None
        self._world: LiberoSimulation | None = None
        self._contract = robot.contract(self._protocol)
        with failing(self._name, "make"):
            self._states = read_states(self._task.states)
            self._world = LiberoSimulation(self._task, self._protocol, self._assets, record)
        self.init_states = len(self._states)

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        size = (arguments["height"], arguments["width"])
        grippers = {name: arguments[name] for name in ("gripper_open", "gripper_closed")}
        return robot.contract(LiberoProtocol.of(arguments["task"].partition("/")[0], image_size=size, **grippers))

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode in the initial state `options["init_state"]`, or in one chosen by the seed."""
        world, state = self._alive(), self._initial(seed, options or {})
        with failing(self._name, "reset"):
            seen = world.begin(self._states[state])
        self._steps = 0
        return self._observe(seen), {"success": seen.success, "init_state": state}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        world = self._alive()
        if self._steps is None:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract)
        with failing(self._name, "step"):
            seen = world.step(robot.to_simulator(action, self._protocol), look=self.looked_at)
        self._steps += 1
        ended = seen.success and self._protocol.stop_at_success
        truncated = not ended and self._steps >= self.max_steps
        obs = self._observe(seen, look=self.looked_at)
        return obs, float(seen.success), ended, truncated, {"success": seen.success}

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_suite(task or "")

    @classmethod
    def tasks(cls) -> list[str]:
        return task_names()

    @classmethod
    def missing(cls) -> str | None:
        """The first call in a process renders one frame in a child."""
        if missing := without(("libero", "robosuite", "mujoco"), "pip install 'vlagents-ray[libero]'"):
            return missing
        try:
            asset_files.find_assets()
        except EnvFailed as error:
            return str(error)
        return without_egl("LIBERO")

    def describe(self) -> dict[str, Any]:
        protocol = self._protocol.to_json(self._task.suite)
        if self._task.passes_for_own:
            protocol["deviations"].append(f"files: those of {self._task.name}, the protocol says LIBERO's own")
        return {
            "simulator": "libero",
            "task": self._task.full_name,
            "name": self._task.name,
            "language": self._task.language,
            "init_states": self.init_states,
            "protocol": protocol,
            "hf-libero": version("hf-libero"),
            "robosuite": version("robosuite"),
            "mujoco": version("mujoco"),
            "assets": asset_files.digest(self._assets),
            **({"files": variants.digest(self._task.problem, self._task.states)} if self._task.varied else {}),
            "render_backend": os.environ.get("MUJOCO_GL", "glfw"),
        }

    def close(self) -> None:
        world, self._world, self._steps = self._world, None, None
        if world is not None:
            world.close()

    def _initial(self, seed: int, options: Mapping[str, Any]) -> int:
        """The number of the initial state."""
        unknown = sorted(set(options) - {"init_state"})
        if unknown:
            raise ConfigError(f"{self._name}: unknown reset options {unknown}, want init_state or none")
        count = len(self._states)
        state = options.get("init_state", seed % count)
        if not isinstance(state, int) or not 0 <= state < count:
            raise ConfigError(f"{self._name}: init_state is {state!r}, want 0 to {count - 1}")
        return state

    def _observe(self, seen: SimulatorObs, *, look: bool = True) -> Obs:
        world, cameras = self._alive(), self._protocol.cameras if look else {}
        info: dict[str, Any] = {"sim_state": {"positions": world.positions(), "goal": world.goal}}
        if seen.views and look:
            info[HIGH_RES] = {name: _turned(seen.views[own]) for name, own in cameras.items()}
        state, gripper = robot.read(seen.raw)
        images = {name: _turned(seen.raw[f"{own}_image"]) for name, own in cameras.items()}
        return Obs(cameras=images, gripper=gripper, state=state, info=info)

    @property
    def _name(self) -> str:
        return f"libero/{self._task.full_name}"

    def _alive(self) -> LiberoSimulation:
        if self._world is None:
            raise EnvFailed(f"{self._name} is closed; make a new one")
        return self._world


def _turned(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1, ::-1])
