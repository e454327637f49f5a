"""The ease-in of a motion: a slow way from rest to the first action, then the plan's path with
rising speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

_ROUNDING = 1e-9


class EaseIn:
    """Commands from a pose at rest onto the path of a plan, whose rows are executed later instead
    of faster.

    For `approach` ticks the command goes straight to the first row, by the quintic of least jerk
    (Flash & Hogan 1985), at rest at both ends. Then the speed along the rows rises from zero to
    theirs within `ramp` ticks, in which half as many rows are executed; so the ramp ends exactly at
    a row. The motion begins at rest, at the first row: if the ramp began before it, a robot that is
    already there would meet the second row at an arbitrary speed.

    If fewer rows are known, such as those of a short chunk, the ramp has a section for each chunk,
    which ends exactly at its last row. The next section begins with the speed of the last one. If
    the full speed is out of reach, a section ends with a speed at which the next one, for as many
    rows, need not brake.

    Args:
        start: The pose at rest, (D,), in the action's units; its deltas are not used.
        approach: The number of ticks to the first row; at least 1 if it is a pose, 0 if it has only
            deltas.
        ramp: The number of ticks until the full speed; an even number.
        deltas: The columns that are deltas, which are scaled instead of approached.
        at_once: The columns of grippers without limits, which take the values of the rows
            unchanged.
    """

    def __init__(
        self,
        start: np.ndarray,
        approach: int,
        ramp: int,
        *,
        deltas: Sequence[int] = (),
        at_once: Sequence[int] = (),
    ) -> None:
        self._from = start
        self._approach, self._ramp = approach, ramp
        self._deltas, self._at_once = list(deltas), list(at_once)
        # A row of deltas is a motion, so that the ramp begins before it.
        self._is_motion = bool(self._deltas)
        self._tick = -approach  # the tick of the ramp; negative during the approach
        self._speed = 0.0 if ramp else 1.0  # rows a tick
        self._rise = 0.0  # the increase of the speed a tick
        self._position = 0.0  # the position on the plan, in rows since the beginning of the section
        self._rows = 0  # the number of rows of the section
        self._ticks = 0  # the number of ticks that are left of the section

    @property
    def arrived(self) -> bool:
        """Whether the way to the first row is done."""
        return self._tick >= 0

    @property
    def over(self) -> bool:
        """Whether the full speed is reached."""
        return self.arrived and self._ticks == 0 and self._is_full(self._speed)

    @property
    def may_end(self) -> bool:
        """Whether the next row may be tried at full speed: between two sections, after the time
        of a whole ramp.
        """
        return self._ticks == 0 and self._tick >= self._ramp

    def step(
        self, action: np.ndarray, after: np.ndarray | None, known: int
    ) -> tuple[np.ndarray, int]:
        """Return the command of a tick, and the number of rows that it completes.

        Args:
            action: The next row of the plan, (D,).
            after: The row behind it, (D,); None if there is none.
            known: The number of rows from `action` to the end of the plan.

        Returns:
            The command, (D,) float32, and 0 or 1.
        """
        self._tick += 1
        if self._tick <= 0:  # the approach
            share = 1.0 + self._tick / self._approach
            share *= share * share * (10.0 - 15.0 * share + 6.0 * share * share)
            command = self._between(action, share)
            command[self._deltas] = 0.0
            if self._tick < 0:
                return command, 0
            self._from = action
            return command, 0 if self._is_motion else 1

        if not self._ticks:
            self._begin_section(known)
        before, self._position = self._position, self._next_position()
        row = int(self._position)
        share = self._position - row
        if row == int(before):  # before the next row
            command = self._between(action, share)
            command[self._deltas] = (self._position - before) * action[self._deltas]
            return command, 0

        self._from = action
        if after is None or share == 0.0:
            self._ticks = self._ticks if after is not None else 0  # a shorter plan ends the section
            command = action.copy()
            command[self._deltas] = (row - before) * action[self._deltas]
            return command, 1

        command = self._between(after, share)
        command[self._deltas] = (row - before) * action[self._deltas] + share * after[self._deltas]
        return command, 1

    def _begin_section(self, known: int) -> None:
        """Begin the section of the ramp that ends at full speed, or at the last known row."""
        self._position = 0.0
        first = math.ceil((1.0 - self._speed**2) * self._ramp / 2)
        for rows in range(max(1, first), known + 1):
            ticks = math.ceil(2 * rows / (1.0 + self._speed))
            rise = self._rise_of(rows, ticks)
            if 0.0 <= rise * self._ramp <= 1.0 + _ROUNDING and self._is_full(
                self._speed + ticks * rise
            ):
                self._rows, self._ticks, self._rise = rows, ticks, rise
                return

        self._rows, self._ticks = known, self._ticks_until_end(known)
        self._rise = self._rise_of(self._rows, self._ticks)

    def _next_position(self) -> float:
        """Return the position after this tick, during which the speed rises evenly."""
        self._ticks -= 1
        position = self._position + self._speed + self._rise / 2
        self._speed += self._rise
        return float(self._rows) if self._ticks == 0 else position

    def _ticks_until_end(self, rows: int) -> int:
        """Return the ticks until the last known row, with the largest speed that the next
        section can keep.
        """
        ticks = 1
        while ticks * self._speed + ticks**2 / (2 * self._ramp) < rows - _ROUNDING:
            ticks += 1
        while (ticks + 1) * self._speed <= rows:
            speed = self._speed + ticks * self._rise_of(rows, ticks)
            again = math.floor(rows / speed)
            if speed <= 1.0 and again and rows - again * speed <= again**2 / (2 * self._ramp):
                break
            ticks += 1
        return ticks

    def _rise_of(self, rows: int, ticks: int) -> float:
        """Return the rise of the speed a tick, with which these ticks execute the rows."""
        return 2 * (rows - ticks * self._speed) / ticks**2

    def _is_full(self, speed: float) -> bool:
        """Return whether a speed is within one rise of that of the rows."""
        return speed * self._ramp >= self._ramp - 1 - _ROUNDING

    def _between(self, action: np.ndarray, share: float) -> np.ndarray:
        """Return the pose at a share of the way to an action, (D,) float32."""
        if share == 1.0:
            return action.copy()
        command = np.asarray(self._from + share * (action - self._from), np.float32)
        command[self._at_once] = action[self._at_once]
        return command
