"""Tests of the devices with which an operator moves a robot: the keys of a terminal, and a
SpaceMouse.
"""

from __future__ import annotations

import os
import pty
import sys
import termios
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from eval_fakes import Clock

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ChunkPlayer,
    ConfigError,
    Contract,
    Obs,
    PlayerSettings,
)
from vlagents_ray.envs import make_env
from vlagents_ray.errors import MissingDependency, MissingState
from vlagents_ray.policies.noop import Noop, NoopConfig
from vlagents_ray.robot import Guard, MotionLimits, run_loop
from vlagents_ray.robot.leaders import TeleoperatedAgent
from vlagents_ray.robot.simulated import EnvRobot
from vlagents_ray_robot.teleoperation import AxesLeader, Keyboard, SpaceMouse

DELTAS = Contract(
    action=ActionSpec(dim=4, delta=True, gripper_open=1.0, gripper_closed=-1.0, low=-1.0, high=1.0),
    gripper=True,
)
JOINTS = Contract(action=ActionSpec(dim=3, delta=False, low=-1.0, high=1.0))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr("vlagents_ray_robot.teleoperation.time.monotonic", clock)
    return clock


class Terminal:
    """A terminal into which the test types."""

    def __init__(self) -> None:
        self._ours, self.its = pty.openpty()

    def type(self, keys: str) -> None:
        os.write(self._ours, keys.encode())


@pytest.fixture
def terminal() -> Iterator[Terminal]:
    made = Terminal()
    yield made
    os.close(made._ours)
    os.close(made.its)


def test_keys_move_along_their_axes_while_they_are_pressed(
    clock: Clock, terminal: Terminal
) -> None:
    before = termios.tcgetattr(terminal.its)
    with Keyboard(terminal=terminal.its) as device:
        assert not termios.tcgetattr(terminal.its)[3] & termios.ECHO
        assert not device.engaged()
        terminal.type("wd")
        assert device.engaged()
        assert device.axes().tolist() == [1, -1, 0, 0, 0, 0]
        clock.now = 0.15
        terminal.type("s")  # the opposite direction, immediately
        device.engaged()
        assert device.axes().tolist() == [-1, -1, 0, 0, 0, 0]
        clock.now = 0.25
        assert device.axes().tolist() == [-1, 0, 0, 0, 0, 0]
        clock.now = 1.0
        assert device.axes().tolist() == [0] * 6
        assert device.engaged(), "until Enter gives back"
    assert termios.tcgetattr(terminal.its) == before


def test_enter_takes_over_and_gives_back_and_other_keys_do_what_was_said(
    terminal: Terminal,
) -> None:
    pressed: list[str] = []
    with Keyboard({"y": lambda: pressed.append("y")}, terminal=terminal.its) as device:
        engaged = []
        for keys in ("\n", "\n", "w", "\n", "y", " "):
            terminal.type(keys)
            engaged.append(device.engaged())
        assert engaged == [True, False, True, False, False, True]
        assert device.axes().tolist() == [0] * 6, (
            "a robot given back is not moved by keys of before"
        )
        assert (pressed, device.gripper_presses(), device.gripper_presses()) == (["y"], 1, 0)


def test_a_keyboard_wants_a_terminal_and_keys_of_its_own(terminal: Terminal) -> None:
    reading, writing = os.pipe()
    with pytest.raises(ConfigError, match="expected a terminal"):
        Keyboard(terminal=reading)
    os.close(reading)
    os.close(writing)
    with pytest.raises(ConfigError, match="'w'"):
        Keyboard({"w": lambda: None}, terminal=terminal.its)


class Stick:
    """A device that the test moves."""

    def __init__(self) -> None:
        self.at = np.zeros(6, np.float32)
        self.presses = 0
        self.held = True

    def engaged(self) -> bool:
        return self.held

    def take_over_again(self, leader: AxesLeader) -> None:
        for self.held in (False, True):
            leader.engaged()

    def axes(self) -> np.ndarray:
        return self.at

    def gripper_presses(self) -> int:
        presses, self.presses = self.presses, 0
        return presses


