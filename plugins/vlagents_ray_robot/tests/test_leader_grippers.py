"""Tests that a leader does not move a gripper by itself, for absolute and relative actions."""

from __future__ import annotations

import numpy as np
import pytest

from vlagents_ray import ActionSpec, ConfigError, Contract, Obs
from vlagents_ray_robot.teleoperation import AxesDevice, AxesLeader

OPEN, CLOSED = 1.0, -1.0


def spec_of(delta: bool, arms: int) -> ActionSpec:
    """Return actions of three joints and a gripper for each arm."""
    names = tuple(f"arm{i}" for i in range(arms)) if arms > 1 else None
    return ActionSpec(
        dim=4 * arms,
        space="joint",
        delta=delta,
        gripper_open=OPEN,
        gripper_closed=CLOSED,
        arms=names,
    )


class Device(AxesDevice):
    def __init__(self) -> None:
        self.moves = np.zeros(6, np.float32)

    def engaged(self) -> bool:
        return True

    def axes(self) -> np.ndarray:
        return self.moves

    def press(self) -> None:
        self._presses += 1


@pytest.mark.parametrize("delta", [False, True])
def test_a_leader_moves_the_gripper_at_a_press_alone_and_refuses_several(delta: bool) -> None:
    device = Device()
    leader = AxesLeader(Contract(action=spec_of(delta, 1)), device, step=0.1)
    obs = Obs(state={"joints": np.zeros(3, np.float32)}, gripper=0.3)
    leader.engaged()
    device.moves = np.ones(6, np.float32)
    assert {float(leader.action(obs)[3]) for _ in range(5)} == {CLOSED}
    device.press()
    assert {float(leader.action(obs)[3]) for _ in range(5)} == {OPEN}
    with pytest.raises(ConfigError, match=r"at most one gripper, got the columns \[3, 7\]"):
        AxesLeader(Contract(action=spec_of(delta, 2)), device, step=0.1)
    half = ActionSpec(dim=4, delta=delta, gripper_open=1.0)
    with pytest.raises(ConfigError, match="both `gripper_open` and `gripper_closed`"):
        AxesLeader(Contract(action=half), device, step=0.1)


def test_arms_that_do_not_share_the_numbers_equally_are_an_error() -> None:
    unequal = ActionSpec(
        dim=15, delta=True, gripper_open=1.0, gripper_closed=0.0, arms=("left", "right")
    )
    with pytest.raises(ConfigError, match="2 arms"):
        AxesLeader(Contract(action=unequal), Device(), step=0.1)
