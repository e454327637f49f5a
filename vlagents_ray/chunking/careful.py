"""Careful rows: before a gripper opens or closes because of an old observation, the robot stands
and waits for the answer to a new one.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Iterable, Mapping

import numpy as np

from vlagents_ray.chunking.buffer import ChunkBuffer, Step
from vlagents_ray.columns import Columns

logger = logging.getLogger(__name__)

FRESH_GRIP = 2
"""The default age, in rows, from which a row that moves a gripper is too old.

A plan is made for a place that the arm has not reached yet. After two rows, the error of the place
is as large as the tolerance of a grasp; at a delay of one row, waiting gains nothing.
"""


class CarefulRows:
    """Decides whether the robot stands before a row that opens or closes a gripper.

    A gripper that closes beside the object, or drops it, cannot be corrected by a later row. The
    robot therefore stands if the observation of such a row is at least `fresh_grip` rows old and
    the delay of answers is as long. A chunk that was computed while the robot stood is fresh, and
    none of its rows is too old. The robot waits once for each change of a gripper: after a fresh
    chunk, later chunks may also execute the change, until a chunk no longer contains it. Otherwise,
    a robot with a hesitating policy would wait for ever.

    A row changes a gripper if it leads across the middle between open and closed. If the contracts
    do not declare both values, the robot does not wait, which is logged once.

    Args:
        plan: The plan of the robot.
        fresh_grip: The age in rows from which a row is too old; None: the robot never waits.
    """

    def __init__(self, plan: ChunkBuffer, fresh_grip: int | None) -> None:
        self._plan = plan
        self._fresh_grip = fresh_grip
        # The side of each gripper by column, True above the middle, to which a fresh chunk, or one
        # after it, may move the gripper.
        self._allowed: dict[int, bool] = {}
        self._is_unknown_logged = False

    def forget(self) -> None:
        """Begin a new plan, for which the robot has not waited yet."""
        self._allowed.clear()

    def stands(self, last: np.ndarray | None, delay: int) -> bool:
        """Return whether the robot stands instead of executing the plan's next row.

        Args:
            last: The last command, (D,); None before the first one.
            delay: The measured delay of answers, in rows.
        """
        return self._waits(self._plan.next, last, delay)

    def rows_ahead(self, last: np.ndarray | None, delay: int) -> int:
        """Return the number of rows that the robot will execute within a delay.

        Args:
            last: The last command, (D,); None before the first one.
            delay: The measured delay of answers, in rows.
        """
        rows = 0
        if self._fresh_grip is None or delay < self._fresh_grip:
            return delay
        for step in itertools.islice(self._plan.steps(), delay):
            if self._waits(step, last, delay):
                return rows
            last = step.action
            rows += 1
        return rows

    def awaited(self, last: np.ndarray | None, delay: int) -> dict[int, bool]:
        """Return the changes of grippers for which the robot stands, for `answered`.

        Args:
            last: The last command, (D,); None before the first one.
            delay: The measured delay of answers, in rows.
        """
        step, columns = self._plan.next, self._plan.columns
        if step is None or columns is None or last is None or not self.stands(last, delay):
            return {}
        return _changes(columns, step.action, last)

    def answered(self, awaited: Mapping[int, bool]) -> None:
        """Record that a chunk was added to the plan.

        After a wait for a fresh chunk, the rows of older chunks are not executed, nor merged.

        Args:
            awaited: The `awaited` changes before the chunk was added.
        """
        step, columns = self._plan.next, self._plan.columns
        if step is None or columns is None:
            return
        if awaited and step.is_fresh:
            self._allowed |= awaited
            self._plan.keep_newest()
        for column, side in tuple(self._allowed.items()):
            if side not in _sides(columns, step.chunk.rows[step.row :, column]):
                del self._allowed[column]

    def executed(self, action: np.ndarray) -> None:
        """Record that an action was executed, (D,): the changes in it need no permission again."""
        columns = self._plan.columns
        if self._allowed and columns is not None:
            for column, side in tuple(self._allowed.items()):
                if side in _sides(columns, action[[column]]):
                    del self._allowed[column]

    def _waits(self, step: Step | None, last: np.ndarray | None, delay: int) -> bool:
        """Return whether the robot waits before a step."""
        fresh_grip, columns = self._fresh_grip, self._plan.columns
        if fresh_grip is None or delay < fresh_grip or columns is None:
            return False
        if step is None or last is None or step.age < fresh_grip:
            return False
        # No further answer follows an answer with `done`.
        if step.is_fresh or step.chunk.done or not columns.grippers:
            return False
        if columns.gripper_open is None or columns.gripper_closed is None:
            self._log_unknown(columns)
            return False
        changes = _changes(columns, step.action, last)
        return any(self._allowed.get(column) != side for column, side in changes.items())

    def _log_unknown(self, columns: Columns) -> None:
        if not self._is_unknown_logged:
            self._is_unknown_logged = True
            logger.warning(
                "fresh_grip: expected the values of an open and a closed gripper in the contract "
                "of the policy or the arm, got gripper_open=%s and gripper_closed=%s; grippers are "
                "also moved by old rows; declare both values",
                columns.gripper_open,
                columns.gripper_closed,
            )


def _changes(columns: Columns, action: np.ndarray, last: np.ndarray) -> dict[int, bool]:
    """Return the grippers that an action moves across their middle, with the side of the action."""
    middle = columns.gripper_middle
    changes = {}
    if middle is not None:
        for column in columns.grippers:
            side = bool(action[column] > middle)
            if side != bool(last[column] > middle):
                changes[column] = side
    return changes


def _sides(columns: Columns, goals: Iterable[float]) -> set[bool]:
    """Return the sides of the middle on which goals of a gripper are."""
    middle = columns.gripper_middle
    return set() if middle is None else {bool(goal > middle) for goal in goals}
