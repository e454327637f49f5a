"""Tests of the check of a robot: five sound arms pass, and twenty faults are found before harm."""

import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm_models import ARMS, model_file, simulated_arm
from dropped_signals import SendsSignal
from faulty_arms import FAULTS, ClockStep, Fault, FaultyArm, QuaternionOrder

from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.signals import ended_by_signals
from vlagents_ray.testing import ContractViolation
from vlagents_ray_robot.check import CHECKS, Operator, RobotReport, examine
from vlagents_ray_robot.check_command import main
from vlagents_ray_robot.mujoco_arm import MujocoArm, SimulatedOperator
from vlagents_ray_robot.testing import check_robot

pytestmark = pytest.mark.sim
HARM = 0.35  # maximum distance of a joint from its rest pose, rad (about 20°)


@contextmanager
def watched(arm: MujocoArm) -> Iterator[list[float]]:
    """Yield a list that contains, at the end, the maximum distance of any joint from its first
    pose, rad.
    """
    start, most = arm.joints(), [0.0]
    step = arm._mujoco.mj_step

    class Stepping:
        def __getattr__(self, name: str) -> object:
            return getattr(mujoco, name)

        def mj_step(self, model: object, data: object) -> None:
            step(model, data)
            joints = [arm._measured(drive) for drive in arm._flat if not drive.gripper]
            most[0] = max(most[0], float(np.abs(np.array(joints) - start).max()))

    mujoco = arm._mujoco
    arm._mujoco = Stepping()
    try:
        yield most
    finally:
        arm._mujoco = mujoco


def checked(arm: MujocoArm, robot: FaultyArm | MujocoArm) -> RobotReport:
    return examine(robot, operator=SimulatedOperator(arm), clock=arm.clock)


@pytest.mark.parametrize("name", ARMS)
def test_a_sound_arm_passes(name: str) -> None:
    with closing(simulated_arm(name)) as arm:
        report = checked(arm, arm)
    assert not report.findings, report.lines()
    # The files of these arms have no gripper.
    gripper = {"gripper"} if name in ("ur5e", "xarm7") else set()
    assert set(report.passed) == set(CHECKS) - gripper
    assert set(report.skipped) == gripper


def test_a_sound_arm_with_relative_actions_passes() -> None:
    with closing(simulated_arm("franka", delta=True)) as arm:
        assert set(checked(arm, arm).passed) == set(CHECKS)


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.kind.__name__)
def test_a_fault_is_found_before_harm(fault: Fault) -> None:
    with closing(simulated_arm(fault.arm, **fault.options)) as arm, watched(arm) as most:
        report = checked(arm, fault.kind(arm))
        arm.clock.sleep(1.0)  # the arm comes to rest
        arm.joints()
    assert {finding.check for finding in report.findings} == {fault.check}, report.lines()
    assert {finding.when == "before any motion" for finding in report.findings} == {fault.at_rest}
    assert most[0] < HARM
    for finding in report.findings:
        assert finding.got
        assert finding.want
        assert finding.cure


class Reluctant(SimulatedOperator):
    """Agrees only to the first motions."""

    def __init__(self, arm: MujocoArm, motions: int) -> None:
        super().__init__(arm)
        self.asked: list[str] = []
        self.motions = motions

    def agrees(self, motion: str) -> bool:
        self.asked.append(motion)
        return len(self.asked) <= self.motions and super().agrees(motion)


class Blind(SimulatedOperator):
    """Can tell neither the pose of the hand nor which joint moves."""

    def saw_joint(self, name: str, side: int) -> bool | None:
        return None

    def saw_closing(self) -> bool | None:
        return None

    def sees_hand(self, pose: np.ndarray, arm: int = 0) -> bool | None:
        return None


def test_motion_shows_a_wrong_quaternion_that_the_operator_cannot_see() -> None:
    with closing(simulated_arm("franka")) as arm:
        report = examine(QuaternionOrder(arm), operator=Blind(arm), clock=arm.clock)
    assert [finding.check for finding in report.findings] == ["pose"]
    assert "cannot tell" in report.skipped["place"]


def test_what_nobody_saw_is_not_checked() -> None:
    with closing(simulated_arm("franka")) as arm:
        report = examine(arm, operator=Blind(arm), clock=arm.clock)
    assert report.ok
    assert set(report.skipped) == {"order", "sign", "place", "gripper"}
    assert "could not tell whether panda_joint7 moved" in report.skipped["order"]


class Counting(FaultyArm):
    """A sound arm that counts its commands."""

    commands = 0

    def apply(self, action: np.ndarray) -> None:
        self.commands += 1
        super().apply(action)


