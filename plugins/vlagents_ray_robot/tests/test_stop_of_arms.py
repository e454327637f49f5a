"""Tests of `stop` for every arm: the arm rests where it is and keeps its grasp, whichever sensor is
broken.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from arm_models import simulated_arm
from ros_arm import COMMANDS, JOINTS, Wire, header

from vlagents_ray.columns import Columns
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import entries
from vlagents_ray_robot import DISTRIBUTION
from vlagents_ray_robot.lerobot_robot import LeRobotRobot, OneAtATime
from vlagents_ray_robot.ros import RosRobot
from vlagents_ray_robot.ros.robot import settings_from

MOTORS = ("shoulder", "elbow", "gripper")
# The fingers touch an object, at an opening of 31 %.
POSE = np.array([12.0, -3.0, 31.0], np.float32)
GRASP = 2.0  # the goal of the gripper


class Bus:
    """The bus of LeRobot's motors, which two threads must not use at once."""

    def __init__(self) -> None:
        self.broken = False
        self.pose = POSE
        self.goals: dict[str, float] = {}
        self.inside = 0
        self.shared = False  # whether two transfers ran at the same time
        self.slow: Callable[[], object] = lambda: None

    def sync_read(self, name: str) -> dict[str, float]:
        return self._transfer(lambda: self._read(name))

    def sync_write(self, name: str, values: dict[str, float]) -> None:
        assert name == "Goal_Position"
        self._transfer(lambda: self.goals.update(values))

    def _read(self, name: str) -> dict[str, float]:
        assert name == "Present_Position"
        if self.broken:
            raise ConnectionError("There is no status packet!")
        return dict(zip(MOTORS, self.pose.tolist(), strict=True))

    def _transfer(self, work: Callable[[], Any]) -> Any:
        self.inside += 1
        self.shared |= self.inside > 1
        self.slow()
        try:
            return work()
        finally:
            self.inside -= 1


class FakeFollower:
    """An arm like LeRobot's `SOFollower`: the bus is read first, then each camera."""

    observation_features: dict[str, Any] = {f"{motor}.pos": float for motor in MOTORS} | {
        "wrist": (4, 4, 3)
    }
    action_features: dict[str, Any] = {f"{motor}.pos": float for motor in MOTORS}  # noqa: RUF012

    def __init__(self, *, has_bus: bool = True, max_relative_target: float | None = None) -> None:
        self.wire = Bus()
        if has_bus:
            self.bus: Any = self.wire
        self.max_relative_target = max_relative_target
        self.camera_broken = False
        self.camera: Callable[[], object] = lambda: None
        self.config: Any = None

    def get_observation(self) -> dict[str, Any]:
        bus = getattr(self, "bus", self.wire)
        positions = {
            f"{motor}.pos": value for motor, value in bus.sync_read("Present_Position").items()
        }
        self.camera()
        if self.camera_broken:
            raise TimeoutError("Timed out waiting for frame from camera wrist after 200 ms.")
        return positions | {"wrist": np.zeros((4, 4, 3), np.uint8)}

    def send_action(self, action: dict[str, float]) -> None:
        bus = getattr(self, "bus", self.wire)
        if self.max_relative_target is not None:
            bus.sync_read("Present_Position")
        bus.sync_write(
            "Goal_Position", {name.removesuffix(".pos"): goal for name, goal in action.items()}
        )


def robot_of(follower: FakeFollower | FakeTwoArms) -> LeRobotRobot:
    """Return the robot of a fake arm, without LeRobot's registry."""
    robot = LeRobotRobot.__new__(LeRobotRobot)
    robot._robot, robot._keys, robot._unit = follower, list(follower.action_features), "deg"
    robot._lock_buses()
    return robot


FOLLOWERS: dict[str, Callable[[], FakeFollower]] = {
    "bus": FakeFollower,
    "bus, clipped goals": lambda: FakeFollower(max_relative_target=5.0),
    "no bus": lambda: FakeFollower(has_bus=False),
}


