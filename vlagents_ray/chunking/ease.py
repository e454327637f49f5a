"""The ease-in of a motion: a slow way from rest to the first action, then the plan's path with rising speed."""

from __future__ import annotations

import numpy as np


class EaseIn:
    """Commands from a pose at rest onto the path of a plan, whose rows are executed later instead of faster.

    For `approach` ticks the command goes straight to the first row, by the quintic of least jerk (Flash & Hogan 1985),
    at rest at both ends. Then the speed along the rows rises from zero to theirs within `ramp` ticks, in which half as
    many rows are executed; so the ramp ends exactly at a row.

    Args:
        start: The pose at rest, (D,); not used for relative actions.
        approach: The number of ticks to the first row; 0 if it is near.
        ramp: The number of ticks until the full speed; an even number.
        relative: Whether actions are deltas, which are then scaled.
    """

    def __init__(self, start: np.ndarray, approach: int, ramp: int, *, relative: bool = False) -> None:
        self._from = start
        self._approach, self._ramp, self._relative = approach, ramp, relative
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
            if self._tick == 0:
                self._from = action
            return command, int(self._tick == 0)
        before, self._place = self._place, self._tick**2 / (2 * self._ramp)
        row = int(self._place)
        if row == int(before):
            share = self._place - before if self._relative else self._place - row
            return self._between(action, share), 0
        if self._relative:
            rest = 0.0 if after is None else (self._place - row) * after
            return np.asarray((row - before) * action + rest, np.float32), 1
        self._from = action
        return self._between(action if after is None else after, self._place - row), 1

    def _between(self, action: np.ndarray, share: float) -> np.ndarray:
        start = 0.0 if self._relative else self._from
        return action if share == 1.0 else np.asarray(start + share * (action - start), np.float32)