def test_axes_become_relative_actions_within_half_of_the_bound() -> None:
    stick = Stick()
    leader = AxesLeader(DELTAS, stick)
    stick.at[:3] = (1, -0.5, 0)
    assert leader.engaged()
    assert leader.action(Obs(gripper=1.0)).tolist() == [0.5, -0.25, 0, 1]
    assert AxesLeader(DELTAS, stick, step=0.1).action(Obs(gripper=1.0))[:2] == pytest.approx(
        [0.1, -0.05]
    )


def test_a_gripper_that_may_hold_something_stays_closed_until_its_button_is_pressed() -> None:
    stick = Stick()
    leader = AxesLeader(DELTAS, stick)
    leader.engaged()
    assert leader.action(Obs(gripper=0.58))[-1] == -1
    assert leader.action(Obs(gripper=1.0))[-1] == -1
    stick.presses = 1
    assert leader.action(Obs(gripper=0.1))[-1] == 1
    stick.take_over_again(leader)
    assert leader.action(Obs(gripper=0.1))[-1] == -1, "when it is taken over again, as it is"


def test_absolute_targets_begin_where_the_robot_stands_and_stay_within_the_bounds() -> None:
    stick = Stick()
    leader = AxesLeader(JOINTS, stick, step=0.1)
    obs = Obs(state={"joints": np.array([0.5, 0.85, 0], np.float32)})
    stick.at[:3] = (-1, 1, 0)
    leader.engaged()
    for expected in ([0.4, 0.95, 0], [0.3, 1, 0]):
        assert leader.action(obs) == pytest.approx(expected)
    stick.take_over_again(leader)
    assert leader.action(obs) == pytest.approx([0.4, 0.95, 0])
    with pytest.raises(MissingState):
        AxesLeader(JOINTS, stick, step=0.1).action(Obs())
    for contract in (None, Contract(), Noop().contract):
        with pytest.raises(ConfigError, match=r"teleoperation: .*delta.*--set delta=false"):
            AxesLeader(contract, stick, step=0.1)
    with pytest.raises(ConfigError, match="step"):
        AxesLeader(JOINTS, stick)
    AxesLeader(Noop(NoopConfig(delta=False)).contract, stick, step=0.1)
    measured = AxesLeader(JOINTS, stick, step=0.1, measure=lambda _: np.array([-0.5, 0, 0]))
    assert measured.action(Obs()) == pytest.approx([-0.6, 0.1, 0])


class Obedient:
    """An arm that reaches each command immediately, and may hold."""

    def __init__(self) -> None:
        self.joints = np.zeros(3, np.float32)
        self.holds: str | None = None
        self.path: list[float] = []

    def observe(self) -> Obs:
        self.path.append(float(self.joints[0]))
        return Obs(state={"joints": self.joints.copy()})

    def apply(self, action: np.ndarray) -> None:
        self.joints = action.copy()

    def stop(self) -> None: ...


class Idle(Agent):
    contract = JOINTS

    def act(self, obs: Obs) -> Act:
        return Act(np.zeros((4, 3), np.float32))


FORWARDS, TICKS, STEP = 60, 100, 0.01
REFUSALS = {
    "a bound": Guard(JOINTS, high=0.2),
    "a bound of a file": Guard(JOINTS, limits=MotionLimits(high=(0.2, 9.0, 9.0)), hz=200.0),
    "a measured pose": Guard(
        JOINTS, high=0.2, max_step=0.05, measure=lambda obs: obs.state["joints"]
    ),
    "the contract": Guard(Contract(action=replace(JOINTS.action, high=0.2))),
    "a robot that holds": Guard(JOINTS),
    "a check of one's own": Guard(JOINTS, high=0.2, max_step=0.011),
}