@pytest.mark.parametrize("broken", ["nothing", "camera", "encoders", "camera and encoders"])
@pytest.mark.parametrize("kind", FOLLOWERS)
def test_a_lerobot_arm_stops_where_it_is_and_keeps_its_grasp(kind: str, broken: str) -> None:
    follower = FOLLOWERS[kind]()
    robot = robot_of(follower)
    robot.observe()
    robot.apply(np.array([20.0, 5.0, GRASP], np.float32))
    follower.camera_broken = "camera" in broken
    follower.wire.broken = "encoders" in broken
    for _ in range(3):  # `stop` may be called repeatedly
        robot.stop()
        assert follower.wire.goals == {"shoulder": 12.0, "elbow": -3.0, "gripper": GRASP}


@pytest.mark.parametrize("broken", ["camera", "encoders", "camera and encoders"])
@pytest.mark.parametrize("kind", FOLLOWERS)
def test_a_lerobot_arm_that_was_neither_seen_nor_commanded_stays_as_it_is(
    kind: str, broken: str
) -> None:
    follower = FOLLOWERS[kind]()
    robot = robot_of(follower)
    follower.camera_broken = "camera" in broken
    follower.wire.broken = "encoders" in broken
    robot.stop()
    assert set(follower.wire.goals.values()) <= set(POSE.tolist())


class FakeTwoArms:
    """Two arms like those of LeRobot's `BiSOFollower`: each has a bus, and the left arm is
    first.
    """

    def __init__(self, **settings: Any) -> None:
        self.left_arm = FakeFollower(**settings)
        self.right_arm = FakeFollower(**settings)

    @property
    def observation_features(self) -> dict[str, Any]:
        return self._of_both(FakeFollower.observation_features, FakeFollower.observation_features)

    @property
    def action_features(self) -> dict[str, Any]:
        return self._of_both(FakeFollower.action_features, FakeFollower.action_features)

    def get_observation(self) -> dict[str, Any]:
        return self._of_both(self.left_arm.get_observation(), self.right_arm.get_observation())

    def send_action(self, action: dict[str, float]) -> None:
        for prefix, arm in (("left_", self.left_arm), ("right_", self.right_arm)):
            arm.send_action(
                {
                    name.removeprefix(prefix): goal
                    for name, goal in action.items()
                    if name.startswith(prefix)
                }
            )

    @staticmethod
    def _of_both(left: dict[str, Any], right: dict[str, Any]) -> dict[str, Any]:
        return {f"left_{name}": value for name, value in left.items()} | {
            f"right_{name}": value for name, value in right.items()
        }


FAULTS = ["nothing", "camera", "encoders", "camera and encoders", "all transfers"]


def break_down(follower: FakeFollower, fault: str) -> None:
    follower.camera_broken = "camera" in fault
    follower.wire.broken = "encoders" in fault
    if fault == "all transfers":
        follower.wire.slow = unplugged


def unplugged() -> None:
    raise ConnectionError("the adapter was unplugged")


@pytest.mark.parametrize("limit", [None, 5.0])
@pytest.mark.parametrize("right", FAULTS)
@pytest.mark.parametrize("left", FAULTS)
def test_each_of_two_lerobot_arms_is_stopped_whatever_is_broken_in_the_other(
    left: str, right: str, limit: float | None
) -> None:
    follower = FakeTwoArms(max_relative_target=limit)
    robot = robot_of(follower)
    robot.observe()
    robot.apply(np.array([20.0, 5.0, GRASP, 21.0, 6.0, GRASP], np.float32))
    for arm, fault in ((follower.left_arm, left), (follower.right_arm, right)):
        break_down(arm, fault)
    for _ in range(2):
        if "all transfers" in (left, right):
            with pytest.raises(ConnectionError, match="unplugged"):
                robot.stop()
        else:
            robot.stop()
    for arm, fault in ((follower.left_arm, left), (follower.right_arm, right)):
        if fault != "all transfers":
            assert arm.wire.goals == {"shoulder": 12.0, "elbow": -3.0, "gripper": GRASP}


