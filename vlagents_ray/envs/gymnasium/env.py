"""Environments of Gymnasium behind the interface of `EvalEnv`, and PushT by its published protocol."""

from __future__ import annotations

import importlib.util
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import EvalEnv, require_known
from vlagents_ray.envs.graphics import prepare_rendering
from vlagents_ray.envs.gymnasium.view import SUCCESS_KEYS, Mapped, View, plain
from vlagents_ray.envs.simulator import BenchmarkProtocol
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, NotReset, UnknownEnv, VLAgentsError
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import require


@dataclass(frozen=True, slots=True)
class Known:
    """Defaults of the options of `Gymnasium` for one id; None uses the environment's own values."""

    module: str | None = None  # registers the id
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    cameras: Mapping[str, str] | None = None
    instruction: str = ""
    control_hz: float | None = None
    protocol: BenchmarkProtocol | None = None


def known(task: str) -> Known:
    """Return the defaults for a Gymnasium id; empty ones if it is not known."""
    if task == "gym_pusht/PushT-v0":
        return _PUSHT
    fetch = re.fullmatch(r"Fetch(\w+?)(?:Dense)?-v\d+", task)
    if fetch is None or fetch[1] not in _FETCH_INSTRUCTIONS:
        return Known()
    return Known(
        module="gymnasium_robotics",
        instruction=_FETCH_INSTRUCTIONS[fetch[1]],
        control_hz=_FETCH.control_hz,
        protocol=_FETCH,
    )


_PUSHT = Known(
    module="gym_pusht",
    kwargs={"obs_type": "pixels_agent_pos"},
    cameras={"front": "pixels"},
    instruction="push the T-shaped block onto the green target",
    control_hz=10.0,
    protocol=BenchmarkProtocol(
        name="PushT",
        source="gym-pusht 0.1.8, PushTEnv; LeRobot 0.4.4, PushtEnv and EvalConfig",
        max_steps=300,
        control_hz=10.0,
        control="absolute position",
        success="the block covers more than 95 % of the target",
        begins="where agent and block stand: the seed's; episode i has the first seed + i",
        ends_on_success=True,
        episodes=50,
    ),
)

