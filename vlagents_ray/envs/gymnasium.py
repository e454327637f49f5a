"""Gymnasium environments with the interface of `EvalEnv`, and PushT with its published protocol.

An environment is named `gymnasium/<id>`, for instance `gymnasium/Pendulum-v1` or
`gymnasium/gym_pusht/PushT-v0`. The adapter finds images and vectors in the observation space
automatically, and renders an environment that has no images. All other properties are options of
`Gymnasium`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import EvalEnv, one_row, require_known
from vlagents_ray.envs.graphics import prepare_rendering
from vlagents_ray.envs.simulator import BenchmarkProtocol, without
from vlagents_ray.errors import (
    ConfigError,
    EnvFailed,
    MissingDependency,
    NotReset,
    UnknownEnv,
    VLAgentsError,
)
from vlagents_ray.interface import Act, Obs
from vlagents_ray.naming import did_you_mean
from vlagents_ray.registry import pip_install, require

SUCCESS_KEYS = ("is_success", "success")
_SAME_RATE = 0.001  # largest relative difference of two statements of one rate
RENDER = "render"  # path that selects the image that the environment renders
_PATH = re.compile(r"(?P<keys>[^\[\]]*?)(?:\[(?P<start>-?\d*):(?P<stop>-?\d*)\])?")


@dataclass(frozen=True, slots=True)
class Defaults:
    """Defaults of the options of `Gymnasium` for one id; None selects the environment's values."""

    module: str | None = None  # the module that registers the id, to be imported
    kwargs: Mapping[str, Any] = field(default_factory=dict)
    cameras: Mapping[str, str] | None = None
    instruction: str = ""
    control_hz: float | None = None
    protocol: BenchmarkProtocol | None = None


def defaults_for(task: str) -> Defaults:
    """Return the default options for a Gymnasium id; empty for an unknown id."""
    if task == "gym_pusht/PushT-v0":
        return _PUSHT
    fetch = re.fullmatch(r"Fetch(\w+?)(?:Dense)?-v\d+", task)
    if fetch is None or fetch[1] not in _FETCH_INSTRUCTIONS:
        return Defaults()
    return Defaults(
        module="gymnasium_robotics",
        instruction=_FETCH_INSTRUCTIONS[fetch[1]],
        control_hz=_FETCH.control_hz,
        protocol=_FETCH,
    )


_PUSHT = Defaults(
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
        metric="success_once",
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
    metric="success_at_end",
    begins="where object and target are: the seed's",
    ends_on_success=False,
)


