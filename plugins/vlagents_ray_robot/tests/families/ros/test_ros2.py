"""Tests of a robot behind topics of a real ROS 2 (rclpy and its middleware), with a driver that
does not use this package.

If ROSBRIDGE_URL names a rosbridge_server with the same ROS_DOMAIN_ID, the tests also run through
that server.
"""

from __future__ import annotations

import contextlib
import os
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import ros_arm
from eval_fakes import wait_for
from ros_arm import BEAT, CAMERA, COMMANDS, JOINTS, RosArm

os.environ.setdefault("ROS_DOMAIN_ID", "87")
os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"

import rclpy
from geometry_msgs.msg import Twist
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Bool, Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from vlagents_ray import Act, ActionSpec, Agent, CameraSpec, ChunkPlayer, Contract, Obs, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.robot import Guard, Watchdog, run_loop
from vlagents_ray.robot.guard import measured_state
from vlagents_ray_robot.ros import RosRobot
from vlagents_ray_robot.ros.links import Ros2
from vlagents_ray_robot.ros.robot import settings_from

pytestmark = [
    # The warning is of a parser that rclpy imports.
    pytest.mark.filterwarnings("ignore:module 'sre_:DeprecationWarning"),
    # The warning is of rclpy itself, about logging.
    pytest.mark.filterwarnings("ignore:Deprecated in favor of:DeprecationWarning"),
]

STEP, MAX_STEP = 0.01, 0.05
each_link = pytest.mark.parametrize(
    "link", ["ros2", *filter(None, [os.environ.get("ROSBRIDGE_URL")])]
)


class Driver:
    """A node of ROS 2 that publishes the arm's messages, and records the messages that are
    published to it.
    """

    def __init__(self) -> None:
        self.came: dict[str, list[Any]] = {}
        self._context = rclpy.context.Context()
        self._context.init()
        self.node = rclpy.create_node("driver", context=self._context)
        self._publishers = {
            CAMERA: self.node.create_publisher(Image, CAMERA, qos_profile_sensor_data),
            # This publisher is reliable.
            JOINTS: self.node.create_publisher(JointState, JOINTS, 10),
        }
        self._executor = SingleThreadedExecutor(context=self._context)
        self._thread = threading.Thread(target=self._spin)

    def note(self, kind: type[Any], topic: str) -> None:
        """Record the messages that are published on a topic."""
        came = self.came.setdefault(topic, [])
        self.node.create_subscription(
            kind, topic, came.append, QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        )

    def __enter__(self) -> Driver:
        self._executor.add_node(self.node)
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._context.try_shutdown()
        self._thread.join()
        self.node.destroy_node()

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        made = {CAMERA: self._image, JOINTS: self._state}[topic](message)
        made.header.stamp = self.node.get_clock().now().to_msg()
        self._publishers[topic].publish(made)

    def commands(self) -> list[dict[str, Any]]:
        return [{"data": list(message.data)} for message in list(self.came[COMMANDS])]

    def _image(self, said: dict[str, Any]) -> Image:
        names = ("height", "width", "encoding", "is_bigendian", "step", "data")
        return Image(**{name: said[name] for name in names})

    def _state(self, said: dict[str, Any]) -> JointState:
        return JointState(name=said["name"], position=said["position"].tolist())

    def _spin(self) -> None:
        with contextlib.suppress(ExternalShutdownException):
            self._executor.spin()


class Ahead(Agent):
    """Returns single rows that are STEP beyond the measured pose."""

    contract = Contract(
        {"front": CameraSpec(ros_arm.SIDE, ros_arm.SIDE)},
        {"joints": StateSpec(2)},
        action=ActionSpec(dim=2, space="joint", delta=False, low=-3.0, high=3.0),
    )

    def act(self, obs: Obs) -> Act:
        return Act(obs.state["joints"] + np.float32(STEP))


@pytest.fixture
def driver() -> Iterator[Driver]:
    made = Driver()
    made.note(Float64MultiArray, COMMANDS)
    made.note(Bool, BEAT)
    with made:
        yield made