@pytest.mark.slow
@pytest.mark.parametrize("measured", [False, True])
@pytest.mark.parametrize("refusal", REFUSALS)
def test_an_operators_target_does_not_run_on_while_the_arm_does_not_follow(
    refusal: str, *, measured: bool
) -> None:
    stick, arm = Stick(), Obedient()
    stick.at[0] = 1.0

    def over() -> bool:
        tick = len(arm.path)
        stick.at[0] = 1.0 if tick < FORWARDS else -1.0
        arm.holds = (
            "the camera hangs"
            if refusal == "a robot that holds" and 20 <= tick < FORWARDS
            else None
        )
        return tick >= TICKS

    measure = (lambda obs: obs.state["joints"]) if measured else None
    leader = AxesLeader(JOINTS, stick, step=STEP, measure=measure)
    player = ChunkPlayer(Idle(), PlayerSettings("async"), check=REFUSALS[refusal], override=leader)
    with player:
        run_loop(arm, player, hz=200.0, until=over)
    at_turn = arm.path[FORWARDS - 1]
    assert at_turn == pytest.approx(0.2, abs=2 * STEP), "it stood against the bound, or held"
    moved = [
        number for number, place in enumerate(arm.path[FORWARDS:]) if place < at_turn - STEP / 2
    ]
    assert moved[0] <= 3, "ticks of the way back without motion"
    assert arm.path[-1] < at_turn - 0.8 * STEP * (TICKS - FORWARDS - 5), (
        "it obeys each tick of the way back"
    )


class Mouse:
    """A SpaceMouse of pyspacemouse 2.1, which returns one report per `read` until none are left."""

    def __init__(self) -> None:
        self.reports: list[dict[str, Any]] = []
        self.closed = False
        self._state = SimpleNamespace(t=-1.0, x=0, y=0, z=0, roll=0, pitch=0, yaw=0, buttons=[0, 0])

    def read(self) -> SimpleNamespace:
        if self.reports:
            self._state.__dict__.update(self.reports.pop(0), t=self._state.t + 1)
        return self._state

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def mouse(monkeypatch: pytest.MonkeyPatch) -> Mouse:
    made = Mouse()
    library = ModuleType("pyspacemouse")
    library.AxisConvention = SimpleNamespace(ROS="ros")  # type: ignore[attr-defined]
    library.open = lambda **_: made  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pyspacemouse", library)
    return made


def test_a_spacemouse_takes_over_when_it_is_moved_and_gives_back_by_its_last_button(
    mouse: Mouse,
) -> None:
    with SpaceMouse() as device:
        mouse.reports = [{"x": 0.05}]
        assert not device.engaged(), "the cap never rests exactly in the middle"
        mouse.reports = [
            {"x": 0.9},
            {"x": 0.4, "yaw": -2.0},
            {"buttons": [1, 0]},
            {"buttons": [0, 0]},
        ]
        assert device.engaged()
        assert device.axes() == pytest.approx([0.4, 0, 0, 0, 0, -1])
        assert mouse.reports == [], "what was sent since the last tick has been read"
        assert device.gripper_presses() == 1
        mouse.reports = [{"x": 0.0, "yaw": 0.0}, {"buttons": [0, 1]}, {"buttons": [0, 0]}]
        assert not device.engaged()
    assert mouse.closed


def test_without_a_spacemouse_or_its_library_the_cure_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "pyspacemouse", None)
    with pytest.raises(MissingDependency, match="spacemouse"):
        SpaceMouse()

    def none_there(axis_convention: object) -> None:
        raise RuntimeError("No connected or supported devices found.")

    library = ModuleType("pyspacemouse")
    library.AxisConvention, library.open = SimpleNamespace(ROS="ros"), none_there  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "pyspacemouse", library)
    with pytest.raises(ConfigError, match="plug one in"):
        SpaceMouse()


def test_a_human_drives_an_environment_through_the_same_loop() -> None:
    stick = Stick()
    with make_env("tabletop/lift", width=32, height=32, max_steps=4) as env:
        robot = EnvRobot(env, 0)
        agent = TeleoperatedAgent(AxesLeader(env.contract, stick), env.contract)
        before = robot.observe().state["xyzrpy"]
        stick.at[0] = 1
        report = run_loop(robot, agent, hz=200.0, until=lambda: robot.ended)
        moved = robot.observe().state["xyzrpy"] - before
        assert moved[0] == pytest.approx(4 * 0.5 * 0.03, abs=1e-5)
        assert (robot.steps, robot.ended, robot.success, report.interventions) == (
            4,
            True,
            False,
            4,
        )
        robot.apply(np.zeros(4, np.float32))
        assert robot.steps == 4
        endless = EnvRobot(env, 0, endless=True)
        run_loop(endless, agent, hz=200.0, until=lambda: endless.steps >= 6)
        assert not endless.ended