def test_nothing_is_commanded_unless_the_operator_agrees() -> None:
    with closing(simulated_arm("franka")) as arm:
        counting = Counting(arm)
        assert (
            examine(counting, clock=arm.clock).skipped["order"] == "no operator agreed to a motion"
        )
        operator = Reluctant(arm, 0)
        report = examine(counting, operator=operator, clock=arm.clock)
        assert counting.commands == 0
        assert report.ok
        assert "did not agree to" in report.skipped["meaning"]
        operator = Reluctant(arm, 2)
        report = examine(counting, operator=operator, clock=arm.clock)
    assert operator.asked[-1] == "a move of panda_joint2 by 0.05 rad and back"
    assert "panda_joint2" in report.skipped["gripper"]


def test_the_report_has_pictures_and_no_links(tmp_path: Path) -> None:
    with closing(simulated_arm("franka")) as arm:
        report = examine(arm, operator=Reluctant(arm, 0), clock=arm.clock)
    report.write(tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert page.count("<img") == len(report.pictures) == 4
    assert "http" not in page


def test_joints_in_another_order_than_that_of_the_policy_are_found_by_name_before_any_motion() -> (
    None
):
    with closing(simulated_arm("franka", cameras=())) as arm:
        names = list(arm.joint_names)
        names[2], names[3] = names[3], names[2]
        contract = replace(arm.contract, action=replace(arm.contract.action, names=tuple(names)))
        report = examine(arm, contract=contract, operator=SimulatedOperator(arm), clock=arm.clock)
    [finding] = report.findings
    assert (finding.check, finding.when) == ("order", "before any motion")
    assert finding.got == "'panda_joint3' as joint 2 of the arm"
    assert finding.want == "'panda_joint4', as the contract declares"


def test_limits_of_another_number_of_joints_are_an_error() -> None:
    with closing(simulated_arm("franka", cameras=())) as arm:
        robot = FaultyArm(arm)
        robot.joint_limits = np.zeros((6, 2))
        with pytest.raises(
            ConfigError, match=r"joint_limits: expected shape \(7, 2\).*got \(6, 2\)"
        ):
            checked(arm, robot)


def test_check_robot_raises_every_finding() -> None:
    with closing(simulated_arm("franka")) as arm:
        assert check_robot(arm, clock=arm.clock).ok
        with pytest.raises(ContractViolation, match=r"clock: expected .*got a time stamp"):
            check_robot(ClockStep(arm), clock=arm.clock)


@pytest.mark.parametrize("status", [0, 2])
def test_the_command_checks_a_simulated_arm_without_a_person(
    status: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "report.html"
    name = f"mujoco:{model_file('franka')}" if status == 0 else "mujoco:missing.xml"
    assert (
        main([name, "--robot-set", "like=franka", "--robot-set", "fps=1", "--out", str(page)])
        == status
    )
    said = capsys.readouterr()
    assert ("ok gripper" in said.out, page.exists(), "ConfigError" in said.err) == (
        (status == 0,) * 2 + (status == 2,)
    )


def test_without_the_permission_to_move_the_report_names_the_option(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("builtins.input", lambda _: "")
    with closing(simulated_arm("franka")) as arm:
        counting = Counting(arm)
        report = examine(counting, operator=Operator(move=False), clock=arm.clock)
    assert counting.commands == 0
    assert report.skipped["order"] == "nothing may move without --move"


def test_a_person_is_asked_before_each_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, answers = list[str](), iter(["y", "n", "", "y"])
    monkeypatch.setattr("builtins.input", lambda question: asked.append(question) or next(answers))
    person = Operator(move=True)
    assert person.agrees("a move of elbow by 0.05 rad and back")
    assert "a move of elbow by 0.05 rad and back. Is its space free?" in asked[0]
    assert person.saw_joint("elbow", -1) is False
    assert "calls -?" in asked[1]
    assert person.saw_closing() is None
    assert not Operator(move=False).agrees("anything")
    assert len(asked) == 3


def test_without_a_terminal_nothing_is_agreed(monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(_: str) -> str:
        raise EOFError

    monkeypatch.setattr("builtins.input", closed)
    assert not Operator(move=True).agrees("a move")


class Interrupted(Counting):
    """An arm whose driver is interrupted in a destructor while it moves."""

    commands_at_signal: int | None = None

    def observe(self) -> Obs:
        if self.commands > 20 and self.commands_at_signal is None:
            self.commands_at_signal = self.commands
            SendsSignal(signal.SIGTERM)
        return super().observe()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_nothing_is_commanded_after_a_signal_whose_exception_python_drops() -> None:
    before = signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        with closing(simulated_arm("franka")) as arm, ended_by_signals(signal.SIGTERM):
            interrupted = Interrupted(arm)
            with pytest.raises(SystemExit):
                examine(interrupted, operator=SimulatedOperator(arm), clock=arm.clock)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert interrupted.commands == interrupted.commands_at_signal
