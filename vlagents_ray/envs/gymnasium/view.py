"""How observations, actions and infos of a Gymnasium environment become ours."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import one_row
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Obs
from vlagents_ray.registry import require

TERMINATED = "terminated"
SUCCESS_KEYS = ("is_success", "success")
RENDER = "render"  # instead of a path: the image of the environment's own renderer
_PATH = re.compile(r"(?P<keys>[^\[\]]*?)(?:\[(?P<start>-?\d*):(?P<stop>-?\d*)\])?")


@dataclass(frozen=True, slots=True)
class Mapped:
    """The options of `Gymnasium` that say where things are, which its constructor describes."""

    cameras: Mapping[str, str] | None
    state: Mapping[str, str] | None
    gripper: str | None
    gripper_range: tuple[float, float]
    success: str | None
    unit_actions: bool
    size: tuple[int | None, int | None]  # height, width


class View:
    """One environment's observations, actions and infos, by its spaces and the user's options."""

    def __init__(self, name: str, env: Any, mapped: Mapped) -> None:
        """Read the spaces; raises `ConfigError` if an option does not fit them, or if actions are no vectors."""
        self._options = mapped
        self._low, self._high, self._dtype = bounds(env.action_space)
        if mapped.unit_actions and not np.isfinite([self._low, self._high]).all():
            raise ConfigError(f"{name}: unit_actions needs finite bounds, got {env.action_space}")
        seen_cameras, seen_state = parts(env.observation_space, env.render_mode)
        self._cameras = _picks(mapped.cameras if mapped.cameras is not None else seen_cameras)
        self._state = _picks(mapped.state if mapped.state is not None else seen_state)
        self._gripper = Pick.parse(mapped.gripper) if mapped.gripper is not None else None
        self._closed, self._open = mapped.gripper_range
        if self._closed == self._open:
            raise ConfigError(f"{name}: gripper_range is {mapped.gripper_range}, want two different numbers")

    def observe(self, nested: Any, render: Callable[[], Any]) -> Obs:
        """Return an observation of the environment as ours; `render` gives the picture of its own renderer."""
        cameras = {
            name: as_image(render() if pick.text == RENDER else pick.value(nested), name, self._options.size)
            for name, pick in self._cameras.items()
        }
        gripper = None
        if self._gripper is not None:
            share = (self._gripper.number(nested) - self._closed) / (self._open - self._closed)
            gripper = min(max(share, 0.0), 1.0)
        state = {name: pick.vector(nested) for name, pick in self._state.items()}
        return Obs(cameras, gripper, state)

    def command(self, act: Act, contract: Contract) -> np.ndarray:
        """Return the action that the environment gets, (D,); raises `InvalidAction` if the policy's is not valid."""
        action = one_row(act, contract).astype(np.float64)
        if self._options.unit_actions:
            action = self._low + (action + 1) / 2 * (self._high - self._low)
        clipped: np.ndarray = np.clip(action, self._low, self._high).astype(self._dtype)
        return clipped

    def succeeded(self, info: Mapping[str, Any], terminated: bool) -> bool:
        success = self._options.success
        if success == TERMINATED:
            return terminated
        if success is not None:
            return bool(Pick.parse(success).value(info))
        return any(bool(info.get(key, False)) for key in SUCCESS_KEYS)

    def contract(self, obs: Obs, *, instruction: bool, control_hz: float | None) -> Contract:
        low, high = (-1.0, 1.0) if self._options.unit_actions else (uniform(self._low), uniform(self._high))
        return Contract(
            cameras={name: CameraSpec(*image.shape[:2]) for name, image in obs.cameras.items()},
            state={name: StateSpec(len(part)) for name, part in obs.state.items()},
            gripper=obs.gripper is not None,
            instruction=instruction,
            action=ActionSpec(dim=len(self._low), low=low, high=high),
            control_hz=control_hz,
        )


def _picks(paths: Mapping[str, str]) -> dict[str, Pick]:
    return {name: Pick.parse(path) for name, path in paths.items()}


