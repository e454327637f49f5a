"""Tests that a leader does not move a gripper by itself, for absolute and relative actions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vlagents_ray import ActionSpec, ConfigError, Contract, Obs
from vlagents_ray.columns import Columns
from vlagents_ray.contract import Rotation
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


HOLDING = 0.35  # the command of a gripper that holds something, neither open nor closed


@pytest.mark.parametrize("reported", [None, 0.0, 0.5, 1.0])
@pytest.mark.parametrize("way", ["values", "names", "columns", "arm"])
@pytest.mark.parametrize("delta", [False, True])
def test_a_takeover_keeps_the_last_command_of_a_gripper(
    delta: bool, way: str, reported: float | None
) -> None:
    spec = ActionSpec(dim=4, space="joint", delta=delta)
    arm = ActionSpec()
    if way == "values":
        spec = spec_of(delta, 1)
    elif way == "names":
        spec = replace(spec, names=("a", "b", "c", "gripper"))
    elif way == "columns":
        spec = replace(spec, grippers=(3,))
    else:
        arm = replace(arm, names=("a", "b", "c", "gripper.pos"))

    device = Device()
    leader = AxesLeader(Contract(action=spec), device, step=0.1)
    leader.join(arm)
    obs = Obs(state={"joints": np.array([0.1, 0.2, 0.3, 0.9], np.float32)}, gripper=reported)
    last = np.array([0.0, 0.0, 0.0, HOLDING], np.float32)
    leader.engaged()
    leader.begin(last)
    taken_over = [float(leader.action(obs)[3]) for _ in range(3)]
    leader.rebase(None)  # the robot was stopped
    stopped = [float(leader.action(obs)[3]) for _ in range(3)]
    leader.rebase(leader.action(obs))  # the guard rejected an action
    rejected = [float(leader.action(obs)[3]) for _ in range(3)]
    assert {*taken_over, *stopped, *rejected} == {float(last[3])}
    if way == "values":
        device.press()
        assert leader.action(obs)[3] == CLOSED


@pytest.mark.parametrize("reported", [None, 0.0, 0.5, 0.89])
def test_a_gripper_without_a_command_is_open_only_if_it_is_measured_as_open(
    reported: float | None,
) -> None:
    leader = AxesLeader(Contract(action=spec_of(True, 1)), Device(), step=0.1)
    leader.engaged()
    leader.begin(None)
    assert leader.action(Obs(gripper=reported))[3] == CLOSED
    leader.begin(None)
    assert leader.action(Obs(gripper=1.0))[3] == OPEN


@pytest.mark.parametrize("kind", ["quat_xyzw", "quat_wxyz", "rot6d", "axis_angle", "euler_xyz"])
def test_a_device_at_rest_commands_no_rotation(kind: Rotation) -> None:
    width = {"quat_xyzw": 4, "quat_wxyz": 4, "rot6d": 6}.get(kind, 3)
    spec = ActionSpec(dim=3 + width, space="ee_pose", delta=True, rotation=kind)
    device = Device()
    leader = AxesLeader(Contract(action=spec), device, step=0.1)
    leader.engaged()
    columns = Columns.from_spec(spec, spec.dim or 0)
    np.testing.assert_array_equal(leader.action(Obs()), columns.still())
    device.moves[3] = 1.0  # roll
    turned = columns.motion(leader.action(Obs()).tolist(), columns.still().tolist())
    assert turned[:6] == pytest.approx([0, 0, 0, 0.1, 0, 0], abs=1e-6)
