"""Meta-World: fifty table-top tasks of a Sawyer arm in MuJoCo, each with a scripted oracle.

Images need OpenGL without a display: EGL, which Mesa also provides in software.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import EvalEnv, one_row
from vlagents_ray.envs.headless import prepare_rendering
from vlagents_ray.envs.probe import EGL_CURE, egl_probe
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.errors import ConfigError, EnvFailed, NotReset, UnknownEnv
from vlagents_ray.interface import HIGH_RES, Act, Obs
from vlagents_ray.registry import require

_MAX_STEPS = 500  # the simulator refuses to go further
_UPSIDE_DOWN = ("corner2",)  # cameras that Meta-World mounts so; the others stand upright


class MetaWorld(EvalEnv):
    """One environment of one Meta-World task, e.g. "reach-v3".

    Observation: cameras, by default "corner2", turned upright; `state["xyz"]` (3,) m, the hand in
    the world's frame, and `gripper`; in `info["sim_state"]`, (39,) float64, Meta-World's observation
    with the goal in it, which its oracles need to the bit.

    Action: (4,) in [-1, 1]: the hand's target moves by 0.01 m a unit, x, y, z in the world's frame;
    the last is the gripper's effort, -1 opens, 1 closes.

    The seed draws the object's and the goal's position, as Meta-World's own generator of tasks does.
    The env goes on after success, and never reports `terminated`.
    """

    def __init__(
        self,
        task: str = "reach-v3",
        *,
        width: int = 224,
        height: int = 224,
        cameras: Sequence[str] = ("corner2",),
        instruction: str | None = None,
        max_steps: int = _MAX_STEPS,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Raises `UnknownEnv`, `ConfigError`, `MissingDependency`, or `EnvFailed` with its cure.

        Args:
            task: Meta-World's name.
            width: of each image, pixels.
            height: of each image, pixels.
            cameras: by MuJoCo's names, e.g. "corner2", "gripperPOV".
            instruction: None is the task's name in words.
            max_steps: 500 at most.
            record_size: height and width of further views by the same cameras, for the record only.
        """
        if not 1 <= max_steps <= _MAX_STEPS:
            raise ConfigError(f"metaworld: max_steps is {max_steps}, want 1 to {_MAX_STEPS}, where the simulator stops")
        for name, value in (("width", width), ("height", height)):
            if value < 1:
                raise ConfigError(f"metaworld: {name} is {value}, want at least 1")
        prepare_rendering()
        known = require("metaworld").ALL_V3_ENVIRONMENTS
        if task not in known:
            raise UnknownEnv(f"metaworld has no task {task!r}: want one of {sorted(known)}")
        self.max_steps = max_steps
        self._task = task
        self._instruction = instruction or task.removesuffix("-v3").replace("-", " ")
        self._steps: int | None = None
        self._env: Any = None
        self._renderer: Any = None
        self._record: Any = None  # the renderer of the views for the record
        record = record_size_of(record_size, f"metaworld/{task}")
        tallest, widest = (max(pair) for pair in zip((height, width), record or (0, 0), strict=True))
        with self._failing("make"):
            self._env = known[task](width=widest, height=tallest)  # the model's frame buffer grows to this size
            have = [self._env.model.camera(i).name for i in range(self._env.model.ncam)]
            # what Meta-World does for its classes with an observable goal, but drawing from our seed
            self._env._partially_observable = False
            del self._env.sawyer_observation_space  # cached, and clips the goal away
            self._env._freeze_rand_vec = False
            self._env._set_task_called = True
            self._env.seeded_rand_vec = True
        unknown = sorted(set(cameras) - set(have))
        if unknown:
            self.close()
            raise ConfigError(f"metaworld/{task} has no camera {unknown}: want some of {sorted(have)}")
        self._contract = Contract(
            cameras={name: CameraSpec(height, width) for name in cameras},
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
            control_hz=1.0 / self._env.dt,
        )
        try:
            with self._failing("make its renderer"):
                self._renderer = require("mujoco").Renderer(self._env.model, height, width)
                self._record = require("mujoco").Renderer(self._env.model, *record) if record else None
        except EnvFailed:
            self.close()
            raise

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        """Begin the episode of `seed`, taken modulo 2^32; there are no options."""
        if options:
            raise ConfigError(f"metaworld: unknown reset options {sorted(options)}, want none")
        env = self._alive()
        with self._failing("reset"):
            env.seed(seed % 2**32)
            raw, _ = env.reset()
            self._steps = 0
            return self._observe(raw), {"success": False}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        env = self._alive()
        if self._steps is None:
            raise NotReset(f"metaworld/{self._task}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract)
        with self._failing("step"):
            raw, reward, _, _, info = env.step(np.clip(action, -1.0, 1.0))
            self._steps += 1
            success = bool(info["success"])
            return self._observe(raw), float(reward), False, self._steps >= self.max_steps, {"success": success}

    @classmethod
    def tasks(cls) -> list[str]:
        if importlib.util.find_spec("metaworld") is None:
            return []
        prepare_rendering()
        return sorted(require("metaworld").ALL_V3_ENVIRONMENTS)

    @classmethod
    def missing(cls) -> str | None:
        """The first call in a process renders one frame in a child."""
        for module in ("metaworld", "mujoco"):
            if importlib.util.find_spec(module) is None:
                return f"{module} is not installed; pip install 'vlagents-ray[metaworld]'"
        probe = egl_probe()
        return None if probe.ok else f"Meta-World cannot render without a display ({probe.error}); {probe.cure}"

    def describe(self) -> dict[str, Any]:
        return {
            "simulator": "metaworld",
            "task": self._task,
            "metaworld": version("metaworld"),
            "mujoco": version("mujoco"),
            "control_mode": "ee_delta_position",
            "metres_per_unit": float(self._alive().action_scale),
            "render_backend": os.environ.get("MUJOCO_GL", "glfw"),
        }

    def close(self) -> None:
        renderers, self._renderer, self._record = (self._renderer, self._record), None, None
        env, self._env, self._steps = self._env, None, None
        for renderer in renderers:
            if renderer is not None:
                renderer.close()
        if env is not None:
            env.close()

    def _observe(self, raw: np.ndarray) -> Obs:
        cameras = self._contract.cameras or {}
        info: dict[str, Any] = {"sim_state": raw}
        if self._record is not None:
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
            raise EnvFailed(f"metaworld/{self._task} is closed; make a new one")
        return self._env

    @contextlib.contextmanager
    def _failing(self, doing: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            about_egl = any(word in str(error) for word in ("EGL", "OpenGL", "GLContext", "mjr_makeContext"))
            cure = f"; {EGL_CURE}" if about_egl else ""
            raise EnvFailed(f"metaworld/{self._task} failed to {doing}: {error!r}{cure}") from error
