"""What environments in robosuite's simulator share: its import, episodes, seeds, cameras, and the gripper's opening."""

from __future__ import annotations

import functools
import logging
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np

from vlagents_ray.envs.rendering.graphics import EGL_DEVICE, GPUS
from vlagents_ray.envs.rendering.render_probe import EGL_CURE
from vlagents_ray.envs.simulator import SimulatorEnv, Size
from vlagents_ray.errors import EnvFailed
from vlagents_ray.interface import HIGH_RES, Obs

_OPEN_M = 0.04  # a finger's travel from closed to open


class RobosuiteEnv(SimulatorEnv):
    """One environment of robosuite's; a subclass makes the simulator and hands it to `_use`.

    `info["sim_state"]`, for scripted experts only, has the positions and quaternions xyzw of objects.
    """

    _raw: Mapping[str, str] = {}
    """What robosuite calls parts of the contract's state, of those that it calls otherwise."""

    def _use(self, simulator: Any) -> None:
        self._env, self._renderer = simulator, CameraRenderer(simulator, self._record_size)
        self._resources.callback(simulator.close)
        self._resources.callback(self._renderer.make_current)

    def _begin(self, seed: int, state: int) -> tuple[Obs, dict[str, Any]]:
        with seeded(seed):
            if hasattr(self._env, "rng"):  # robosuite 1.5 has a generator of its own, which its parts share
                self._env.rng.bit_generator.state = np.random.default_rng(seed).bit_generator.state
            self._renderer.make_current()  # the last episode's rendering resources are freed in their own context
            self._renderer.open = True
            raw = self._env.reset()
        return self._observe(raw), {}

    def _advance(self, action: np.ndarray) -> tuple[Obs, float, bool, dict[str, Any]]:
        """The reward is 1 if the task is solved, else 0."""
        self._renderer.open = self.looked_at
        raw, *_ = self._env.step(self._command(action.astype(np.float64)))
        success = bool(self._env._check_success())
        return self._observe(raw, look=self.looked_at), float(success), *self._solved(success)

    def describe(self) -> dict[str, Any]:
        return super().describe() | {"control_mode": "OSC_POSE"}

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
        return Obs(
            cameras={name: _upright(raw[f"{name}_image"]) for name in cameras},
            gripper=gripper_opening(raw) if contract.gripper else None,
            state={name: np.asarray(raw[self._raw.get(name, name)], np.float32) for name in contract.state or {}},
            info=info,
        )


def gripper_opening(raw: Mapping[str, Any]) -> float:
    """Return the opening of the Panda's gripper in robosuite's observation, 0 closed to 1 open."""
    return min(max(float(raw["robot0_gripper_qpos"][0]) / _OPEN_M, 0.0), 1.0)


def _upright(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[::-1])


class CameraRenderer:
    """Renders the cameras while it is `open`; otherwise they show black and cost nothing.

    robosuite renders each camera for every observation, 14 times from the beginning of a reset to the policy's
    first observation. It samples a step's observation, images included, after the first 2 ms of the step's 50;
    the views for recordings are of the same moment.
    """

    def __init__(self, domain: Any, record_size: Size | None) -> None:
        self.open = True
        self.views: dict[str, np.ndarray] = {}
        self._domain = domain
        self._record_size = record_size
        self._own = domain._create_camera_sensors
        domain._create_camera_sensors = self._sensors  # called again in each reset

    def make_current(self) -> None:
        """Render in this simulator's OpenGL context: the process may have others."""
        sim = self._domain.sim
        if sim is not None and sim._render_context_offscreen is not None:  # after a failed reset there is none
            sim._render_context_offscreen.gl_ctx.make_current()

    def _sensors(self, cam_name: str, cam_w: int, cam_h: int, **rest: Any) -> tuple[list[Any], list[str]]:
        [own], names = self._own(cam_name, cam_w=cam_w, cam_h=cam_h, **rest)
        return [self._switched(own, cam_name, (cam_h, cam_w))], names

    def _switched(self, own: Callable[[Any], np.ndarray], camera: str, size: tuple[int, int]) -> Callable[[Any], Any]:
        @functools.wraps(own)  # keeps robosuite's attributes
        def look(cache: Any) -> np.ndarray:
            if not self.open:
                return np.zeros((*size, 3), np.uint8)
            self.make_current()
            if self._record_size is not None:
                height, width = self._record_size
                view = self._domain.sim.render(camera_name=camera, height=height, width=width)
                self.views = self.views | {camera: view}
            return own(cache)

        return look


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """robosuite 1.4 and LIBERO draw from numpy's global generator, whose state is restored."""
    before = np.random.get_state()  # noqa: NPY002
    np.random.seed(seed)  # noqa: NPY002
    try:
        yield
    finally:
        np.random.set_state(before)  # noqa: NPY002


@contextmanager
def importing_robosuite(env: str) -> Iterator[None]:
    """Surround the first import of robosuite; `env` is named in errors."""
    with _no_log_file(), _egl_number(env):
        yield


@contextmanager
def _no_log_file() -> Iterator[None]:
    """robosuite logs to one fixed file of the machine, which another user of it may own: then the import fails.

    This also hides its advice about macros, which are not needed.
    """

    def nowhere(_filename: object) -> logging.Handler:
        return logging.NullHandler()

    log = logging.getLogger("robosuite_logs")
    real, level = logging.FileHandler, log.level
    logging.FileHandler = nowhere  # type: ignore[assignment,misc]
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logging.FileHandler = real  # type: ignore[misc]
        log.setLevel(level)


@contextmanager
def _egl_number(env: str) -> Iterator[None]:
    """Correct robosuite, which takes EGL's numbers for CUDA's and refuses those not in CUDA_VISIBLE_DEVICES.

    It reads them when it is imported. Where no EGL device was chosen it would draw on the one with CUDA's number, and
    fail on "": the worker finds out on which.
    """
    chosen, visible = os.environ.get(EGL_DEVICE), os.environ.get(GPUS)
    if visible == "" and chosen is None and os.environ.get("MUJOCO_GL") == "egl":
        raise EnvFailed(f"{env} finds no EGL device that renders in software, and was given no GPU; {EGL_CURE}")
    if chosen is None or not visible:
        yield
        return
    os.environ[GPUS] = chosen
    try:
        yield
    finally:
        os.environ[GPUS] = visible