class Gymnasium(EvalEnv):
    """A Gymnasium environment with a continuous action vector, Box (D,).

    Actions are clipped to the Box. Success is `info["is_success"]` or `info["success"]`. If an
    episode ends without either, the last `step` raises `ConfigError`: the option `success` must
    then be set.
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
        """Create the environment, and check one of its observations.

        Args:
            task: The Gymnasium id.
            module: The module that registers the id; by default the id's namespace.
            kwargs: Arguments of `gymnasium.make`; `render_mode` is "rgb_array" by default.
            cameras: Name of the camera -> path of an (H, W, 3) uint8 image in the observation, or
                "render".
            state: Name of the state part -> path of a vector, optionally with a range:
                "robot/qpos[0:7]"; see `Pick`.
            gripper: The path of a number in the observation.
            gripper_range: The values of the gripper's number when the gripper is closed and when it
                is open.
            success: The path of a bool in the step's info, or "terminated"; by default, one of
                `SUCCESS_KEYS`.
            instruction: The task in words.
            control_hz: The rate of the steps, Hz; only for an id whose rate is not known.
            unit_actions: Whether actions are in [-1, 1] and are scaled to the Box.
            width: The width to which every image is stretched, pixels.
            height: The height to which every image is stretched, pixels.
            max_steps: The step limit; default: the limit with which the id is registered.
            remake: Whether each reset creates the simulator again, for simulators whose `reset`
                does not reset the whole state.

        Raises:
            UnknownEnv: The id is unknown.
            ConfigError: An option does not fit the environment.
            MissingDependency: The simulator is not installed.
            EnvFailed: The simulator cannot be created.
        """
        if task is None:
            raise UnknownEnv(
                "gymnasium: expected an id, as in 'gymnasium/Pendulum-v1', got none; add it to "
                "the name"
            )

        prepare_rendering()
        defaults = defaults_for(task)
        self._id, self._name = task, f"gymnasium/{task}"
        self._module = module if module is not None else defaults.module
        self._kwargs = {**defaults.kwargs, **(kwargs or {})}
        self._protocol = defaults.protocol
        self._instruction = instruction if instruction is not None else defaults.instruction
        self._success, self._unit_actions, self._remake = success, unit_actions, remake
        self._size = (height, width)
        self._ready = False
        self._steps = 0
        self._has_success = False  # whether a step of the episode has reported success or failure
        if success is not None:
            _require_whole(Pick.parse(success))
        self._env = self._make(max_steps)

        try:
            self.max_steps = self._step_limit(max_steps)
            self._action_space = str(self._env.action_space)
            self._low, self._high, self._dtype = bounds(self._env.action_space)
            if unit_actions and not np.isfinite([self._low, self._high]).all():
                raise ConfigError(
                    f"{self._name}: unit_actions: expected an action space with finite bounds, "
                    f"got {self._env.action_space}; leave it out"
                )

            space_cameras, space_state = camera_and_state_paths(
                self._env.observation_space, self._env.render_mode
            )
            if cameras is None:
                cameras = defaults.cameras
            self._cameras = _picks(cameras if cameras is not None else space_cameras)
            for pick in self._cameras.values():
                _require_whole(pick)
            self._state = _picks(state if state is not None else space_state)

            self._gripper = Pick.parse(gripper) if gripper is not None else None
            self._closed, self._open = gripper_range
            if self._closed == self._open:
                raise ConfigError(
                    f"{self._name}: gripper_range: expected two different numbers, got "
                    f"{gripper_range}"
                )

            nested, _ = self._call("reset", seed=0)
            hz = self._control_hz(defaults.control_hz, control_hz)
            self._contract = self._make_contract(self._observe(nested), hz)
        except BaseException:
            self.close()
            raise

    def _control_hz(self, published: float | None, chosen: float | None) -> float | None:
        """Return the rate of the steps, Hz: the published rate of the id, the rate of a simulation
        in MuJoCo, or the option `control_hz`, which must not contradict the other two.
        """
        known = published
        inner = self._env.unwrapped
        if known is None and hasattr(inner, "frame_skip") and hasattr(inner, "dt"):
            known = 1.0 / float(inner.dt)  # MujocoEnv: the duration of a step, s
        if known is None or chosen is None:
            return chosen or known
        if abs(chosen / known - 1) > _SAME_RATE:
            raise ConfigError(
                f"{self._name}: control_hz: expected {known:g}, the rate of its steps, got "
                f"{chosen:g}; leave it out"
            )
        return known

    def _step_limit(self, max_steps: int | None) -> int:
        """Return `max_steps` or, if it is None, the limit with which the id is registered."""
        spec = self._env.spec
        limit = max_steps or (spec.max_episode_steps if spec is not None else None)
        if limit is None or limit < 1:
            raise ConfigError(
                f"{self._name}: its step limit is {limit}; set `max_steps` to 1 or more"
            )
        return int(limit)

    @classmethod
    def not_installed(cls) -> str | None:
        return without(("gymnasium",), pip_install("sim"))

    @property
    def contract(self) -> Contract:
        return self._contract

    @property
    def instruction(self) -> str:
        return self._instruction

    def describe(self) -> dict[str, Any]:
        """Return the id, the versions, the settings, and their deviations from the protocol."""
        settings = {"max_steps": self.max_steps, "control_hz": self._contract.control_hz}
        protocol = settings if self._protocol is None else self._protocol.describe(**settings)
        return {
            "id": self._id,
            "gymnasium": require("gymnasium").__version__,
            "kwargs": plain(self._kwargs),
            "action_space": self._action_space,
            "unit_actions": self._unit_actions,
            "success": self._success or f"info: {' or '.join(SUCCESS_KEYS)}",
            "protocol": protocol,
        }

    def reset(
        self, *, seed: int, options: Mapping[str, Any] | None = None
    ) -> tuple[Obs, dict[str, Any]]:
        """Begin an episode.

        Args:
            seed: The seed, 0 or more.
            options: The options of the environment's `reset`.

        Returns:
            The first observation, and the info of the environment.
        """
        if seed < 0:
            raise ConfigError(f"{self._name}: seed: expected a number from 0, got {seed}")
        if self._env is None:
            raise NotReset(f"{self._name}: is closed; create it again")

        if self._remake:
            self._call("close")
            self._env = self._make(self.max_steps)
        nested, info = self._call("reset", seed=seed, options=dict(options) if options else None)
        self._ready, self._steps, self._has_success = True, 0, False
        return self._observe(nested), plain(info)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        """Execute an action, (D,), clipped to the action space; see `EvalEnv.step`."""
        if not self._ready:
            raise NotReset(
                f"{self._name}: step was called before reset; call reset(seed=...) first"
            )

        action = one_row(act, self._contract).astype(np.float64)
        if self._unit_actions:
            action = self._low + (action + 1) / 2 * (self._high - self._low)
        action = np.clip(action, self._low, self._high).astype(self._dtype)
        nested, reward, terminated, truncated, info = self._call("step", action)
        self._steps += 1

        success = self._is_success(terminated, info)
        is_truncated = bool(truncated) or self._steps >= self.max_steps
        if (terminated or is_truncated) and not self._has_success:
            raise ConfigError(
                f"{self._name}: expected {' or '.join(map(repr, SUCCESS_KEYS))} in the info of a "
                f"step, got an episode of {self._steps} steps without either, the last one with "
                f"{sorted(map(str, info))}; set `success` in env_options (--env-set) to the path "
                "of a bool in the info, or to 'terminated'"
            )
        # Render images even if they are not used, since rendering changes the state of some envs,
        # such as the target in the Fetch tasks.
        obs = self._observe(nested)
        info = {**plain(info), "success": success}
        return obs, float(reward), bool(terminated), is_truncated, info

    def _is_success(self, terminated: Any, info: Mapping[str, Any]) -> bool:
        """Return whether the task is solved after a step."""
        if self._success == "terminated":
            values = [terminated]
        elif self._success is not None:
            values = [Pick.parse(self._success).value(info)]
        else:
            values = [info[key] for key in SUCCESS_KEYS if key in info]

        self._has_success = self._has_success or bool(values)
        return any(self._truth(value) for value in values)

    def _truth(self, value: Any) -> bool:
        """Return a reported success as a bool; 0 and 1 are accepted, but a score or a text is
        not.
        """
        array = np.asarray(value)
        if array.size != 1 or array.dtype.kind not in "biuf" or array.item() not in (0, 1):
            raise ConfigError(
                f"{self._name}: success: expected a bool in the info of a step, got {value!r}; set "
                "`success` in env_options to the path of another value, or to 'terminated'"
            )
        return bool(array.item())

    def close(self) -> None:
        """Close the environment; safe to call twice."""
        self._ready = False
        if self._env is not None:
            env, self._env = self._env, None
            env.close()

    def _make(self, max_steps: int | None) -> Any:
        """Create Gymnasium's environment, and convert its errors to errors of this package."""
        # Otherwise Pygame, the renderer of several environments, prints a greeting on import.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        gymnasium = require("gymnasium")
        module = self._module
        if not module and self._id not in gymnasium.registry:
            module = self._id.rpartition("/")[0].partition(":")[0]  # the namespace of the id
        if module:
            require(module)

        arguments = {"render_mode": "rgb_array", "disable_env_checker": True, **self._kwargs}
        try:
            return gymnasium.make(self._id, max_episode_steps=max_steps, **arguments)
        except gymnasium.error.DependencyNotInstalled as error:
            raise MissingDependency(f"{self._name}: {error}") from error
        except gymnasium.error.UnregisteredEnv as error:
            hint = did_you_mean(self._id.rpartition("/")[2], gymnasium.registry)
            raise UnknownEnv(
                f"{self._name}: {error}; gymnasium/MODULE:ID imports the module that registers "
                f"it{hint}"
            ) from error
        except gymnasium.error.Error as error:
            raise ConfigError(f"{self._name}: {error}") from error
        except TypeError as error:
            raise ConfigError(
                f"{self._name}: {error}; check `kwargs`, got {self._kwargs}"
            ) from error

    def _call(self, method: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method of the environment, and convert its errors to `EnvFailed`."""
        try:
            return getattr(self._env, method)(*args, **kwargs)
        except VLAgentsError:
            raise
        except Exception as error:
            raise EnvFailed(
                f"{self._name}: {method} raised {type(error).__name__}: {error}"
            ) from error

    def _observe(self, nested: Any) -> Obs:
        """Convert an observation of the environment to an `Obs`."""
        cameras = {}
        for name, pick in self._cameras.items():
            image = self._call("render") if pick.text == RENDER else pick.value(nested)
            cameras[name] = as_image(image, name, self._size)

        gripper = None
        if self._gripper is not None:
            travel = self._gripper.number(nested) - self._closed
            gripper = min(max(travel / (self._open - self._closed), 0.0), 1.0)

        state = {name: pick.vector(nested) for name, pick in self._state.items()}
        return Obs(cameras, gripper, state)

    def _make_contract(self, obs: Obs, control_hz: float | None) -> Contract:
        """Return the contract that describes an observation, and the actions."""
        low, high = uniform(self._low), uniform(self._high)
        if self._unit_actions:
            low, high = -1.0, 1.0
        return Contract(
            cameras={name: CameraSpec(*image.shape[:2]) for name, image in obs.cameras.items()},
            state={name: StateSpec(len(vector)) for name, vector in obs.state.items()},
            gripper=obs.gripper is not None,
            instruction=bool(self._instruction),
            action=ActionSpec(dim=len(self._low), low=low, high=high),
            control_hz=control_hz,
        )


_ID = "gym_pusht/PushT-v0"
# Options of `Gymnasium` that select the observations of each task.
_TASKS: dict[str, Mapping[str, Any]] = {
    "image": {},
    "keypoints": {"kwargs": {"obs_type": "environment_state_agent_pos"}, "cameras": {}},
}


class PushT(Gymnasium):
    """PushT with its published protocol, "image" or "keypoints".

    Observation: `state["agent_pos"]`, (2,), in pixels of the field of 512 by 512 pixels. "image"
    also has the camera "front", (96, 96, 3) by default. "keypoints" also has
    `state["environment_state"]`, (16,), x and y of eight points of the block, in pixels.
    `info["sim_state"]`, (7,) float64, is the simulator's state: x, y and velocity of the agent,
    pixels and pixels/s; x, y and angle of the block, pixels and rad.

    Action: (2,) in [0, 512]: the target position of the agent, a disc, in the same pixels.
    """

    known = tuple(_TASKS)

    def __init__(
        self,
        task: str = "image",
        *,
        width: int | None = None,
        height: int | None = None,
        max_steps: int | None = None,
    ) -> None:
        """Create the environment; images are stretched to `width` and `height`, pixels."""
        self.require_task(task)
        super().__init__(_ID, **_TASKS[task], width=width, height=height, max_steps=max_steps)

    @classmethod
    def require_task(cls, task: str | None) -> None:
        require_known("pusht", task or "image", cls.tasks())

    @classmethod
    def not_installed(cls) -> str | None:
        return without(("gym_pusht",), pip_install("pusht"))

    def _observe(self, nested: Any) -> Obs:
        obs = super()._observe(nested)
        agent, block = self._env.unwrapped.agent, self._env.unwrapped.block
        obs.info["sim_state"] = np.array(
            [*agent.position, *agent.velocity, *block.position, block.angle]
        )
        return obs


def _require_whole(pick: Pick) -> None:
    """Raise `ConfigError` if a range is given for a value that is used as a whole."""
    if pick.range != slice(None):
        raise ConfigError(
            f"path {pick.text!r}: expected no range, as an image or success has no numbers to "
            "choose from, got one; leave it out"
        )


def _picks(paths: Mapping[str, str]) -> dict[str, Pick]:
    return {name: Pick.parse(path) for name, path in paths.items()}


@dataclass(frozen=True, slots=True)
class Pick:
    """The path of a value in a nested observation, and the range of its numbers."""

    text: str  # the path as written in the options of `Gymnasium`
    keys: tuple[str, ...]  # keys, from the outermost to the innermost
    range: slice

    @classmethod
    def parse(cls, text: str) -> Pick:
        """Parse a path.

        Args:
            text: The path, such as `"images/top"`, `"agent_pos"`, `"robot/qpos[0:7]"` or `"[2:]"`;
                `""` is the whole observation.

        Raises:
            ConfigError: The text is not a path.
        """
        match = _PATH.fullmatch(text)
        if match is None:
            raise ConfigError(
                f"path {text!r}: expected keys joined by '/', and optionally a range, as in "
                "'robot/qpos[0:7]'; correct it"
            )

        keys = tuple(key for key in match["keys"].split("/") if key)
        start, stop = (int(match[name]) if match[name] else None for name in ("start", "stop"))
        return cls(text, keys, slice(start, stop))

    def value(self, nested: Any) -> Any:
        """Return the whole value under the keys; raises `ConfigError` if a key is missing."""
        for key in self.keys:
            if not isinstance(nested, Mapping):
                kind = type(nested).__name__
                raise ConfigError(f"path {self.text!r}: there is no {key!r} in {kind}")
            if key not in nested:
                have = sorted(map(str, nested))
                raise ConfigError(f"path {self.text!r}: there is no {key!r} in {have}")
            nested = nested[key]
        return nested

    def vector(self, nested: Any) -> np.ndarray:
        """Return the selected range of the value, (D,) float32; raises `ConfigError` if the value
        is not a vector.
        """
        array = np.array(self.value(nested), dtype=np.float32)
        if array.ndim > 1:
            raise ConfigError(
                f"path {self.text!r}: expected a vector (D,), got shape {array.shape}; choose "
                "another path"
            )
        numbers: np.ndarray = np.atleast_1d(array)[self.range]
        # Python cuts a range to the numbers that there are.
        ends = [end for end in (self.range.start, self.range.stop) if end is not None]
        if any(not -array.size <= end <= array.size for end in ends):
            raise ConfigError(
                f"path {self.text!r}: expected a range within the {array.size} numbers of the "
                "value, got a longer one; correct it"
            )
        if numbers.size == 0:
            raise ConfigError(
                f"path {self.text!r}: the range is empty, the value has {array.size} numbers"
            )
        return numbers

    def number(self, nested: Any) -> float:
        """Return the selected range of the value as a number; raises `ConfigError` if it has
        several numbers.
        """
        vector = self.vector(nested)
        if vector.size != 1:
            raise ConfigError(
                f"path {self.text!r}: expected one number, as in '{self.text}[0:1]', got "
                f"{vector.size}; add a range"
            )
        return float(vector[0])


def as_image(
    value: Any, name: str, size: tuple[int | None, int | None] = (None, None)
) -> np.ndarray:
    """Copy an image to an array (H, W, 3) uint8 RGB, and stretch it to a size.

    Args:
        value: The image.
        name: The camera, for errors.
        size: Height and width, px; None keeps the height or width.

    Raises:
        ConfigError: The value is not an RGB image.
    """
    image = np.asarray(value)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ConfigError(
            f"camera {name!r}: expected (H, W, 3) uint8 RGB, got {image.shape} {image.dtype}"
        )
    height, width = size[0] or image.shape[0], size[1] or image.shape[1]
    if (height, width) == image.shape[:2]:
        return np.array(image, order="C")
    pil = require("PIL.Image")
    picture = pil.fromarray(np.ascontiguousarray(image))
    return np.array(picture.resize((width, height), pil.Resampling.BILINEAR))


def plain(value: Any) -> Any:
    """Convert a value to a value that can be sent in a message.

    Scalars of numpy become numbers of Python, tuples become lists, and keys become strings. Other
    values (objects, functions) become None. Items of mappings are omitted if they are None.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (bool, int, float, str, bytes)):
        return value
    if isinstance(value, np.ndarray):
        return value.copy() if value.dtype.kind in "biuf" else plain(value.tolist())
    if isinstance(value, Mapping):
        converted = {str(key): plain(item) for key, item in value.items()}
        return {key: item for key, item in converted.items() if item is not None}
    return [plain(item) for item in value] if isinstance(value, (list, tuple)) else None