@dataclass(frozen=True, slots=True)
class Pick:
    """The place of a value in a nested observation: its keys from the outside in, then a range."""

    text: str
    keys: tuple[str, ...]
    part: slice

    @classmethod
    def parse(cls, text: str) -> Pick:
        """`"images/top"`, `"agent_pos"`, `"robot/qpos[0:7]"`, `"[2:]"`; `""` is the observation itself."""
        match = _PATH.fullmatch(text)
        if match is None:
            raise ConfigError(f"path {text!r}: want keys joined by '/', then perhaps a range, as in 'robot/qpos[0:7]'")
        start, stop = (int(match[name]) if match[name] else None for name in ("start", "stop"))
        return cls(text, tuple(key for key in match["keys"].split("/") if key), slice(start, stop))

    def value(self, nested: Any) -> Any:
        """Return the value under the keys, without the range; raises `ConfigError` if there is none."""
        for key in self.keys:
            if not isinstance(nested, Mapping) or key not in nested:
                have = sorted(map(str, nested)) if isinstance(nested, Mapping) else type(nested).__name__
                raise ConfigError(f"path {self.text!r}: there is no {key!r} in {have}")
            nested = nested[key]
        return nested

    def vector(self, nested: Any) -> np.ndarray:
        array = np.array(self.value(nested), dtype=np.float32)
        if array.ndim > 1:
            raise ConfigError(f"path {self.text!r}: got shape {array.shape}, want (D,)")
        found: np.ndarray = np.atleast_1d(array)[self.part]
        if found.size == 0:
            raise ConfigError(f"path {self.text!r}: the range is empty, the value has {array.size} numbers")
        return found

    def number(self, nested: Any) -> float:
        vector = self.vector(nested)
        if vector.size != 1:
            raise ConfigError(f"path {self.text!r}: got {vector.size} numbers, want one, as in '{self.text}[0:1]'")
        return float(vector[0])


def as_image(value: Any, name: str, size: tuple[int | None, int | None] = (None, None)) -> np.ndarray:
    """Return (H, W, 3) uint8 RGB as a new array, stretched to `size` (height, width), px; None keeps a side."""
    image = np.asarray(value)
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ConfigError(f"camera {name!r}: got {image.shape} {image.dtype}, want (H, W, 3) uint8 RGB")
    height, width = size[0] or image.shape[0], size[1] or image.shape[1]
    if (height, width) == image.shape[:2]:
        return np.array(image, order="C")
    pil = require("PIL.Image")
    return np.array(pil.fromarray(np.ascontiguousarray(image)).resize((width, height), pil.Resampling.BILINEAR))


def plain(value: Any) -> Any:
    """Convert a value to one that a message can carry: numpy scalars to Python's, tuples to lists, keys to strings.

    Other values (objects, functions) become None; mappings omit None.
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
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    return None


def bounds(space: Any) -> tuple[np.ndarray, np.ndarray, np.dtype[Any]]:
    """Return the bounds of a Box (D,), float64, and its dtype."""
    if type(space).__name__ != "Box" or len(space.shape) != 1:
        raise ConfigError(
            f"action space: got {space}, want Box (D,): policies give continuous vectors; "
            f"wrap the environment, and register it so wrapped"
        )
    return space.low.astype(np.float64), space.high.astype(np.float64), space.dtype


def uniform(bounds: np.ndarray) -> float | None:
    """Return the bound that all components share; None if they differ or are infinite."""
    return float(bounds[0]) if np.isfinite(bounds).all() and (bounds == bounds[0]).all() else None


def parts(space: Any, render_mode: str | None) -> tuple[dict[str, str], dict[str, str]]:
    """Return the cameras and state parts of an observation space, with a rendered camera if it has no image."""
    cameras: dict[str, str] = {}
    state: dict[str, str] = {}
    pending = [("", space)]
    while pending:
        path, one = pending.pop(0)
        if isinstance(one, Mapping):  # gymnasium.spaces.Dict is one
            pending += [(f"{path}/{key}" if path else str(key), sub) for key, sub in one.items()]
        elif one.dtype == np.uint8 and len(one.shape) == 3 and one.shape[2] == 3:
            cameras[path or "front"] = path
        elif type(one).__name__ == "Box" and len(one.shape) == 1:
            state[path or "state"] = path
    if not cameras and render_mode == "rgb_array":
        cameras["front"] = RENDER
    return cameras, state
