"""How observations, actions and infos of a Gymnasium environment become ours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.envs.base import one_row
from vlagents_ray.envs.mapping import RENDER, Pick, as_image, bounds, parts, uniform
from vlagents_ray.envs.recording import Size
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import HIGH_RES, Act, Obs

TERMINATED = "terminated"
SUCCESS_KEYS = ("is_success", "success")


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
    record_size: Size | None


class View:
    """One environment's observations, actions and infos, by its spaces and the user's options."""

    def __init__(self, name: str, env: Any, mapped: Mapped) -> None:
        """Look at the spaces.

        Args:
            name: The environment's name, for messages.
            env: The environment, of which `observation_space`, `action_space` and `render_mode` are read.
            mapped: The user's options.

        Raises:
            ConfigError: An option does not fit the spaces, or actions are no vectors.
        """
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

    @property
    def renders(self) -> bool:
        """Whether a camera is the environment's own renderer."""
        return any(pick.text == RENDER for pick in self._cameras.values())

    def observe(self, nested: Any, render: Callable[[], Any]) -> Obs:
        """Return an observation of the environment as ours; `render` gives the picture of its own renderer."""
        cameras, recorded = {}, {}
        for name, pick in self._cameras.items():
            picture = render() if pick.text == RENDER else pick.value(nested)
            cameras[name] = as_image(picture, name, self._options.size)
            if self._options.record_size is not None:
                recorded[name] = as_image(picture, name, self._options.record_size)
        gripper = None
        if self._gripper is not None:
            share = (self._gripper.number(nested) - self._closed) / (self._open - self._closed)
            gripper = min(max(share, 0.0), 1.0)
        state = {name: pick.vector(nested) for name, pick in self._state.items()}
        return Obs(cameras, gripper, state, {HIGH_RES: recorded} if recorded else {})

    def command(self, act: Act, contract: Contract) -> np.ndarray:
        """Return the action that the environment gets, (D,); raises `InvalidAction` if the policy's is not valid."""
        action = one_row(act, contract).astype(np.float64)
        if self._options.unit_actions:
            action = self._low + (action + 1) / 2 * (self._high - self._low)
        clipped: np.ndarray = np.clip(action, self._low, self._high).astype(self._dtype)
        return clipped

    def idle(self) -> np.ndarray:
        """Return an action for an environment whose episode is over, (D,)."""
        still: np.ndarray = np.clip(np.zeros_like(self._low), self._low, self._high).astype(self._dtype)
        return still

    def succeeded(self, info: Mapping[str, Any], terminated: bool) -> bool:
        """Whether the task is solved after a step."""
        success = self._options.success
        if success == TERMINATED:
            return terminated
        if success is not None:
            return bool(Pick.parse(success).value(info))
        return any(bool(info.get(key, False)) for key in SUCCESS_KEYS)

    def contract(self, obs: Obs, *, instruction: bool, control_hz: float | None) -> Contract:
        """Return the contract of an environment that gives `obs`."""
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
