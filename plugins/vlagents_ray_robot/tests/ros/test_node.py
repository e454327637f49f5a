"""Tests of a robot behind topics: the messages that are published while a policy drives it, and
after losses.
"""

from __future__ import annotations

import contextlib
import re
import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ros_arm
import yaml
from asgi_server import policy_server
from eval_fakes import wait_for
from ros_arm import BEAT, CAMERA, COMMANDS, JOINTS, NAMES, SIDE, RosArm, Wire, header
from rosbridge_double import RosbridgeDouble, rosbridge_double

import vlagents_ray.cli.robot as command
from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    CameraSpec,
    ChunkPlayer,
    Contract,
    Obs,
    PlayerSettings,
    StateSpec,
)
from vlagents_ray.contract import require_match
from vlagents_ray.errors import ConfigError, ContractMismatch, InvalidAction
from vlagents_ray.robot import Guard, Watchdog, run_loop
from vlagents_ray.robot.guard import measured_state
from vlagents_ray.robot.loop import LoopReport
from vlagents_ray_robot.check import examine
from vlagents_ray_robot.ros import RosRobot
from vlagents_ray_robot.ros.robot import settings_from

STEP = 0.01
MAX_STEP = 0.05
FAR = 7.0  # a position beyond the bounds, rad


class Ahead(Agent):
    """Returns chunks of two rows, each row STEP further from the measured pose; if `wild`, each
    third chunk contains FAR.
    """

    shared = ("instructions", "seen")

    def __init__(self, *, wild: bool = False, last: int | None = None) -> None:
        self.wild, self.last = wild, last
        self.acts = 0
        self.instructions: deque[str | None] = deque()
        self.seen: deque[Obs] = deque()

    @property
    def contract(self) -> Contract:
        action = ActionSpec(dim=2, space="joint", delta=False, low=-3.0, high=3.0)
        return Contract({"front": CameraSpec(SIDE, SIDE)}, {"joints": StateSpec(2)}, action=action)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, Any]:
        self.instructions.append(instruction)
        return {}

    def act(self, obs: Obs) -> Act:
        self.acts += 1
        self.seen.append(obs)
        rows = obs.state["joints"] + STEP * np.array([[1], [2]], np.float32)
        if self.wild and self.acts % 3 == 0:
            rows[1] = FAR
        return Act(rows.astype(np.float32), done=self.acts == self.last)


class SeeingGuard(Guard):
    """A guard that records the actions that all guards of this class have accepted."""

    passed: list[list[float]] = []  # noqa: RUF012 - the test empties it

    def __call__(self, action: np.ndarray, last: np.ndarray | None = None) -> np.ndarray:
        accepted = super().__call__(action, last)
        self.passed.append(accepted.astype(np.float64).tolist())
        return accepted


@dataclass
class Drive:
    """A control loop in a thread."""

    double: RosbridgeDouble
    arm: RosArm
    robot: RosRobot
    watchdog: Watchdog
    reports: list[LoopReport] = field(default_factory=list)
    over: bool = False

    @property
    def commands(self) -> list[list[float]]:
        return [message["data"] for message in self.double.on(COMMANDS)]

    @property
    def alive(self) -> bool:
        beats = self.double.on(BEAT)
        return bool(beats) and beats[-1]["data"]

    def moves(self) -> None:
        """Wait until new commands have arrived."""
        now = len(self.commands)
        wait_for(lambda: len(self.commands) > now + 3)


@contextlib.contextmanager
def driving(agent: Agent, **more: Any) -> Iterator[Drive]:
    with contextlib.ExitStack() as stack:
        double = stack.enter_context(rosbridge_double())
        arm = stack.enter_context(RosArm(double.publish, lambda: double.on(COMMANDS)))
        settings = settings_from(ros_arm.settings(double.url, **more), "arm.yaml")
        robot = stack.enter_context(RosRobot(settings))
        watchdog = robot.watchdog = Watchdog(lambda _: robot.stop(), robot.silent_s)
        guard = SeeingGuard(agent.contract, max_step=MAX_STEP, measure=measured_state("joints"))
        player = stack.enter_context(
            ChunkPlayer(
                agent, PlayerSettings(mode="open_loop", deadline_s=1.0, safe="hold"), check=guard
            )
        )
        drive = Drive(double, arm, robot, watchdog)

        def run() -> None:
            drive.reports.append(
                run_loop(robot, player, hz=50, watchdog=watchdog, until=lambda: drive.over)
            )

        thread = threading.Thread(target=run)
        thread.start()
        try:
            drive.moves()
            yield drive
        finally:
            drive.over = True
            thread.join()


def ahead_server(agent: Ahead) -> contextlib.AbstractContextManager[int]:
    return policy_server(agent, contract=agent.contract.to_json(), local=None)