def bounds(space: Any) -> tuple[np.ndarray, np.ndarray, np.dtype[Any]]:
    """Return the bounds of a Box (D,), float64, and its dtype."""
    if type(space).__name__ != "Box" or len(space.shape) != 1:
        raise ConfigError(
            f"action space: expected Box (D,), as policies return continuous vectors, got {space}; "
            f"wrap the environment, and register the wrapped environment"
        )
    return space.low.astype(np.float64), space.high.astype(np.float64), space.dtype


def uniform(bounds: np.ndarray) -> float | None:
    """Return the bound that all components share; None if they differ or are infinite."""
    return float(bounds[0]) if np.isfinite(bounds).all() and (bounds == bounds[0]).all() else None


def camera_and_state_paths(
    space: Any, render_mode: str | None
) -> tuple[dict[str, str], dict[str, str]]:
    """Return the paths of the images and the vectors in an observation space.

    Args:
        space: A space of Gymnasium.
        render_mode: The render mode of the environment.

    Returns:
        Two mappings: camera -> path of its image, and state part -> path of its vector. If there is
        no image, the environment's renderer is the camera "front".
    """
    cameras: dict[str, str] = {}
    state: dict[str, str] = {}
    pending = [("", space)]
    while pending:
        path, subspace = pending.pop(0)
        if isinstance(subspace, Mapping):  # gymnasium.spaces.Dict is a Mapping
            for key, value in subspace.items():
                pending.append((f"{path}/{key}" if path else str(key), value))
        elif subspace.dtype == np.uint8 and len(subspace.shape) == 3 and subspace.shape[2] == 3:
            cameras[path or "front"] = path
        elif type(subspace).__name__ == "Box" and len(subspace.shape) == 1:
            state[path or "state"] = path
    if not cameras and render_mode == "rgb_array":
        cameras["front"] = RENDER
    return cameras, state