def test_two_lerobot_arms_stop_where_they_are_and_not_where_they_were_seen() -> None:
    follower = FakeTwoArms()
    robot = robot_of(follower)
    robot.observe()
    robot.apply(np.array([20.0, 5.0, GRASP, 21.0, 6.0, GRASP], np.float32))
    follower.right_arm.wire.pose = POSE + 4.0  # the loop hangs, and the arm moves further
    robot.stop()
    assert follower.left_arm.wire.goals == {"shoulder": 12.0, "elbow": -3.0, "gripper": GRASP}
    assert follower.right_arm.wire.goals == {"shoulder": 16.0, "elbow": 1.0, "gripper": GRASP}


def test_two_lerobot_arms_have_the_limits_and_the_unit_of_each() -> None:
    follower = FakeTwoArms()
    robot = robot_of(follower)
    unset = SimpleNamespace(joint_limits=None)
    follower.left_arm.config = unset
    follower.right_arm.config = SimpleNamespace(joint_limits={"elbow": (-1.0, 2.0)})
    assert robot.joint_limits[4].tolist() == [-1.0, 2.0]
    assert np.isinf(np.delete(robot.joint_limits, 4, axis=0)).all()

    follower.left_arm.config = follower.right_arm.config = SimpleNamespace(use_degrees=True)
    assert robot._configured_unit(SimpleNamespace()) == "deg"
    follower.left_arm.config = SimpleNamespace(use_degrees=False)
    with pytest.raises(ConfigError, match="expected the same for all arms, got % and deg"):
        robot._configured_unit(SimpleNamespace())


def test_a_stop_from_another_thread_does_not_share_the_bus_with_the_loop() -> None:
    follower = FakeFollower()
    robot = robot_of(follower)
    robot.observe()
    over = threading.Event()
    follower.wire.slow = lambda: time.sleep(0)  # lets the other thread run here

    def stop() -> None:
        while not over.is_set():
            robot.stop()

    thread = threading.Thread(target=stop)
    thread.start()
    for _ in range(300):
        robot.observe()
        robot.apply(POSE)
    over.set()
    thread.join()
    assert not follower.wire.shared


def test_a_stop_does_not_wait_for_a_camera_that_hangs() -> None:
    follower = FakeFollower()
    robot = robot_of(follower)
    robot.observe()
    robot.apply(np.array([20.0, 5.0, GRASP], np.float32))
    hangs, released = threading.Event(), threading.Event()
    follower.camera = lambda: (hangs.set(), released.wait())
    thread = threading.Thread(target=robot.observe)
    thread.start()
    assert hangs.wait(30)
    robot.stop()
    assert follower.wire.goals["shoulder"] == 12.0
    released.set()
    thread.join()


def test_a_locked_bus_is_still_a_bus() -> None:
    bus = OneAtATime(Bus())
    assert bus.goals == {}
    bus.sync_write("Goal_Position", {"elbow": 1.0})
    assert bus.goals == {"elbow": 1.0}
    assert not hasattr(bus, "unknown")


class Finger(Wire):
    """A link to an arm whose finger is one of the joints of its topics."""

    def open(self) -> None:
        self.deliver(*POSE.tolist())

    def deliver(self, *joints: float) -> None:
        state = {"header": header(), "name": list(MOTORS), "position": np.array(joints)}
        for topic in (JOINTS, FINGER):
            self.takes[topic](state)


