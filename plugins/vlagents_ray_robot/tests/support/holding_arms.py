"""Arms that hold an object: the fingers touch it at another opening than their goal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from ros_arm import COMMANDS, JOINTS, Wire, header

from vlagents_ray_robot.lerobot_robot import LeRobotRobot
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
