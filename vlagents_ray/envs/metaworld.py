"""Meta-World: fifty table-top tasks of a Sawyer arm in MuJoCo, each with a scripted oracle.

Images need OpenGL without a display: EGL, which Mesa also provides in software.
"""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import EvalEnv, one_row, require_known
from vlagents_ray.envs.benchmark_protocol import BenchmarkProtocol
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.envs.rendering.render_probe import failing, without, without_egl
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset
from vlagents_ray.interface import HIGH_RES, Act, Obs
from vlagents_ray.registry import require

PROTOCOL = BenchmarkProtocol(
    name="Meta-World",
    source="Meta-World 3.1.1, metaworld.evaluation and MT1",
    max_steps=500,  # the simulator refuses to go further
    control_hz=80.0,
    control="position of the hand, delta",
    success="the task is solved after any step: success_once",
    begins="where the object and the goal are: the episode's seed, or one of the 50 states that MT1 draws",
    ends_on_success=True,
    episodes=50,
)
_UPSIDE_DOWN = ("corner2",)  # cameras that Meta-World mounts upside down; the others are upright


class MetaWorld(EvalEnv):
    """One environment of one Meta-World task, e.g. "reach-v3".

    Observation: cameras, by default "corner2", turned upright; `state["xyz"]` (3,) m, the hand in
    the world's frame, and `gripper`; in `info["sim_state"]`, (39,) float64, Meta-World's observation
    with the goal in it, which its oracles need to the bit.

    Action: (4,) in [-1, 1]: the hand's target moves by 0.01 m a unit, x, y, z in the world's frame;
    the last is the gripper's effort, -1 opens, 1 closes.

    The seed draws the object's and the goal's position, as Meta-World's own generator of tasks does;
    with `goals_seed` they are the 50 that its MT1 draws with that, in order. Success ends the episode
    unless `ends_on_success` is False.
    """

    def __init__(
        self,
        task: str = "reach-v3",
        *,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] = ("corner2",),
        instruction: str | None = None,
        max_steps: int = PROTOCOL.max_steps,
        goals_seed: int | None = None,
        ends_on_success: bool = True,
        camera_positions: Mapping[str, Sequence[float]] | None = None,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment.

        Args:
            task: Meta-World's name.
            width: Width of each image, pixels.
            height: Height of each image, pixels.
            cameras: MuJoCo's names, e.g. "corner2", "gripperPOV".
            instruction: None is the task's name in words.
            max_steps: 500 at most.
            goals_seed: Seed of MT1, whose 50 initial states are then the task's; None: each episode's seed draws one.
            ends_on_success: As in Meta-World's own evaluation; False: success at the end can be measured, too.
            camera_positions: Name -> (x, y, z) m, of cameras that stand elsewhere than in Meta-World.
            record_size: Height and width of further views by the same cameras, for recordings only.

        Raises:
            UnknownEnv: There is no such task.
            ConfigError: An option has a wrong value.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator or its assets cannot be loaded.
        """
        if not 1 <= max_steps <= PROTOCOL.max_steps:
            raise ConfigError(
                f"metaworld: max_steps is {max_steps}, want 1 to {PROTOCOL.max_steps}, where the simulator stops"
            )
        for name, value in (("width", width), ("height", height)):
            if value < 1:
                raise ConfigError(f"metaworld: {name} is {value}, want at least 1")
        prepare_rendering()
        known = require("metaworld").ALL_V3_ENVIRONMENTS
        self.require_task(task)
        self.max_steps = max_steps
        self._task, self._name = task, f"metaworld/{task}"
        self._instruction = instruction or task.removesuffix("-v3").replace("-", " ")
        self._ends_on_success = ends_on_success
        self._goals: list[Any] | None = None
        self._steps: int | None = None
        self._env: Any = None
        self._renderer: Any = None
        self._record: Any = None  # the renderer of views for recordings
        record = record_size_of(record_size, self._name)
        tallest, widest = (max(pair) for pair in zip((height, width), record or (0, 0), strict=True))
        with failing(self._name, "make"):
            self._env = known[task](width=widest, height=tallest)  # the model's frame buffer grows to this size
            have = [self._env.model.camera(i).name for i in range(self._env.model.ncam)]
            # as Meta-World does for its classes with an observable goal, but with our seed
            self._env._partially_observable = False
            del self._env.sawyer_observation_space  # cached, and clips the goal away
            self._env._freeze_rand_vec = False
            self._env._set_task_called = True
            self._env.seeded_rand_vec = True
            if goals_seed is not None:
                self._goals = require("metaworld").MT1(task, seed=goals_seed).train_tasks
                self.init_states = len(self._goals)
        unknown = sorted({*cameras, *(camera_positions or {})} - set(have))
        if unknown:
            self.close()
            raise ConfigError(f"{self._name} has no camera {unknown}: want some of {sorted(have)}")
        for name, position in (camera_positions or {}).items():
            self._env.model.camera(name).pos = position
        stated = self.known_contract({"cameras": cameras, "width": width, "height": height})
        self._contract = replace(stated, control_hz=1.0 / self._env.dt)
        try:
            with failing(self._name, "make its renderer"):
                self._renderer = require("mujoco").Renderer(self._env.model, height, width)
                self._record = require("mujoco").Renderer(self._env.model, *record) if record else None
        except EnvFailed:
            self.close()
            raise

    @classmethod
    def known_contract(cls, arguments: Mapping[str, Any]) -> Contract:
        """Return the contract without the control rate, which the simulator knows."""
        return Contract(
            cameras={name: CameraSpec(arguments["height"], arguments["width"]) for name in arguments["cameras"]},
            state={"xyz": StateSpec(3, "m")},
            gripper=True,
            instruction=True,
            action=ActionSpec(
                dim=4,
                space="ee_position",
                delta=True,
                rotation="none",
                frame="world",
                gripper_open=-1.0,
                gripper_closed=1.0,
                low=-1.0,
                high=1.0,
            ),
        )

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32, or with `goals_seed` the one of the option `init_state`."""
        env = self._alive()
        goal = self._goal(dict(options or {}))
        with failing(self._name, "reset"):
            env.seed(seed % 2**32)
            if goal is not None:
                env.set_task(goal)
            raw, _ = env.reset()
            self._steps = 0
            return self._observe(raw), {"success": False}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        env = self._alive()
        if self._steps is None:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract)
        with failing(self._name, "step"):
            raw, reward, _, _, info = env.step(np.clip(action, -1.0, 1.0))
            self._steps += 1
            success = bool(info["success"])
            ended = success and self._ends_on_success
            obs = self._observe(raw, look=self.looked_at)
            return obs, float(reward), ended, self._steps >= self.max_steps, {"success": success}

    @classmethod
    def require_task(cls, task: str | None) -> None:
        if known := cls.tasks():
            require_known("metaworld", task, known)

    @classmethod
    def tasks(cls) -> list[str]:
        if importlib.util.find_spec("metaworld") is None:
            return []
        prepare_rendering()
        return sorted(require("metaworld").ALL_V3_ENVIRONMENTS)

    @classmethod
    def missing(cls) -> str | None:
        """Say why Meta-World cannot run here; the first call in a process renders one frame in a child."""
        return without(("metaworld", "mujoco"), "pip install 'vlagents-ray[metaworld]'") or without_egl("Meta-World")

    def describe(self) -> dict[str, Any]:
        return {
            "simulator": "metaworld",
            "task": self._task,
            "metaworld": version("metaworld"),
            "mujoco": version("mujoco"),
            "control_mode": "ee_delta_position",
            "metres_per_unit": float(self._alive().action_scale),
            "render_backend": os.environ.get("MUJOCO_GL", "glfw"),
            "protocol": PROTOCOL.describe(max_steps=self.max_steps, ends_on_success=self._ends_on_success),
        }

    def close(self) -> None:
        renderers, self._renderer, self._record = (self._renderer, self._record), None, None
        env, self._env, self._steps = self._env, None, None
        for renderer in renderers:
            if renderer is not None:
                renderer.close()
        if env is not None:
            env.close()

    def _goal(self, options: dict[str, Any]) -> Any:
        """Return Meta-World's initial state for the reset's options; None without `goals_seed`."""
        index = options.pop("init_state", None) if self._goals is not None else None
        if options:
            raise ConfigError(f"metaworld: unknown reset options {sorted(options)}, want init_state, with goals_seed")
        if self._goals is None:
            return None
        if type(index) is not int or not 0 <= index < len(self._goals):
            raise ConfigError(f"metaworld: init_state is {index!r}, want 0 to {len(self._goals) - 1}")
        return self._goals[index]

    def _observe(self, raw: np.ndarray, *, look: bool = True) -> Obs:
        cameras = self._contract.cameras or {} if look else {}
        info: dict[str, Any] = {"sim_state": raw}
        if self._record is not None and look:
            info[HIGH_RES] = {name: self._render(self._record, name) for name in cameras}
        return Obs(
            cameras={name: self._render(self._renderer, name) for name in cameras},
            gripper=float(raw[3]),  # the fingers' distance over 0.1 m, clipped to [0, 1] by Meta-World
            state={"xyz": raw[:3].astype(np.float32)},
            info=info,
        )

    def _render(self, renderer: Any, camera: str) -> np.ndarray:
        renderer.update_scene(self._env.data, camera=camera)
        image: np.ndarray = renderer.render()
        return np.ascontiguousarray(image[::-1, ::-1]) if camera in _UPSIDE_DOWN else image

    def _alive(self) -> Any:
        if self._env is None:
            raise EnvFailed(f"{self._name} is closed; make a new one")
        return self._env