def test_the_command_drives_an_arm_from_its_topics_and_stops_it_where_it_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    agent = Ahead(last=15)
    with ahead_server(agent) as port, rosbridge_double() as double:
        (tmp_path / "arm.yaml").write_text(yaml.safe_dump(ros_arm.settings(double.url)))
        with RosArm(double.publish, lambda: double.on(COMMANDS)) as arm:
            options = f"--robot ros:{tmp_path / 'arm.yaml'} --hz 30 --mode open_loop --restart auto".split()
            said = [
                "--instruction",
                "stack the cups",
                "--measure",
                "joints",
                "--max-step",
                str(MAX_STEP),
            ]
            status = command.main([f"http://127.0.0.1:{port}", *options, *said])
    assert status != 2, capsys.readouterr().out  # a tick may be late on a busy machine
    assert list(agent.instructions) == ["stack the cups"]
    obs = agent.seen[0]
    assert obs.cameras["front"].shape == (SIDE, SIDE, 3)
    np.testing.assert_array_equal(obs.state["joints"], [0, 0])
    commands = [message["data"] for message in double.on(COMMANDS)]
    assert len(commands) >= 20
    assert np.abs(np.diff([[0.0, 0.0], *commands], axis=0)).max() <= MAX_STEP
    assert commands[-1][0] > 0.05
    assert commands[-1] in arm.poses  # the loop ends with a stop, at the measured pose
    assert double.advertised == {
        COMMANDS: "std_msgs/msg/Float64MultiArray",
        BEAT: "std_msgs/msg/Bool",
    }
    beats = [message["data"] for message in double.on(BEAT)]
    assert beats.count(True) > 10
    assert not beats[-1]


def test_no_action_reaches_the_arm_that_the_guard_has_not_seen() -> None:
    SeeingGuard.passed = []
    agent = Ahead(wild=True)
    with driving(agent) as drive:
        wait_for(lambda: agent.acts > 20)
    assert len(drive.commands) > 20
    for one in drive.commands:
        # A stop commands the measured pose.
        assert one in SeeingGuard.passed or one in drive.arm.poses
        assert FAR not in one
    assert drive.reports[0].safe["limits"]  # the wild rows were proposed, and rejected


def test_a_hanging_camera_holds_the_arm_still_until_it_goes_on() -> None:
    with driving(Ahead(), max_age_s=0.3) as drive:
        drive.arm.broken = {CAMERA}
        wait_for(lambda: drive.robot.holds is not None)
        assert drive.robot.holds == f"no new message of {CAMERA} for more than 0.3 s"
        wait_for(lambda: not drive.alive)
        beats = len(drive.double.on(BEAT))
        # Messages of two topics may arrive in any order.
        wait_for(lambda: len(drive.double.on(BEAT)) > beats + 2)
        still = len(drive.commands)
        assert drive.commands[-1] in drive.arm.poses  # the last command is a measured pose
        wait_for(lambda: len(drive.double.on(BEAT)) > beats + 7)  # the loop continues
        assert len(drive.commands) == still
        assert not drive.watchdog.control.stopped
        drive.arm.broken = set()
        drive.moves()
        wait_for(lambda: drive.alive)
    assert drive.reports[0].reasons["robot"] == f"no new message of {CAMERA} for more than 0.3 s"


def test_a_topic_that_is_silent_for_long_stops_the_arm_until_a_person_starts_it() -> None:
    limits = {"topic": CAMERA, "max_age_s": 0.5, "silent_s": 1.0}
    with driving(Ahead(), cameras={"front": limits}) as drive:
        drive.arm.broken = {CAMERA}
        wait_for(lambda: drive.watchdog.control.stopped)
        assert drive.watchdog.barks[0].startswith(f"{CAMERA}: silent for")
        assert not drive.watchdog.restart()  # the topic is still silent
        still = len(drive.commands)
        drive.arm.broken = set()
        wait_for(lambda: drive.robot.holds is None and not drive.watchdog.control.silent)
        beats = len(drive.double.on(BEAT))
        wait_for(lambda: len(drive.double.on(BEAT)) > beats + 5)
        assert len(drive.commands) <= still + 1
        assert not drive.alive
        assert drive.watchdog.restart()
        drive.moves()


def test_a_lost_rosbridge_holds_the_arm_and_tells_it_so_as_soon_as_it_is_back() -> None:
    with driving(Ahead()) as drive:
        drive.double.close()
        wait_for(lambda: drive.robot.holds is not None)
        sent = len(drive.commands)
        drive.arm.joints = [0.5, -0.5]  # a person moves the arm by hand in the meantime
        drive.double.published = [one for one in drive.double.published if one.topic != COMMANDS]
        drive.double.open()
        drive.moves()
        # The first command is a stop at the arm's new position; the next commands begin there.
        assert sent > 0
        assert drive.commands[0] == pytest.approx([0.5, -0.5])
        assert np.abs(np.diff(drive.commands, axis=0)).max() <= MAX_STEP
    assert drive.reports[0].reasons["robot"] == "the connection to the rosbridge was lost"


