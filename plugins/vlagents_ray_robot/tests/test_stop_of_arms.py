"""Tests of `stop` for every arm: the arm rests where it is and keeps its grasp, whichever sensor is
broken.
"""

from __future__ import annotations

import threading
import time
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
from arm_models import simulated_arm
from holding_arms import (
    FOLLOWERS,
    GRASP,
    POSE,
    ROS_TOPICS,
    Bus,
    FakeFollower,
    FakeTwoArms,
    last_goal,
    robot_of,
    ros_robot,
)

from vlagents_ray.columns import Columns
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import entries
from vlagents_ray_robot import DISTRIBUTION
from vlagents_ray_robot.lerobot_robot import OneAtATime


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
    assert set(follower.wire.goals.values()) <= set(POSE[:2].tolist())


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
        if not commanded and "deltas" not in topic:
            assert wire.published == [], "the goal of the gripper is not known"
            return
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
