"""A SpaceMouse as a device with axes; it needs the extra "spacemouse"."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require

if TYPE_CHECKING:
    from typing_extensions import Self

_DEAD = 0.1  # of the range: the cap never rests exactly in the middle
_REPORTS = 64  # the device sends more reports than a loop has ticks; so many are read at one


class SpaceMouse:
    """The cap of a SpaceMouse as six axes: pushed forward, left and up is +x, +y, +z, as ROS has them (REP 103).

    Moving it takes over, its first button opens and closes the gripper, and its last one takes over or gives back.

    Raises:
        ConfigError: There is no such device, or it may not be read.
        MissingDependency: The extra "spacemouse" is not installed.
    """

    def __init__(self) -> None:
        try:
            library: Any = require("pyspacemouse")
            self._device: Any = library.open(axis_convention=library.AxisConvention.ROS)
        except (OSError, RuntimeError) as error:  # also of hidapi, which the library loads
            raise ConfigError(
                f"SpaceMouse: {error}; plug one in, install hidapi (Debian: libhidapi-hidraw0), and let this user read "
                "its /dev/hidraw"
            ) from error
        self._axes = np.zeros(6, np.float32)
        self._buttons: list[int] = []
        self._presses = 0
        self._taken = False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self._device.close()

    def engaged(self) -> bool:
        """Read the device, and return whether the human wants to move the robot."""
        read = None
        for _ in range(_REPORTS):
            state = self._device.read()
            if state.t == read:
                break
            read = state.t
            self._note(list(state.buttons))
        axes = np.array([state.x, state.y, state.z, state.roll, state.pitch, state.yaw], np.float32)
        self._axes = np.where(np.abs(axes) < _DEAD, 0, np.clip(axes, -1, 1)).astype(np.float32)
        self._taken = self._taken or bool(self._axes.any())
        return self._taken

    def axes(self) -> np.ndarray:
        """Return the axes as read last, (6,), each in [-1, 1]."""
        return self._axes

    def gripper_presses(self) -> int:
        """Return how often the gripper's button has been pressed since the last call."""
        presses, self._presses = self._presses, 0
        return presses

    def _note(self, buttons: list[int]) -> None:
        before = self._buttons or [0] * len(buttons)
        pressed = [now > then for now, then in zip(buttons, before, strict=True)]
        self._buttons = buttons
        if pressed and pressed[0]:
            self._presses += 1
            self._taken = True
        if len(pressed) > 1 and pressed[-1]:
            self._taken = not self._taken