FINGER = "/finger"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
ARRAY = "std_msgs/msg/Float64MultiArray"
STATE = "sensor_msgs/msg/JointState"
ROS_TOPICS: dict[str, dict[str, Any]] = {  # settings of the topic of the actions
    "trajectory": {"type": TRAJECTORY, "names": list(MOTORS), "stop": "joints"},
    "joint state": {"type": STATE, "names": list(MOTORS), "stop": "joints"},
    "numbers in the order of the state": {"type": ARRAY, "numbers": 3, "stop": "joints"},
    "numbers, stated": {"type": ARRAY, "numbers": 3, "stop": "unnamed", "grippers": [2]},
    "deltas": {"type": STATE, "names": list(MOTORS), "stop": "zeros"},
    "deltas, stated": {"type": ARRAY, "numbers": 3, "stop": "zeros", "grippers": [2]},
}


def ros_robot(topic: str) -> tuple[RosRobot, Finger]:
    wire = Finger()
    stated = {
        "link": "ws://arm",
        "state": {"joints": {"topic": JOINTS, "names": list(MOTORS)}, "unnamed": {"topic": JOINTS}},
        "gripper": {"topic": FINGER, "names": ["gripper"], "open": 100.0, "closed": 0.0},
        "actions": [{"topic": COMMANDS, **ROS_TOPICS[topic]}],
        "max_age_s": 60.0,
        "silent_s": 60.0,
    }
    return RosRobot(settings_from(stated, "arm.yaml"), wire), wire


def last_goal(wire: Finger) -> list[float]:
    message = wire.published[-1][1]
    if "points" in message:
        message = message["points"][0]
    [goal] = [message[key] for key in ("positions", "position", "data") if key in message]
    return list(goal)


@pytest.mark.parametrize("commanded", [False, True])
@pytest.mark.parametrize("topic", ROS_TOPICS)
def test_a_robot_behind_topics_stops_where_it_is_and_keeps_its_grasp(
    topic: str, *, commanded: bool
) -> None:
    robot, wire = ros_robot(topic)
    with robot:
        robot.observe()
        if commanded:
            robot.apply(np.array([20.0, 5.0, GRASP], np.float32))
        for _ in range(3):
            robot.stop()
        arm = [0.0, 0.0] if "deltas" in topic else POSE[:2].tolist()
        assert last_goal(wire) == pytest.approx([*arm, GRASP if commanded else POSE[2]])


def test_a_robot_behind_topics_without_a_recent_pose_stays_as_it_is() -> None:
    robot, wire = ros_robot("trajectory")
    with robot:
        robot.observe()
        robot.apply(np.array([20.0, 5.0, GRASP], np.float32))
        wire.connections = 2  # all messages arrived before the loss of the connection
        robot.observe()
        robot.stop()
        assert len(wire.published) == 1
        wire.deliver(13.0, -3.0, 31.0)
        robot.observe()  # the stop is sent as soon as the pose is known
        assert last_goal(wire) == pytest.approx([13.0, -3.0, GRASP])


@pytest.mark.sim
@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("name", ["franka", "aloha"])
def test_an_arm_in_mujoco_stops_where_it_is_and_keeps_its_grasp(name: str, delta: bool) -> None:
    with closing(simulated_arm(name, cameras=(), delta=delta)) as arm:
        spec = arm.contract.action
        dim = spec.dim or 0
        grippers = list(Columns.from_spec(spec, dim).grippers)
        action = (
            np.full(dim, 0.5, np.float32)
            if delta
            else np.array(arm._goal, np.float32) + np.float32(0.5)
        )
        action[grippers] = 0.4
        arm.apply(action)
        arm.clock.sleep(0.1)
        arm.stop()
        stopped = arm.joints()
        arm.clock.sleep(2.0)
        arm.stop()
        assert np.abs(arm.joints() - stopped).max() < 0.2, "far from the goal"
        assert np.allclose(np.array(arm._goal)[grippers], 0.4)


def test_each_robot_that_this_distribution_registers_is_stopped_here() -> None:
    registered = {
        name for name, entry in entries("robots").items() if entry.distribution == DISTRIBUTION
    }
    assert registered == {"lerobot", "mujoco", "ros"}
