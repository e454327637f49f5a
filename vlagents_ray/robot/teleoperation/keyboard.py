"""A keyboard as a device with axes, read from the terminal, so that it also works over SSH."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from vlagents_ray.errors import ConfigError
from vlagents_ray.robot.terminal import Terminal

if TYPE_CHECKING:
    from typing_extensions import Self

HOLD_S = 0.2
"""How long a key counts as pressed: terminals report no release, and repeat a key that is held."""
AXES = {"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "r": (2, 1), "f": (2, -1)}
AXES |= {"o": (3, 1), "u": (3, -1), "i": (4, 1), "k": (4, -1), "j": (5, 1), "l": (5, -1)}
GRIPPER, TAKE = " ", "\n"
HELP = (
    "w/s a/d r/f move along x, y, z and take over; u/o i/k j/l turn; space opens and closes the gripper; "
    "Enter takes over and gives back"
)


class Keyboard:
    """The keys of a terminal as six axes; any of them takes over, Enter takes over or gives back.

        with Keyboard() as device:
            player = ChunkPlayer(agent, override=AxesLeader(agent.contract, device))

    Args:
        keys: Further keys, and what they do. They are called by the thread of the control loop.
        terminal: The file descriptor of the terminal; default: that of standard input.

    Raises:
        ConfigError: A key is used twice, or there is no terminal.
    """

    def __init__(self, keys: Mapping[str, Callable[[], object]] | None = None, *, terminal: int | None = None) -> None:
        self._keys = dict(keys or {})
        if taken := sorted(self._keys.keys() & {*AXES, GRIPPER, TAKE}):
            raise ConfigError(f"keyboard: {taken} move the robot, so they cannot do something else")
        self._terminal = Terminal(terminal)
        self._until = np.zeros((6, 2))  # s of `time.monotonic`: until when a key counts, for each axis and direction
        self._presses = 0
        self._taken = False
        self._open = contextlib.ExitStack()

    def __enter__(self) -> Self:
        self._open.enter_context(self._terminal.keys_at_once())
        self._open.enter_context(self._terminal.consumed_by(self._press))
        return self

    def __exit__(self, *exc: object) -> None:
        self._open.close()

    def engaged(self) -> bool:
        """Read the keys that were pressed, and return whether the human moves the robot."""
        if not self._terminal.read(self._press):
            raise ConnectionError("the terminal is closed")
        return self._taken

    def axes(self) -> np.ndarray:
        """Return the axes whose keys are pressed, (6,), each -1, 0 or 1."""
        pressed = self._until > time.monotonic()
        return pressed[:, 0].astype(np.float32) - pressed[:, 1]

    def gripper_presses(self) -> int:
        """Return how often the gripper's key has been pressed since the last call."""
        presses, self._presses = self._presses, 0
        return presses

    def _press(self, key: str) -> bool:
        if key in AXES:
            axis, sign = AXES[key]
            side = 0 if sign > 0 else 1
            self._until[axis, side], self._until[axis, 1 - side] = time.monotonic() + HOLD_S, 0.0
            self._taken = True
        elif key == GRIPPER:
            self._presses += 1
            self._taken = True
        elif key == TAKE:
            self._taken = not self._taken
            self._until[:] = 0.0
        elif key in self._keys:
            self._keys[key]()
        else:
            return False
        return True
