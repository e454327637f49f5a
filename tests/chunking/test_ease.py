"""The ease-in of plans whose rows mix motions and targets."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray.chunking.ease import EaseIn
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec

MIXED = ActionSpec(dim=2, delta=True, gripper_open=1.0, gripper_closed=0.0)
APPROACH, RAMP = 10, 14


def eased(grippers: np.ndarray, start: float, at_once: tuple[int, ...] = ()) -> np.ndarray:
    """Return the commands of an ease-in and five rows after it, (N, 2)."""
    rows = np.column_stack([np.full(len(grippers), 0.02), grippers]).astype(np.float32)
    columns = Columns.from_spec(MIXED, 2)
    begin = np.array([0.0, start], np.float32)
    ease = EaseIn(columns, begin, APPROACH, RAMP, lambda *_: 1.0, at_once=at_once)
    last, row = begin, 0
    commands = []
    while not ease.over:
        command, count = ease.step(last, rows[row], rows[row + 1], len(rows) - row)
        commands.append(command)
        last, row = command, row + count
    return np.array([*commands, *rows[row : row + 5]])


@pytest.mark.parametrize("step", [-0.01, 0.01, -0.002])
@pytest.mark.parametrize("distance", [1.0, 0.4, 5.0])
def test_a_gripper_that_moves_with_the_arm_speeds_up_as_gradually(
    step: float, distance: float
) -> None:
    """Before, a gripper stood while the arm executed its first motion, and then began at the speed
    that the arm had by then, which a guard with limits of acceleration rejects.
    """
    grippers = 0.5 + step * np.arange(40)
    commands = eased(grippers, 0.5 - distance * step)
    changes = np.diff(commands[:, 1], prepend=0.5 - distance * step)
    # At the end of the approach, the gripper is at rest. In the ramp, it gains two steps of a
    # ramp's tick at most, also where a row begins.
    accelerations = np.abs(np.diff(changes))[APPROACH:]
    assert accelerations.max() < max(2.0 / RAMP, (1.0 - min(distance, 1.0)) * 0.6) * abs(step)


def test_a_gripper_without_limits_has_the_values_of_the_rows() -> None:
    grippers = 0.5 - 0.01 * np.arange(40)
    commands = eased(grippers, 0.6, at_once=(1,))
    assert np.isin(commands[:, 1].round(6), grippers.astype(np.float32).round(6)).all()


def test_the_arm_executes_its_rows_as_without_a_gripper() -> None:
    moving, still = (eased(0.5 - step * np.arange(40), 0.6) for step in (0.01, 0.0))
    np.testing.assert_array_equal(moving[:, 0], still[:, 0])
