"""The ease-in of a motion: a slow approach from rest to the first action, then the plan's path with
increasing speed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from vlagents_ray.columns import Columns

_ROUNDING = 1e-9


class EaseIn:
    """Computes commands that lead from a pose at rest onto the path of a plan.

    The rows are executed later, never faster. For `approach` ticks, the command moves straight to
    the first row along the minimum-jerk quintic polynomial (Flash & Hogan 1985), at rest at both
    ends. Then the speed along the rows increases from zero to full speed within `ramp` ticks. Half
    as many rows are executed in these ticks, so the ramp ends exactly at a row. The ramp begins at
    rest, at the first row. If it began earlier, a robot that is already at the first row would
    reach the second row at an arbitrary speed. If too few rows are known, for example with short
    chunks, the ramp has a section for each chunk, which ends exactly at the chunk's last row. Each
    section begins with the final speed of the previous section. If a section cannot reach full
    speed, it ends with a speed at which the next section, with the same number of rows, need not
    brake.

    Args:
        columns: The meaning of the columns: targets are approached, and motions are divided.
        start: The pose at rest, (D,), in the action's units. Its motions are not used.
        approach: The number of ticks until the first row: at least 1 if the row has only targets, 0
            if it may begin at once.
        ramp: The number of ticks until full speed, an even number.
        at_once: The columns of grippers without limits. Their commands are the unchanged values of
            the rows.
    """

    def __init__(
        self,
        columns: Columns,
        start: np.ndarray,
        approach: int,
        ramp: int,
        *,
        at_once: Sequence[int] = (),
    ) -> None:
        self._columns = columns
        self._from = start
        self._approach, self._ramp = approach, ramp
        self._at_once = list(at_once)
        # A row of motions is a motion, so the ramp begins before the row.
        self._is_motion = bool(columns.relative)
        self._tick = -approach  # tick of the ramp, negative during the approach
        self._speed = 0.0 if ramp else 1.0  # rows per tick
        self._rise = 0.0  # increase of the speed per tick
        self._position = 0.0  # the position on the plan, in rows since the beginning of the section
        self._rows = 0  # the number of rows of the section
        self._ticks = 0  # number of ticks that are left in the section

    @property
    def arrived(self) -> bool:
        """Whether the approach to the first row is complete."""
        return self._tick >= 0

    @property
    def over(self) -> bool:
        """Whether full speed is reached."""
        return self.arrived and self._ticks == 0 and self._is_full(self._speed)

    @property
    def may_end(self) -> bool:
        """Whether the next row may be tried at full speed.

        This is true between two sections, once the time of a whole ramp has passed.
        """
        return self._ticks == 0 and self._tick >= self._ramp

    def step(
        self, action: np.ndarray, after: np.ndarray | None, known: int
    ) -> tuple[np.ndarray, int]:
        """Return the command of a tick, and the number of rows that it completes.

        Args:
            action: The next row of the plan, (D,).
            after: The row after `action`, (D,); None if there is none.
            known: The number of rows from `action` to the end of the plan.

        Returns:
            The command, (D,) float32, and 0 or 1.
        """
        self._tick += 1
        if self._tick <= 0:  # the approach
            share = 1.0 + self._tick / self._approach
            share *= share * share * (10.0 - 15.0 * share + 6.0 * share * share)
            command = self._part(action, share, share)
            if self._tick < 0:
                return command, 0
            self._from = action
            return command, 0 if self._is_motion else 1

        if not self._ticks:
            self._begin_section(known)
        before, self._position = self._position, self._next_position()
        row = int(self._position)
        share = self._position - row
        begin = before - int(before)
        if row == int(before):  # The command is still before the next row.
            return self._part(action, begin, share), 0

        command = self._part(action, begin, 1.0)
        self._from = action
        if after is None or share == 0.0:
            # A shorter plan ends the section.
            self._ticks = self._ticks if after is not None else 0
            return command, 1
        return self._columns.joined(command, self._part(after, 0.0, share)), 1

    def _begin_section(self, known: int) -> None:
        """Begin a section of the ramp, which ends at full speed or at the last known row."""
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
        """Return the position after this tick, during which the speed increases evenly."""
        self._ticks -= 1
        position = self._position + self._speed + self._rise / 2
        self._speed += self._rise
        return float(self._rows) if self._ticks == 0 else position

    def _ticks_until_end(self, rows: int) -> int:
        """Return the number of ticks until the last known row.

        The final speed is the largest one that the next section can keep.
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
        """Return the increase of the speed per tick with which the rows are executed in this
        number of ticks.
        """
        return 2 * (rows - ticks * self._speed) / ticks**2

    def _is_full(self, speed: float) -> bool:
        """Return whether a speed is at most one tick's increase below full speed."""
        return speed * self._ramp >= self._ramp - 1 - _ROUNDING

    def _part(self, action: np.ndarray, begin: float, end: float) -> np.ndarray:
        """Return the command for a part of the way to an action, (D,) float32; see
        `Columns.travel`.
        """
        command = self._columns.travel(self._from, action, begin, end)
        command[self._at_once] = action[self._at_once]
        return command