_FETCH_INSTRUCTIONS = {
    "Reach": "move the gripper to the red target",
    "Push": "push the block to the red target",
    "Slide": "slide the puck to the red target",
    "PickAndPlace": "pick up the block and move it to the red target",
}
_FETCH = BenchmarkProtocol(
    name="Fetch",
    source="Gymnasium-Robotics 1.4.2; Plappert et al. 2018, arXiv 1802.09464",
    max_steps=50,
    control_hz=25.0,
    control="position of the gripper, delta",
    success="gripper or object is within 5 cm of the target after the last step: success_at_end",
    begins="where object and target are: the seed's",
    ends_on_success=False,
)


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
        self._id, self._name = task, f"gymnasium/{task}"
        self._module = module if module is not None else defaults.module
        self._kwargs = {**defaults.kwargs, **(kwargs or {})}
        self._protocol = defaults.protocol
        self._success = success
        self._unit_actions = unit_actions
        self._remake = remake
        self._ready = False
        self._steps = 0
        self._env = self._make(max_steps)
        try:
            self._instruction = instruction if instruction is not None else defaults.instruction
            self.max_steps = self._step_limit(max_steps)
            self._action_space = str(self._env.action_space)
            mapped = Mapped(
                cameras=cameras if cameras is not None else defaults.cameras,
                state=state,
                gripper=gripper,
                gripper_range=gripper_range,
                success=success,
                unit_actions=unit_actions,
                size=(height, width),
            )
            self._view = View(self._name, self._env, mapped)
            first, _ = self._call("reset", seed=0)
            self._contract = self._view.contract(
                self._observe(first),
                instruction=bool(self._instruction),
                control_hz=control_hz or defaults.control_hz,
            )
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
            "success": self._success or f"info: {' or '.join(SUCCESS_KEYS)}",
            "protocol": self._protocol.describe(**played) if self._protocol is not None else played,
        }

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        if seed < 0:
            raise ConfigError(f"{self._name}: seed is {seed}, want 0 or more")
        if self._env is None:
            raise NotReset(f"{self._name}: is closed; make it again")
        if self._remake:
            self._call("close")
            self._env = self._make(self.max_steps)
        nested, info = self._call("reset", seed=seed, options=dict(options) if options else None)
        self._ready, self._steps = True, 0
        return self._observe(nested), plain(info)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        if not self._ready:
            raise NotReset(f"{self._name}: step before reset; call reset(seed=...) first")
        nested, reward, terminated, truncated, info = self._call("step", self._view.command(act, self._contract))
        self._steps += 1
        success = self._view.succeeded(info, bool(terminated))
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
        arguments = {"render_mode": "rgb_array", "disable_env_checker": True, **self._kwargs}
        try:
            return gymnasium.make(self._id, max_episode_steps=max_steps, **arguments)
        except gymnasium.error.DependencyNotInstalled as error:
            raise MissingDependency(f"{self._name}: {error}") from error
        except gymnasium.error.UnregisteredEnv as error:
            raise UnknownEnv(f"{self._name}: {error}; set `module` to what registers it") from error
        except gymnasium.error.Error as error:
            raise ConfigError(f"{self._name}: {error}") from error
        except TypeError as error:
            raise ConfigError(f"{self._name}: {error}; check `kwargs`, got {self._kwargs}") from error

    def _step_limit(self, wanted: int | None) -> int:
        spec = self._env.spec
        limit = wanted or (spec.max_episode_steps if spec is not None else None)
        if limit is None or limit < 1:
            raise ConfigError(f"{self._name}: its step limit is {limit}; set `max_steps` to 1 or more")
        return int(limit)

    def _call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        try:
            return getattr(self._env, method)(*args, **kwargs)
        except VLAgentsError:
            raise
        except Exception as error:
            raise EnvFailed(f"{self._name}: {method} raised {type(error).__name__}: {error}") from error

    def _observe(self, nested: Any) -> Obs:
        return self._view.observe(nested, lambda: self._call("render"))


_ID = "gym_pusht/PushT-v0"
# What is observed in each task: options of `Gymnasium`.
_TASKS: dict[str, Mapping[str, Any]] = {
    "image": {},
    "keypoints": {"kwargs": {"obs_type": "environment_state_agent_pos"}, "cameras": {}},
}


class PushT(Gymnasium):
    """PushT by its published protocol, "image" or "keypoints".

    Observation: `state["agent_pos"]`, (2,) in pixels of the field, 512 by 512. With "image" also "front", (96, 96, 3)
    by default; with "keypoints" `state["environment_state"]`, (16,), x and y of eight points of the block, in pixels.
    In `info["sim_state"]`, (7,) float64, what the simulator knows: x, y of the agent and its velocity, pixels and
    pixels/s; x, y and angle of the block, pixels and rad.

    Action: (2,) in [0, 512]: where the disc shall go, in the same pixels.
    """

    def __init__(
        self,
        task: str = "image",
        *,
        width: int | None = None,
        height: int | None = None,
        max_steps: int | None = None,
    ) -> None:
        """Make the environment; images are stretched to `width` and `height`, pixels."""
        self.require_task(task)
        super().__init__(_ID, **_TASKS[task], width=width, height=height, max_steps=max_steps)

    @classmethod
    def tasks(cls) -> list[str]:
        return list(_TASKS)

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("pusht", task or "image", cls.tasks())

    @classmethod
    def missing(cls) -> str | None:
        if importlib.util.find_spec("gym_pusht") is None:
            return "gym_pusht is not installed; pip install 'vlagents-ray[pusht]'"
        return None

    def _observe(self, nested: Any) -> Obs:
        obs = super()._observe(nested)
        agent, block = self._env.unwrapped.agent, self._env.unwrapped.block
        obs.info["sim_state"] = np.array([*agent.position, *agent.velocity, *block.position, block.angle])
        return obs
