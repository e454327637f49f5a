"""Six axes and a button for the gripper, such as those of a keyboard or a SpaceMouse, as actions of a contract."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, MissingState
from vlagents_ray.interface import Obs

_FULLY_OPEN = 0.9  # below this opening, a gripper may hold something
_SPEED = 0.5


class AxesDevice(Protocol):
    """The interface of a device with axes; its methods return at once."""

    def engaged(self) -> bool:
        """Read the device, and return whether the human wants to move the robot."""
        ...

    def axes(self) -> np.ndarray:
        """Return x, y, z, roll, pitch and yaw as read last, (6,), each in [-1, 1]."""
        ...

    def gripper_presses(self) -> int:
        """Return how often the gripper's button has been pressed since the last call."""
        ...


class AxesLeader:
    """A leader that turns the axes of a device into actions.

    Axis i moves number i of the action: for relative actions of an end effector x, y, z and, if the action has them,
    rotations; else the first six joints. The gripper is the last number, if the contract says how it is opened. When
    the human takes over, it is left open if it is fully open; else it is closed, as it may hold something.

    Args:
        contract: The policy's contract, which states `action.dim`, and whether actions are relative.
        device: The device.
        step: The change of a number at a tick with the axis at its end, in the action's units; default: half of the
            action's bound, if actions are relative and bounded.
        measure: Returns the robot's pose in an observation, (D,) in the action's order and units, from which absolute
            targets begin; default: the state's part `joints`, with the gripper's command after it.

    Raises:
        ConfigError: The contract does not say enough, or `step` is missing or not above 0.
    """

    def __init__(
        self,
        contract: Contract | None,
        device: AxesDevice,
        *,
        step: float | None = None,
        measure: Callable[[Obs], np.ndarray] | None = None,
    ) -> None:
        spec = None if contract is None else contract.action
        if spec is None or spec.dim is None or spec.relative is None:
            raise ConfigError(
                "teleoperation: the contract states no action.dim, or not whether actions are relative; want both"
            )
        if step is None and spec.relative and spec.low is not None and spec.high is not None:
            step = _SPEED * min(abs(spec.low), abs(spec.high))
        if step is None or not step > 0:
            raise ConfigError(
                f"step: got {step}, want the change of a number at a tick, above 0; the contract has no bounds of "
                f"relative actions to compute it from"
            )
        self._spec, self._device, self._step = spec, device, step
        self._dim = spec.dim
        self._measure = measure
        self._engaged = False
        self._closed: bool | None = None  # None: as the robot has it when the human takes over
        self._target: np.ndarray | None = None  # of absolute actions

    def engaged(self) -> bool:
        """Read the device, and return whether the human wants to move the robot."""
        engaged = self._device.engaged()
        if engaged and not self._engaged:
            self._closed = self._target = None
        self._engaged = engaged
        return engaged

    def action(self, obs: Obs) -> np.ndarray:
        """Return the action of the axes as read last, (D,) float32."""
        spec, axes = self._spec, self._device.axes()
        gripper = spec.gripper_open is not None and spec.gripper_closed is not None
        moved = np.zeros(self._dim, np.float32)
        n = min(self._dim - gripper, len(axes))
        moved[:n] = self._step * axes[:n]
        command = self._gripper(obs) if gripper else None
        if not spec.relative:
            if self._target is None:
                self._target = self._pose(obs, command)
            moved = self._target + moved
            if spec.low is not None or spec.high is not None:
                moved = np.clip(moved, spec.low, spec.high)
            self._target = moved
        if command is not None:
            moved[-1] = command
        return moved.astype(np.float32)

    def _gripper(self, obs: Obs) -> float:
        if self._closed is None:
            self._closed = obs.gripper is not None and obs.gripper < _FULLY_OPEN
        if self._device.gripper_presses() % 2:
            self._closed = not self._closed
        command = self._spec.gripper_closed if self._closed else self._spec.gripper_open
        return float(command or 0.0)

    def _pose(self, obs: Obs, command: float | None) -> np.ndarray:
        if self._measure is not None:
            return np.array(self._measure(obs), np.float32)
        if "joints" not in obs.state:
            raise MissingState("joints", obs.state)
        joints = obs.state["joints"]
        return np.array([*joints, *([] if command is None else [command])], np.float32)
