"""Environments of Gymnasium behind the interface of `EvalEnv`, and PushT by its published protocol."""

from __future__ import annotations

import importlib.util
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.envs.base import BatchEnv, EvalEnv, require_known
from vlagents_ray.envs.graphics import prepare_rendering
from vlagents_ray.envs.gymnasium.vector import GymnasiumBatch, VectorRows
from vlagents_ray.envs.gymnasium.view import SUCCESS_KEYS, Mapped, View, plain
from vlagents_ray.envs.simulator import BenchmarkProtocol, record_size_of
from vlagents_ray.errors import ConfigError, EnvFailed, MissingDependency, NotReset, UnknownEnv, VLAgentsError
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import require

VECTORIZATIONS = ("sync", "async", "vector_entry_point")


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


def make(
    name: str,
    task: str,
    *,
    module: str | None,
    kwargs: Mapping[str, Any],
    vectorization: str | None,
    rows: int,
    max_steps: int | None,
) -> Any:
    """Make a `gymnasium.Env`, or `VectorRows`, by its id; see `Gymnasium` for the options and errors."""
    if vectorization not in (None, *VECTORIZATIONS):
        raise ConfigError(f"{name}: vectorization is {vectorization!r}, want one of {list(VECTORIZATIONS)}")
    # pygame, which several environments draw with, prints a greeting on import otherwise
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    gymnasium = require("gymnasium")
    spec = _registered(task, module)
    if vectorization is None and spec is not None and spec.entry_point is None:
        vectorization = "vector_entry_point"
    try:
        if vectorization is None:
            arguments = {"render_mode": "rgb_array", "disable_env_checker": True, **kwargs}
            return gymnasium.make(task, max_episode_steps=max_steps, **arguments)
        arguments = _vector_arguments(gymnasium, spec, vectorization, max_steps) | dict(kwargs)
        vector = gymnasium.make_vec(task, num_envs=rows, vectorization_mode=vectorization, **arguments)
    except gymnasium.error.DependencyNotInstalled as error:
        raise MissingDependency(f"{name}: {error}") from error
    except gymnasium.error.UnregisteredEnv as error:
        raise UnknownEnv(f"{name}: {error}; set `module` to what registers it") from error
    except gymnasium.error.Error as error:
        raise ConfigError(f"{name}: {error}") from error
    except TypeError as error:
        raise ConfigError(f"{name}: {error}; check `kwargs`, got {dict(kwargs)}") from error
    return VectorRows(name, vector)


def only_vectors(task: str, module: str | None) -> bool:
    """Whether an id is registered with a VectorEnv's entry point alone."""
    spec = _registered(task, module)
    return spec is not None and spec.entry_point is None


def _registered(task: str, module: str | None) -> Any:
    """Import what registers an id, and return its spec; None if it has none under exactly this id."""
    registry = require("gymnasium").registry
    if module is None and "/" in task and task not in registry:
        module = task.partition("/")[0]
    if module is not None:
        require(module)
    return registry.get(task)


def _vector_arguments(gymnasium: Any, spec: Any, vectorization: str, max_steps: int | None) -> dict[str, Any]:
    arguments: dict[str, Any] = {"max_episode_steps": max_steps} if max_steps is not None else {}
    if vectorization != "vector_entry_point":
        mode = gymnasium.vector.AutoresetMode.DISABLED  # one row can begin an episode while the others go on
        return arguments | {
            "render_mode": "rgb_array",
            "disable_env_checker": True,
            "vector_kwargs": {"autoreset_mode": mode},
        }
    entry = getattr(spec, "vector_entry_point", None)
    if isinstance(entry, str):
        entry = gymnasium.envs.registration.load_env_creator(entry)
    if spec is not None and spec.max_episode_steps is None:
        arguments = {}  # its entry point need not take a limit
    renders = "rgb_array" in (getattr(entry, "metadata", None) or {}).get("render_modes", ())
    return arguments | ({"render_mode": "rgb_array"} if renders else {})


