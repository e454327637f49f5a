"""Any registered Gymnasium environment, through a small mapping.

`gymnasium/<id>`, for instance `gymnasium/Pendulum-v1` or `gymnasium/gym_pusht/PushT-v0`. Images and
vectors that the observation space names are found by themselves; an environment without images is
rendered. Everything else is an option of `Gymnasium`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import EvalEnv, one_row
from vlagents_ray.envs.gymnasium.known import known
from vlagents_ray.envs.mapping import RENDER, Pick, as_image, bounds, parts, plain, uniform
from vlagents_ray.envs.recording import record_size_of
from vlagents_ray.envs.rendering.headless import prepare_rendering
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, NotReset, UnknownEnv
from vlagents_ray.interface import HIGH_RES, Act, Obs
from vlagents_ray.registry import require

TERMINATED = "terminated"
_SUCCESS_KEYS = ("is_success", "success")


class Gymnasium(EvalEnv):
    """A Gymnasium environment with a continuous action vector, Box (D,).

    Actions are clipped to the Box. Success is `info["is_success"]` or `info["success"]` where the
    environment gives one; without it, and without the option `success`, no episode succeeds and
    only the returns say something.
    """

    def __init__(
        self,
        task: str | None = None,
        *,
        module: str | None = None,
        kwargs: Mapping[str, Any] | None = None,
        cameras: Mapping[str, str] | None = None,
        state: Mapping[str, str] | None = None,
        gripper: str | None = None,
        gripper_range: tuple[float, float] = (0.0, 1.0),
        success: str | None = None,
        instruction: str | None = None,
        control_hz: float | None = None,
        unit_actions: bool = False,
        width: int | None = None,
        height: int | None = None,
        max_steps: int | None = None,
        remake: bool = False,
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment, and check one observation of it.

        Args:
            task: The Gymnasium id.
            module: The module that registers the id; by default the id's namespace.
            kwargs: Arguments of `gymnasium.make`; `render_mode` is "rgb_array" by default.
            cameras: name -> path of an (H, W, 3) uint8 image in the observation, or "render".
            state: name -> path of a vector, optionally with a range: "robot/qpos[0:7]"; see `Pick`.
            gripper: The path of a number in the observation.
            gripper_range: The values of that number (closed, open).
            success: The path of a bool in the step's info, or "terminated".
            instruction: The task in words.
            control_hz: The rate of the steps, Hz.
            unit_actions: Whether actions are in [-1, 1], and scaled here to the Box.
            width: The width to which every image is stretched, pixels.
            height: The height to which every image is stretched, pixels.
            max_steps: The step limit, instead of the registered one.
            remake: Whether each reset makes the simulator again, for one whose own reset keeps some state.
            record_size: Height and width of further copies of the images, for recordings only.

        Raises:
            UnknownEnv: There is no such id.
            ConfigError: An option does not fit the environment.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator cannot be made.
        """
        if task is None:
            raise UnknownEnv("gymnasium: got no id, want one, as in 'gymnasium/Pendulum-v1'")
        prepare_rendering()
        defaults = known(task)
        self._id = task
        self._module = module if module is not None else defaults.module
        self._kwargs = {"render_mode": "rgb_array", **defaults.kwargs, **(kwargs or {})}
        self._instruction = instruction if instruction is not None else defaults.instruction
        self._protocol = defaults.protocol
        self._success = success
        self._unit_actions = unit_actions
        self._size = (height, width)
        self._record_size = record_size_of(record_size, f"gymnasium/{task}")
        self._remake = remake
        self._ready = False
        self._steps = 0
        self._env = self._make(max_steps)
        try:
            self.max_steps = self._step_limit(max_steps)
            self._action_space = str(self._env.action_space)
            self._low, self._high, self._dtype = bounds(self._env.action_space)
            if unit_actions and not np.isfinite([self._low, self._high]).all():
                raise ConfigError(f"gymnasium/{task}: unit_actions needs finite bounds, got {self._action_space}")
            seen_cameras, seen_state = parts(self._env.observation_space, self._env.render_mode)
            self._cameras = _picks(next(c for c in (cameras, defaults.cameras, seen_cameras) if c is not None))
            self._state = _picks(state if state is not None else seen_state)
            self._gripper = Pick.parse(gripper) if gripper is not None else None
            self._gripper_closed, self._gripper_open = gripper_range
            if self._gripper_closed == self._gripper_open:
                raise ConfigError(f"gymnasium/{task}: gripper_range is {gripper_range}, want two different numbers")
            first, _ = self._call("reset", seed=0)
            self._contract = self._describe_contract(self._observe(first), control_hz or defaults.control_hz)
        except BaseException:
            self.close()
            raise

    @classmethod
    def missing(cls) -> str | None:
        try:
            require("gymnasium")
        except MissingDependency as error:
            return str(error)
        return None

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    def describe(self) -> dict[str, Any]:
        played = {"max_steps": self.max_steps, "control_hz": self._contract.control_hz}
        return {
            "id": self._id,
            "gymnasium": require("gymnasium").__version__,
            "kwargs": plain(self._kwargs),
            "action_space": self._action_space,
            "unit_actions": self._unit_actions,
            "success": self._success or f"info: {' or '.join(_SUCCESS_KEYS)}",
            "protocol": self._protocol.describe(**played) if self._protocol is not None else played,
        }

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        if seed < 0:
            raise ConfigError(f"gymnasium/{self._id}: seed is {seed}, want 0 or more")
        if self._env is None:
            raise NotReset(f"gymnasium/{self._id}: is closed; make it again")
        if self._remake:
            self._call("close")
            self._env = self._make(self.max_steps)
        nested, info = self._call("reset", seed=seed, options=dict(options) if options else None)
        self._ready, self._steps = True, 0
        return self._observe(nested), plain(info)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        if not self._ready:
            raise NotReset(f"gymnasium/{self._id}: step before reset; call reset(seed=...) first")
        action = one_row(act, self._contract).astype(np.float64)
        if self._unit_actions:
            action = self._low + (action + 1) / 2 * (self._high - self._low)
        action = np.clip(action, self._low, self._high).astype(self._dtype)
        nested, reward, terminated, truncated, info = self._call("step", action)
        self._steps += 1
        success = self._succeeded(info, bool(terminated))
        stopped = bool(truncated) or self._steps >= self.max_steps
        # Unused images are rendered as well: rendering changes the state of some envs (the target of the Fetch tasks).
        return self._observe(nested), float(reward), bool(terminated), stopped, {**plain(info), "success": success}

    def close(self) -> None:
        self._ready = False
        if self._env is not None:
            env, self._env = self._env, None
            env.close()

    def _make(self, max_steps: int | None) -> Any:
        # pygame, which several environments draw with, prints a greeting on import otherwise
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        gymnasium = require("gymnasium")
        module = self._module
        if module is None and "/" in self._id and self._id not in gymnasium.registry:
            module = self._id.partition("/")[0]
        if module is not None:
            require(module)
        try:
            return gymnasium.make(self._id, max_episode_steps=max_steps, disable_env_checker=True, **self._kwargs)
        except gymnasium.error.DependencyNotInstalled as error:
            raise MissingDependency(f"gymnasium/{self._id}: {error}") from error
        except gymnasium.error.UnregisteredEnv as error:
            raise UnknownEnv(f"gymnasium/{self._id}: {error}; set `module` to what registers it") from error
        except TypeError as error:
            raise ConfigError(f"gymnasium/{self._id}: {error}; check `kwargs`, got {self._kwargs}") from error

    def _step_limit(self, wanted: int | None) -> int:
        limit = wanted or self._env.spec.max_episode_steps
        if limit is None or limit < 1:
            raise ConfigError(f"gymnasium/{self._id}: its step limit is {limit}; set `max_steps` to 1 or more")
        return int(limit)

    def _call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        try:
            return getattr(self._env, method)(*args, **kwargs)
        except Exception as error:
            raise EnvFailed(f"gymnasium/{self._id}: {method} raised {type(error).__name__}: {error}") from error

    def _observe(self, nested: Any) -> Obs:
        cameras, recorded = {}, {}
        for name, pick in self._cameras.items():
            picture = self._call("render") if pick.text == RENDER else pick.value(nested)
            cameras[name] = as_image(picture, name, self._size)
            if self._record_size is not None:
                recorded[name] = as_image(picture, name, self._record_size)
        gripper = None
        if self._gripper is not None:
            share = (self._gripper.number(nested) - self._gripper_closed) / (self._gripper_open - self._gripper_closed)
            gripper = min(max(share, 0.0), 1.0)
        state = {name: pick.vector(nested) for name, pick in self._state.items()}
        return Obs(cameras, gripper, state, {HIGH_RES: recorded} if recorded else {})

    def _succeeded(self, info: Mapping[str, Any], terminated: bool) -> bool:
        if self._success == TERMINATED:
            return terminated
        if self._success is not None:
            return bool(Pick.parse(self._success).value(info))
        return any(bool(info.get(key, False)) for key in _SUCCESS_KEYS)

    def _describe_contract(self, obs: Obs, control_hz: float | None) -> Contract:
        low, high = (-1.0, 1.0) if self._unit_actions else (uniform(self._low), uniform(self._high))
        return Contract(
            cameras={name: CameraSpec(*image.shape[:2]) for name, image in obs.cameras.items()},
            state={name: StateSpec(len(part)) for name, part in obs.state.items()},
            gripper=obs.gripper is not None,
            instruction=bool(self._instruction),
            action=ActionSpec(dim=len(self._low), low=low, high=high),
            control_hz=control_hz,
        )


def _picks(paths: Mapping[str, str]) -> dict[str, Pick]:
    return {name: Pick.parse(path) for name, path in paths.items()}