def test_a_stop_into_a_dead_connection_is_sent_again_at_the_pose_after_the_loss() -> None:
    wire = Wire()
    with RosRobot(settings_from(ros_arm.settings("ws://dead"), "arm.yaml"), wire) as robot:
        robot.observe()
        assert robot.holds is None
        robot.stop()  # as far as the robot knows, the stop arrives
        assert wire.commands == [[0.0, 0.0]]
        wire.connections = 2
        robot.observe()
        assert robot.holds == "the connection to the rosbridge was lost"
        robot.stop()  # the position of the arm is unknown now
        assert len(wire.commands) == 1
        wire.deliver(0.5, -0.5)
        robot.observe()
        assert robot.holds is None
        assert wire.commands[1:] == [[0.5, -0.5]]
        wire.deliver(0.6, -0.5)
        robot.observe()
        assert len(wire.commands) == 2


@pytest.mark.parametrize("change", ["sent again", "unreadable", "of a clock that was set back"])
def test_an_image_that_is_no_news_holds_the_arm(change: str) -> None:
    wire = Wire()
    with RosRobot(
        settings_from(ros_arm.settings("ws://arm", max_age_s=0.3), "arm.yaml"), wire
    ) as robot:
        arm = RosArm(wire.publish, list)
        image = arm._image()
        wire.deliver(0.0, 0.0)
        robot.observe()
        assert robot.holds is None

        def holds() -> bool:
            wire.takes[JOINTS](arm._state())
            if change == "unreadable":
                image.update(header=header(), encoding="16UC1")
            elif change != "sent again":
                image["header"]["stamp"]["sec"] += 3600
            wire.takes[CAMERA](image)
            robot.observe()
            return robot.holds is not None

        wait_for(holds)
        assert robot.holds == f"no new message of {CAMERA} for more than 0.3 s"


@pytest.mark.slow
def test_a_killed_server_stops_the_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    server = contextlib.ExitStack()
    url = f"http://127.0.0.1:{server.enter_context(ahead_server(Ahead()))}"
    with server, rosbridge_double() as double:
        (tmp_path / "arm.yaml").write_text(yaml.safe_dump(ros_arm.settings(double.url)))
        with RosArm(double.publish, lambda: double.on(COMMANDS)) as arm:
            options = (
                f"--robot ros:{tmp_path / 'arm.yaml'} --hz 30 --seconds 4 --silent-s 1".split()
            )
            status: list[int] = []
            # The arm may stop earlier on a busy machine.
            options += ["--timeout-s", "1", "--restart", "auto"]
            run = [url, *options, "--measure", "joints", "--max-step", str(MAX_STEP)]
            thread = threading.Thread(target=lambda: status.append(command.main(run)))
            thread.start()
            wait_for(lambda: len(double.on(COMMANDS)) > 5)
            server.close()
            wait_for(lambda: len(double.on(BEAT)) > 5 and not double.on(BEAT)[-1]["data"])
            assert double.on(COMMANDS)[-1]["data"] in arm.poses
            thread.join()
    said = capsys.readouterr().out
    assert "stopped by the watchdog: server: silent for" in said
    assert status in ([1], [3])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"cameras": {"front": {"topic": "/elsewhere"}}},
            r"within 0.3 s, got none of \['/elsewhere'\].*ros2 topic list",
        ),
        (
            {"state": {"joints": {"topic": JOINTS, "names": [*NAMES, "wrist"]}}},
            "/joint_states: .*'wrist' is missing",
        ),
        ({"state": {"joints": {"topic": JOINTS}}}, "stop: expected 2 numbers.*got 'joints' with 3"),
    ],
)
def test_topics_that_do_not_fit_are_an_error_before_anything_moves(
    change: dict[str, Any], said: str
) -> None:
    with rosbridge_double() as double, RosArm(double.publish, lambda: double.on(COMMANDS)):
        settings = settings_from(ros_arm.settings(double.url, ready_s=0.3, **change), "arm.yaml")
        with pytest.raises(ConfigError, match=said), RosRobot(settings):
            pass
        assert double.on(COMMANDS) == []