@each_link
def test_an_arm_is_driven_held_and_stopped_by_topics_of_ros(driver: Driver, link: str) -> None:
    settings = settings_from(ros_arm.settings(link, max_age_s=0.5), "arm.yaml")
    over = threading.Event()
    with RosArm(driver.publish, driver.commands) as arm, RosRobot(settings) as robot:
        guard = Guard(Ahead.contract, max_step=MAX_STEP, measure=measured_state("joints"))
        watchdog = robot.watchdog = Watchdog(lambda _: robot.stop(), robot.silent_s)
        with ChunkPlayer(Ahead(), check=guard) as player:
            thread = threading.Thread(
                target=lambda: run_loop(robot, player, hz=30, watchdog=watchdog, until=over.is_set)
            )
            thread.start()
            try:
                wait_for(lambda: len(driver.came[COMMANDS]) > 10)
                arm.broken = {CAMERA}
                wait_for(lambda: robot.holds is not None)
                assert robot.holds == f"no new message of {CAMERA} for more than 0.5 s"
                wait_for(lambda: not driver.came[BEAT][-1].data)
                arm.broken = set()
                now = len(driver.came[COMMANDS])
                wait_for(lambda: len(driver.came[COMMANDS]) > now + 5)
            finally:
                over.set()
                thread.join()
        wait_for(lambda: driver.commands()[-1]["data"] in arm.poses)
    commands = [one["data"] for one in driver.commands()]
    assert np.abs(np.diff([[0.0, 0.0], *commands], axis=0)).max() <= MAX_STEP
    assert commands[-1][0] > 0.05


@each_link
def test_each_type_of_action_arrives_as_a_message_of_ros(driver: Driver, link: str) -> None:
    names = ros_arm.NAMES
    actions = [
        {
            "topic": "/t",
            "type": "trajectory_msgs/msg/JointTrajectory",
            "names": names,
            "stop": "joints",
            "reach_s": 1.5,
        },
        {
            "topic": "/s",
            "type": "sensor_msgs/msg/JointState",
            "names": ["finger"],
            "values": "velocity",
            "stop": "zeros",
        },
        {"topic": "/v", "type": "geometry_msgs/msg/Twist", "fields": ["linear.x", "angular.z"]},
    ]
    for kind, topic in ((JointTrajectory, "/t"), (JointState, "/s"), (Twist, "/v")):
        driver.note(kind, topic)
    settings = settings_from({**ros_arm.settings(link), "actions": actions}, "arm.yaml")
    with RosArm(driver.publish, driver.commands) as arm, RosRobot(settings) as robot:
        arm.joints = [0.25, -0.25]
        wait_for(lambda: robot.observe().state["joints"][0] == 0.25)
        action = np.array([0.1, 0.2, 0.3, 0.4, 0.5], np.float32)

        def came(topic: str) -> Any:
            # The command is repeated until both nodes have discovered each other.
            wait_for(lambda: robot.apply(action) or driver.came[topic])
            return driver.came[topic][-1]

        trajectory, state, twist = came("/t"), came("/s"), came("/v")
        assert (list(trajectory.joint_names), len(trajectory.points)) == (names, 1)
        assert list(trajectory.points[0].positions) == pytest.approx([0.1, 0.2])
        start = trajectory.points[0].time_from_start
        assert (start.sec, start.nanosec) == (1, 500_000_000)
        assert (list(state.name), list(state.velocity), list(state.position)) == (
            ["finger"],
            pytest.approx([0.3]),
            [],
        )
        assert abs(time.time() - state.header.stamp.sec) < 60
        assert (twist.linear.x, twist.angular.z, twist.linear.y) == (
            pytest.approx(0.4),
            pytest.approx(0.5),
            0.0,
        )
        robot.stop()
        wait_for(lambda: list(driver.came["/t"][-1].points[0].positions) == [0.25, -0.25])
        wait_for(lambda: driver.came["/v"][-1] == Twist())
        wait_for(lambda: list(driver.came["/s"][-1].velocity) == [0.0])


def test_a_message_that_ros_does_not_have_is_an_error_with_the_cure() -> None:
    link = Ros2()
    try:
        for kind in ("no_msgs/msg/Image", "sensor_msgs/msg/Picture"):
            with pytest.raises(
                ConfigError, match=r"ROS has no such message here.*install the package"
            ):
                link.advertise("/a", kind)
    finally:
        link.close()
