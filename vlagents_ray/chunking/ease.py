"""The ease-in of a motion: a slow way from rest to the first action, then the plan's path with rising speed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class EaseIn:
    """Commands from a pose at rest onto the path of a plan, whose rows are executed later instead of faster.

    For `approach` ticks the command goes straight to the first row, by the quintic of least jerk (Flash & Hogan 1985),
    at rest at both ends. Then the speed along the rows rises from zero to theirs within `ramp` ticks, in which half as
    many rows are executed; so the ramp ends exactly at a row. The motion begins at rest, at the first row: if the ramp
    began before it, a robot that is already there would meet the second row at an arbitrary speed.

    Args:
        start: The pose at rest, (D,), in the action's units; its deltas are not used.
        approach: The number of ticks to the first row; at least 1 if it is a pose, 0 if it has only deltas.
        ramp: The number of ticks until the full speed; an even number.
        deltas: The columns that are deltas, which are scaled instead of approached.
        at_once: The columns of grippers without limits, which take the values of the rows unchanged.
    """

    def __init__(
        self, start: np.ndarray, approach: int, ramp: int, *, deltas: Sequence[int] = (), at_once: Sequence[int] = ()
    ) -> None:
        self._from = start
        self._approach, self._ramp = approach, ramp
        self._deltas, self._at_once = list(deltas), list(at_once)
        self._is_motion = bool(self._deltas)  # a row of deltas is a motion, so that the ramp begins before it
        self._tick = -approach  # of the ramp
        self._place = 0.0  # on the plan, in rows since the ramp's begin

    @property
    def arrived(self) -> bool:
        """Whether the way to the first row is done."""
        return self._tick >= 0

    @property
    def over(self) -> bool:
        """Whether the full speed is reached."""
        return self._tick >= self._ramp

    def step(self, action: np.ndarray, after: np.ndarray | None) -> tuple[np.ndarray, int]:
        """Return the command of a tick, and the number of rows that it completes.

        Args:
            action: The next row of the plan, (D,).
            after: The row behind it, (D,); None if there is none.

        Returns:
            The command, (D,) float32, and 0 or 1.
        """
        self._tick += 1
        if self._tick <= 0:
            share = 1.0 + self._tick / self._approach
            share *= share * share * (10.0 - 15.0 * share + 6.0 * share * share)
            command = self._between(action, share)
            command[self._deltas] = 0.0
            if self._tick < 0:
                return command, 0
            self._from = action
            return command, 0 if self._is_motion else 1
        before, self._place = self._place, self._tick**2 / (2 * self._ramp)
        row = int(self._place)
        share = self._place - row
        if row == int(before):
            command = self._between(action, share)
            command[self._deltas] = (self._place - before) * action[self._deltas]
            return command, 0
        self._from = action
        if after is None or share == 0.0:
            command = action.copy()
            command[self._deltas] = (row - before) * action[self._deltas]
            return command, 1
        command = self._between(after, share)
        command[self._deltas] = (row - before) * action[self._deltas] + share * after[self._deltas]
        return command, 1

    def _between(self, action: np.ndarray, share: float) -> np.ndarray:
        """Return the pose at a share of the way to an action, (D,) float32."""
        if share == 1.0:
            return action.copy()
        command = np.asarray(self._from + share * (action - self._from), np.float32)
        command[self._at_once] = action[self._at_once]
        return command
