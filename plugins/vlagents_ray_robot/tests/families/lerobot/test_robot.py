"""Tests of LeRobot's robots by name: a robot that registers itself, and LeRobot's SO-101 on a bus
without hardware.
"""

import numpy as np
import pytest
from lerobot.motors import MotorCalibration
from lerobot.robots.so_follower import so_follower
from lerobot_robot_mirror import MOTORS

from vlagents_ray.errors import ConfigError, InvalidAction
from vlagents_ray.robot.loop import robot_factory
from vlagents_ray_robot import lerobot_robot
from vlagents_ray_robot.check import examine
from vlagents_ray_robot.mujoco_arm import SimulatedClock

SPEED = 90.0  # speed of the motors, deg/s
CLOCK = SimulatedClock()


class Bus:
    """The motors of an SO-101, which turn to their goals in simulated time."""

    def __init__(self, port: str, motors: dict[str, object], calibration: object) -> None:
        self.positions = dict.fromkeys(motors, 10.0)
        self.motors, self.goals, self.at_s = motors, dict(self.positions), CLOCK.monotonic()
        self.calibration = {
            name: MotorCalibration(i, 0, 0, 1024, 3071) for i, name in enumerate(motors)
        }
        self.model_resolution_table = {"sts3215": 4096}
        self.is_connected, self.is_calibrated = False, port != "/dev/new"

    def connect(self) -> None:
        self.is_connected = True

    def disconnect(self, disable_torque: bool = True) -> None:
        self.is_connected = False

    def sync_read(self, name: str, **options: object) -> dict[str, float]:
        assert name == "Present_Position"
        most, self.at_s = SPEED * (CLOCK.monotonic() - self.at_s), CLOCK.monotonic()
        for motor, goal in self.goals.items():
            self.positions[motor] += float(np.clip(goal - self.positions[motor], -most, most))
        return dict(self.positions)

    def sync_write(self, name: str, goals: dict[str, float], **options: object) -> None:
        assert name == "Goal_Position"
        self.sync_read("Present_Position")
        self.goals |= goals


@pytest.fixture(autouse=True)
def hardware(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(so_follower, "FeetechMotorsBus", Bus)
    monkeypatch.setattr(so_follower.SOFollower, "configure", lambda _: None)
    monkeypatch.setattr(lerobot_robot, "time", CLOCK)


class Person:
    """Agrees to all motions, sees each joint move, and holds no card."""

    def agrees(self, motion: str) -> bool:
        return True

    def holds_card(self, camera: str | None) -> bool:
        return False

    def saw_joint(self, name: str, side: int) -> bool:
        return True

    def saw_closing(self) -> None:
        return None

    def sees_hand(self, pose: np.ndarray, arm: int = 0) -> None:
        return None


def test_an_so101_is_driven_by_name_in_lerobots_order_and_units() -> None:
    arm = robot_factory("--robot", "lerobot:so101_follower", ["port=/dev/ttyACM0", "id=mine"])()
    assert arm.joint_names == [
        "shoulder_pan",
        "shoulder_lift",
        "elbow_flex",
        "wrist_flex",
        "wrist_roll",
        "gripper",
    ]
    assert arm.contract.state["joints"].unit == "deg"
    half = 360 * 2047 / 4095 / 2  # % of the calibrated range
    np.testing.assert_allclose(arm.joint_limits, [*[(-half, half)] * 5, (0, 100)])
    arm.apply(np.arange(6, dtype=np.float32))
    CLOCK.sleep(1.0)
    assert arm.observe().state["joints"].tolist() == [0, 1, 2, 3, 4, 5]
    with pytest.raises(InvalidAction, match=r"expected shape \(6,\), .*got \(7,\)"):
        arm.apply(np.zeros(7, np.float32))
    report = examine(arm, operator=Person(), clock=CLOCK)
    assert report.ok, report.lines()
    assert {
        "limits",
        "meaning",
        "order",
        "sign",
        "size",
        "latency",
        "rate",
        "commands",
        "stop",
        "clock",
    } <= set(report.passed)
    arm.close()
    assert not arm._robot.is_connected


def test_a_robot_of_a_plugin_is_driven_by_name() -> None:
    arm = robot_factory("--robot", "lerobot:mirror")()
    assert arm.joint_names == [name.removesuffix(".pos") for name in MOTORS]
    obs = arm.observe()
    assert {name: (spec.height, spec.width) for name, spec in arm.contract.cameras.items()} == {
        name: image.shape[:2] for name, image in obs.cameras.items()
    }


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("so101_folower", ["port=/dev/ttyACM0"], "did you mean 'so101_follower'"),
        ("so101_follower", [], "port"),
        ("so101_follower", ["port=/dev/ttyACM0", "speed=3"], "speed"),
        (
            "so101_follower",
            ["port=/dev/new", "id=none"],
            "lerobot-calibrate --robot.type=so101_follower",
        ),
        ("so101_follower", ["/dev/ttyACM0"], "expected KEY=VALUE"),
    ],
)
def test_a_wrong_robot_or_setting_is_named_with_its_cure(
    name: str, settings: list[str], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        robot_factory("--robot", f"lerobot:{name}", settings)()