class Gymnasium(EvalEnv):
    """A Gymnasium environment with a continuous action vector, Box (D,).

    Actions are clipped to the Box. Success is `info["is_success"]` or `info["success"]` where the
    environment gives one; without it, and without the option `success`, no episode succeeds and
    only the returns say something.
    """

    suite: str = "gymnasium"
    """The registered name, for messages."""

    rows: int = 1
    """How many rows the VectorEnv has, if it is one; those of more than one are for a `GymnasiumBatch`."""

    def __init__(
        self,
        task: str | None = None,
        *,
        module: str | None = None,
        kwargs: Mapping[str, Any] | None = None,
        vectorization: str | None = None,
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
            vectorization: How `gymnasium.make_vec` makes a VectorEnv: "sync", "async" (a process for each row), or
                "vector_entry_point"; None makes none, unless the id is registered with a vector entry point alone.
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
        self._id, self._name = task, f"{self.suite}/{task}"
        self._module = module if module is not None else defaults.module
        self._vectorization = vectorization
        self._kwargs = {**defaults.kwargs, **(kwargs or {})}
        self._protocol = defaults.protocol
        self._success = success
        self._unit_actions = unit_actions
        self._remake = remake
        self._ready = False
        self._steps = 0
        self._env = self._make(max_steps)
        try:
            self._instruction = instruction if instruction is not None else defaults.instruction or self._stated_task()
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
                record_size=record_size_of(record_size, self._name),
            )
            self._view = View(self._name, self._env, mapped)
            self._check_vectorized()
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
            **({"autoreset": self._env.autoreset} if isinstance(self._env, VectorRows) else {}),
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

    @classmethod
    def batched(cls, num_envs: int, **options: Any) -> BatchEnv | None:
        """Make the rows of one VectorEnv, if these options make one."""
        if not cls._makes_vectors(options):
            return None
        several: type[Gymnasium] = type(cls.__name__, (cls,), {"rows": num_envs})
        return several(**options)._as_batch()

    @classmethod
    def _makes_vectors(cls, options: Mapping[str, Any]) -> bool:
        task, module = options.get("task"), options.get("module")
        return options.get("vectorization") is not None or (task is not None and only_vectors(task, module))

    def _make(self, max_steps: int | None) -> Any:
        return make(
            self._name,
            self._id,
            module=self._module,
            kwargs=self._kwargs,
            vectorization=self._vectorization,
            rows=self.rows,
            max_steps=max_steps,
        )

    def _as_batch(self) -> GymnasiumBatch:
        return GymnasiumBatch(
            self._name,
            self._env,
            self._view,
            self._contract,
            max_steps=self.max_steps,
            instruction=self._instruction,
            described=self.describe(),
        )

    def _check_vectorized(self) -> None:
        if not isinstance(self._env, VectorRows):
            return
        if self._remake:
            raise ConfigError(f"{self._name}: remake is for environments that are no VectorEnv; leave it out")
        if self._view.renders and self._env.autoreset == "SAME_STEP":
            raise ConfigError(
                f"{self._name}: its VectorEnv resets a row in the step that ends an episode (SAME_STEP), so that the "
                f"last picture of its renderer is the next episode's; choose `cameras` in the observation, or another "
                f"autoreset mode"
            )

    def _stated_task(self) -> str:
        """Return the task in words that the rows of a VectorEnv state as those of LeRobot do; "" if there is none."""
        if not isinstance(self._env, VectorRows):
            return ""
        words = self._env.stated("task_description") or self._env.stated("task")
        return words if isinstance(words, str) else ""

    def _step_limit(self, wanted: int | None) -> int:
        spec = self._env.spec
        limit = wanted or (spec.max_episode_steps if spec is not None else None)
        if limit is None and isinstance(self._env, VectorRows):
            limit = self._env.stated("_max_episode_steps")  # as LeRobot's environments have it
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
        record_size: Sequence[int] | None = None,
    ) -> None:
        """Make the environment; images are stretched to `width` and `height`, pixels."""
        self.require_task(task)
        super().__init__(_ID, **_TASKS[task], width=width, height=height, max_steps=max_steps, record_size=record_size)

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