@pytest.mark.parametrize(
    ("ago_s", "said"), [(3600, "3.6e[+]03 s ago"), (-3600, "3.6e[+]03 s ahead")]
)
def test_clocks_that_differ_are_an_error_with_the_cure(ago_s: int, said: str) -> None:
    with rosbridge_double() as double, RosArm(double.publish, lambda: double.on(COMMANDS)) as arm:
        real = arm._image

        def image() -> dict[str, Any]:
            found = real()
            found["header"]["stamp"]["sec"] -= ago_s
            return found

        arm._image = image  # type: ignore[method-assign]
        plain = ros_arm.settings(double.url)
        with (
            pytest.raises(ConfigError, match=f"{said}.*clock: arrival"),
            RosRobot(settings_from(plain, "arm.yaml")),
        ):
            pass
        with RosRobot(settings_from({**plain, "clock": "arrival"}, "arm.yaml")) as robot:
            robot.observe()
            assert robot.holds is None


def test_a_policy_for_another_robot_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with ahead_server(Ahead()) as port, rosbridge_double() as double:
        with RosArm(double.publish, lambda: double.on(COMMANDS)):
            cameras = {"cameras": {"top": {"topic": CAMERA}}}
            (tmp_path / "arm.yaml").write_text(
                yaml.safe_dump(ros_arm.settings(double.url, **cameras))
            )
            assert (
                command.main(
                    [f"http://127.0.0.1:{port}", "--robot", f"ros:{tmp_path / 'arm.yaml'}"]
                )
                == 2
            )
        assert double.on(COMMANDS) == []
    assert (
        "camera 'front': the policy needs it, the env provides ['top']" in capsys.readouterr().err
    )


@pytest.mark.slow
@pytest.mark.parametrize("stop", ["joints", "nothing"])
@pytest.mark.parametrize("declared", [False, True])
def test_the_check_of_a_robot_behind_topics_moves_nothing(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    stop: str,
    *,
    declared: bool,
) -> None:
    """If the measured pose stops the robot, actions are absolute; otherwise only the contract of a
    policy declares whether they are.
    """
    monkeypatch.setattr("builtins.input", lambda _: "")  # the operator cannot tell
    with ahead_server(Ahead()) as port, rosbridge_double() as double:
        settings = ros_arm.settings(double.url)
        settings["actions"][0]["stop"] = stop
        (tmp_path / "arm.yaml").write_text(yaml.safe_dump(settings))
        policy = ["--policy", f"http://127.0.0.1:{port}"] if declared else []
        with RosArm(double.publish, lambda: double.on(COMMANDS)):
            status = command.main(["check", f"ros:{tmp_path / 'arm.yaml'}", "--hz", "20", *policy])
        states_meaning = declared or stop == "joints"
        assert status == (0 if states_meaning else 3)
        assert len({tuple(one["data"]) for one in double.on(COMMANDS)}) <= 1, (
            "stops, with the measured pose"
        )
    printed = capsys.readouterr().out
    assert "ok observation" in printed
    assert "not checked cameras" in printed
    assert re.search("^not checked .*order", printed, re.MULTILINE)
    assert ("NOT CHECKED" in printed) == ("--policy URL" in printed) == (not states_meaning)


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["of a simulation", "that hangs"])
def test_only_a_camera_without_new_messages_is_frozen(camera: str) -> None:
    with rosbridge_double() as double, RosArm(double.publish, lambda: double.on(COMMANDS)) as arm:
        settings = settings_from(ros_arm.settings(double.url, max_age_s=0.3), "arm.yaml")
        # A simulation without noise renders the same picture while nothing moves.
        arm.varies = False
        with RosRobot(settings) as robot:
            if camera == "that hangs":
                arm.broken = {CAMERA}
            report = examine(robot, hz=20.0)
    frozen = [finding for finding in report.findings if finding.check in ("cameras", "clock")]
    assert bool(frozen) == (camera == "that hangs"), report.lines()
    assert all(finding.check != "cameras" or CAMERA in finding.got for finding in frozen)


def test_a_policy_of_deltas_is_refused_by_topics_of_targets() -> None:
    with RosRobot(settings_from(ros_arm.settings("ws://arm"), "arm.yaml"), Wire()) as robot:
        deltas = replace(Ahead().contract, action=ActionSpec(dim=2, delta=True))
        with pytest.raises(ContractMismatch, match="delta"):
            require_match(deltas, robot.contract)


def test_an_action_of_another_length_is_not_published() -> None:
    with rosbridge_double() as double, RosArm(double.publish, lambda: double.on(COMMANDS)):
        settings = settings_from(ros_arm.settings(double.url), "arm.yaml")
        with (
            RosRobot(settings) as robot,
            pytest.raises(InvalidAction, match=r"expected shape \(2,\), .*got \(3,\)"),
        ):
            robot.apply(np.zeros(3, np.float32))
        assert double.on(COMMANDS) == []
