"""The ease-in of a motion: a slow approach from rest to the first action, then the plan's path with
increasing speed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from vlagents_ray.columns import Columns

_ROUNDING = 1e-9
# A policy at 90 % of the limits of speed needs five ramps to catch up. A policy beyond the limits
# never does; its next row is then checked at full speed, and rejected.
_RAMPS, _LEAST_TICKS = 10, 50
# Speed, acceleration and jerk are differences of up to three rows.
_FULL_ROWS = 3


class EaseIn:
    """Computes commands that lead from a pose at rest onto the path of a plan.

    For `approach` ticks, the command moves straight to the first row along the minimum-jerk quintic
    polynomial (Flash & Hogan 1985), at rest at both ends. Then the speed along the rows increases
    from zero to full speed within `ramp` ticks. Half as many rows are executed in these ticks, so
    the ramp ends exactly at a row. The ramp begins at rest, at the first row. If it began earlier,
    a robot that is already at the first row would reach the second row at an arbitrary speed. In
    the approach and the ramp, rows are executed later, never faster.

    If too few rows are known for a ramp, as with single actions or short chunks, the command
    catches up with the plan instead: at each tick it moves as far towards the newest row as the
    limits allow (`largest_share`), so that its speed rises from tick to tick. Targets advance by a
    row at each tick, as the policy expects them to. Motions are divided, and a row of motions ends
    when all of it was executed. The ease-in is over as soon as three rows in a row were executed at
    full speed: from then on, speed, acceleration and jerk depend on the policy alone.

    Args:
        columns: The meaning of the columns: targets are approached, and motions are divided.
        start: The pose at rest, (D,), in the action's units. Its motions are not used.
        approach: The number of ticks until the first row: at least 1 if the row has only targets, 0
            if it may begin at once.
        ramp: The number of ticks until full speed, an even number.
        largest_share: Returns the largest share of the way from the last command, (D,), to a row,
            (D,), that the limits allow at this tick, in [0, 1]; also gets the row before, (D,).
        at_once: The columns of grippers without limits. Their commands are the unchanged values of
            the rows.
    """

    def __init__(
        self,
        columns: Columns,
        start: np.ndarray,
        approach: int,
        ramp: int,
        largest_share: Callable[[np.ndarray, np.ndarray, np.ndarray], float],
        *,
        at_once: Sequence[int] = (),
    ) -> None:
        self._columns = columns
        self._from = start
        self._approach, self._ramp = approach, ramp
        self._largest_share = largest_share
        self._at_once = list(at_once)
        # A row of motions is a motion, so the ramp begins before the row.
        self._is_motion = bool(columns.relative)
        self._counts_shares = len(columns.absolute) == len(columns.grippers)
        self._tick = -approach  # tick of the ramp, negative during the approach
        self._speed = 0.0 if ramp else 1.0  # rows per tick
        self._rise = 0.0  # increase of the speed per tick
        self._position = 0.0  # the position on the plan, in rows since the beginning of the section
        self._rows = 0  # the number of rows of the section
        self._ticks = 0  # number of ticks that are left in the section
        self._latest_tick = 0  # the tick at which catching up ends at the latest
        self._newest: np.ndarray | None = None  # the newest row while catching up, (D,)
        self._row_share = 0.0  # the share of a row of motions that was executed while catching up
        self._full_rows = 0  # consecutive rows at full speed while catching up
        self.catches_up = False
        """Whether the command catches up with a plan of too few rows for a ramp."""

    @property
    def arrived(self) -> bool:
        """Whether the approach to the first row is complete."""
        return self._tick >= 0

    @property
    def over(self) -> bool:
        """Whether full speed is reached."""
        if self.catches_up:
            return self._full_rows == _FULL_ROWS or self._tick > self._latest_tick
        return self.arrived and self._ticks == 0 and self._is_full(self._speed)

    @property
    def divides_rows(self) -> bool:
        """Whether a row is complete when all of its motion has been executed."""
        return self._counts_shares or not self.catches_up

    def step(
        self, last: np.ndarray, action: np.ndarray, after: np.ndarray | None, known: int
    ) -> tuple[np.ndarray, int]:
        """Return the command of a tick, and the number of rows that it completes.

        Args:
            last: The last command, (D,).
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
            goal = self._begin_of(action, after)
            command = self._part(goal, share, share)
            if self._tick < 0:
                return command, 0
            self._from = goal
            return command, 0 if self._is_motion else 1

        if not self._ticks and not self.catches_up:
            self._begin_section(known)
        if self.catches_up:
            return self._catch_up(last, action)

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

    def _begin_of(self, action: np.ndarray, after: np.ndarray | None) -> np.ndarray:
        """Return the pose at which the ramp begins, (D,).

        In a plan of motions, the ramp leads to the first row. Its targets begin before their values
        in this row by the step of the next row, as far as the start is as far. Otherwise, they
        would stand while the first motion is executed, and then begin at its speed.

        Args:
            action: The first row of the plan, (D,).
            after: The row after it, (D,); None if there is none.
        """
        if not self._is_motion or after is None:
            return action
        begin = action.copy()
        others = set(self._at_once)
        for rotation in self._columns.rotations:
            others.update(rotation.columns)
        targets = [column for column in self._columns.absolute if column not in others]
        way = action[targets] - self._from[targets]
        step = after[targets] - action[targets]
        ahead = np.where(way * step > 0.0, np.minimum(np.abs(way), np.abs(step)), 0.0)
        begin[targets] -= np.sign(way) * ahead
        return begin

    def _begin_section(self, known: int) -> None:
        """Begin a section of the ramp, which ends at full speed; if too few rows are known for it,
        begin to catch up.
        """
        self._position = 0.0
        first = math.ceil((1.0 - self._speed**2) * self._ramp / 2)
        for rows in range(max(1, first), known + 1):
            ticks = math.ceil(2 * rows / (1.0 + self._speed))
            rise = 2 * (rows - ticks * self._speed) / ticks**2
            if 0.0 <= rise * self._ramp <= 1.0 + _ROUNDING and self._is_full(
                self._speed + ticks * rise
            ):
                self._rows, self._ticks, self._rise = rows, ticks, rise
                return
        self.catches_up = True
        self._latest_tick = self._tick + max(_LEAST_TICKS, _RAMPS * self._ramp)

    def _catch_up(self, last: np.ndarray, action: np.ndarray) -> tuple[np.ndarray, int]:
        """Return the command as far towards a row as the limits allow, and the number of rows that
        it completes.
        """
        start = last.copy()
        start[self._at_once] = action[self._at_once]
        before = self._columns.still(action) if self._newest is None else self._newest
        share = self._largest_share(start, action, before)
        command = self._columns.travel(start, action, 0.0, share)
        self._newest = action
        self._full_rows = self._full_rows + 1 if share == 1.0 else 0
        if not self._counts_shares:
            return command, 1

        self._row_share += share
        if self._row_share < 1.0:
            return command, 0
        self._row_share -= 1.0
        return command, 1

    def _next_position(self) -> float:
        """Return the position after this tick, during which the speed increases evenly."""
        self._ticks -= 1
        position = self._position + self._speed + self._rise / 2
        self._speed += self._rise
        return float(self._rows) if self._ticks == 0 else position

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
