"""The file of the ROS 2 topics of a robot's cameras, state and actions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, get_args

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require
from vlagents_ray.robot.ros.messages import TWIST, PoseRotation, Values
from vlagents_ray.settings import require_arguments

ROS2 = "ros2"
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
JOINT_STATE, BOOL = "sensor_msgs/msg/JointState", "std_msgs/msg/Bool"
POSES = ("geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseStamped")
NUMBERS = tuple(f"std_msgs/msg/{name}" for name in ("Float64MultiArray", "Float32MultiArray", "Float64", "Float32"))
ARRAY, TWIST_TYPE, TRAJECTORY = NUMBERS[0], "geometry_msgs/msg/Twist", "trajectory_msgs/msg/JointTrajectory"
ZEROS, NOTHING = "zeros", "nothing"


@dataclass(frozen=True)
class InputTopic:
    """A topic that a part of the observation is read from."""

    topic: str
    type: str = ""  # such as "sensor_msgs/msg/Image"; "" is the default of its place in the file
    names: tuple[str, ...] = ()  # joints of a JointState, in the policy's order; all if empty
    values: Values = "position"  # field of a JointState
    rotation: PoseRotation = "quat_xyzw"  # form of the rotation of a pose
    open: float | None = None  # of the gripper: the number at which it is open
    closed: float | None = None
    max_age_s: float | None = None  # without a newer message the robot holds still; None: the file's
    silent_s: float | None = None  # without a newer message the robot is stopped; None: the file's


@dataclass(frozen=True)
class ActionTopic:
    """A topic that numbers of an action are published on."""

    topic: str
    type: str
    stop: str = ""  # to stop: "zeros", "nothing", or the part of the state with the measured pose
    numbers: int | None = None  # count of numbers of a Float64MultiArray
    names: tuple[str, ...] = ()  # joints of a JointState or JointTrajectory
    values: Values = "position"  # field of a JointState
    fields: tuple[str, ...] = TWIST  # of a Twist
    reach_s: float = 0.1  # time in which the arm should reach the point of a JointTrajectory

    @property
    def dim(self) -> int:
        """The count of an action's numbers that it takes."""
        if self.type == ARRAY:
            return self.numbers or 0
        return len(self.fields) if self.type == TWIST_TYPE else len(self.names)


@dataclass(frozen=True)
class HeartbeatTopic:
    """A `std_msgs/msg/Bool`, published while the control loop runs: whether it may move the robot."""

    topic: str
    hz: float = 10.0


@dataclass(frozen=True)
class RosSettings:
    """The settings of the file; see docs/ros.md."""

    link: str  # "ros2", or the address of a rosbridge: "ws://arm-pc:9090"
    actions: tuple[ActionTopic, ...]  # together they take the numbers of an action, in this order
    cameras: Mapping[str, InputTopic] = field(default_factory=dict)
    state: Mapping[str, InputTopic] = field(default_factory=dict)
    gripper: InputTopic | None = None
    heartbeat: HeartbeatTopic | None = None
    max_age_s: float = 0.3
    silent_s: float = 1.0
    clock: str = "stamp"  # whether a message's age counts from its header's time stamp, or from its arrival ("arrival")
    ready_s: float = 10.0  # time limit for the first message of each topic

    @property
    def sensors(self) -> list[InputTopic]:
        """The topics whose readings must be recent."""
        return [*self.cameras.values(), *self.state.values(), *([self.gripper] if self.gripper else [])]

    @property
    def dim(self) -> int:
        """The count of numbers of an action."""
        return sum(command.dim for command in self.actions)

    def max_age_of(self, reading: InputTopic) -> float:
        """Return the time without a newer message after which the robot holds still, s."""
        return self.max_age_s if reading.max_age_s is None else reading.max_age_s

    def silent_of(self, reading: InputTopic) -> float:
        """Return the time without a newer message after which the robot is stopped, s."""
        return self.silent_s if reading.silent_s is None else reading.silent_s


def read_settings(file: Path | str) -> RosSettings:
    """Read a YAML file of topics, as docs/ros.md explains it.

    Raises:
        ConfigError: The file cannot be read, or a setting is unknown, missing or wrong.
        MissingDependency: PyYAML is not installed.
    """
    yaml = require("yaml", extra="ros")
    try:
        stated = yaml.safe_load(Path(file).read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise ConfigError(f"{file}: cannot be read as a file of ROS topics ({error})") from error
    return settings_from(stated, str(file))


def settings_from(stated: Any, where: str) -> RosSettings:
    """Check the decoded document of a file with the name `where`, and return it; raises `ConfigError`."""
    top = dict(_mapping(stated, where))
    for part, kind in (("cameras", IMAGE), ("state", JOINT_STATE)):
        named = _mapping(top.get(part) or {}, f"{where}: {part}")
        top[part] = {str(name): _reading(one, f"{where}: {part}.{name}", kind) for name, one in named.items()}
    if top.get("gripper") is not None:
        top["gripper"] = _reading(top["gripper"], f"{where}: gripper", JOINT_STATE)
    if top.get("heartbeat") is not None:
        top["heartbeat"] = _made(HeartbeatTopic, top["heartbeat"], f"{where}: heartbeat")
    actions = top.get("actions") or []
    if not isinstance(actions, list):
        raise ConfigError(f"{where}: actions: got {type(actions).__name__}, want a list of topics")
    top["actions"] = tuple(_made(ActionTopic, one, f"{where}: actions[{i}]") for i, one in enumerate(actions))
    settings: RosSettings = _made(RosSettings, top, where)
    _check(settings, where)
    return settings


def _check(settings: RosSettings, where: str) -> None:
    readings = [
        *((f"cameras.{name}", one, (IMAGE, COMPRESSED)) for name, one in settings.cameras.items()),
        *((f"state.{name}", one, (JOINT_STATE, *POSES, *NUMBERS)) for name, one in settings.state.items()),
        *([("gripper", gripper, (JOINT_STATE, *NUMBERS))] if (gripper := settings.gripper) is not None else []),
    ]
    for name, reading, types in readings:
        _one_of(f"{where}: {name}: type", reading.type, types)
        _one_of(f"{where}: {name}: values", reading.values, get_args(Values))
        _one_of(f"{where}: {name}: rotation", reading.rotation, get_args(PoseRotation))
    types_of: dict[str, str] = {}
    for name, reading, _ in readings:
        if types_of.setdefault(reading.topic, reading.type) != reading.type:
            raise ConfigError(
                f"{where}: {name}: got {reading.topic} as {reading.type}, and elsewhere as {types_of[reading.topic]}"
            )
    if not settings.sensors:
        raise ConfigError(f"{where}: got no camera, state or gripper, want one, by whose age the robot is stopped")
    if not settings.actions:
        raise ConfigError(f"{where}: actions: got none, want the topics that command the robot")
    if gripper is not None and (gripper.open is None or gripper.closed is None or gripper.open == gripper.closed):
        raise ConfigError(f"{where}: gripper: got no two numbers, want `open` and `closed` as the topic gives them")
    for i, command in enumerate(settings.actions):
        _check_command(command, settings, f"{where}: actions[{i}]")
    limits = [(name, getattr(settings, name)) for name in ("max_age_s", "silent_s", "ready_s")]
    limits += [(f"{name}: {key}", getattr(one, key)) for name, one, _ in readings for key in ("max_age_s", "silent_s")]
    limits += [("heartbeat: hz", settings.heartbeat.hz)] if settings.heartbeat else []
    for name, limit in limits:
        if limit is not None and not limit > 0:
            raise ConfigError(f"{where}: {name}: got {limit}, want above 0")
    _one_of(f"{where}: clock", settings.clock, ("stamp", "arrival"))
    if settings.link != ROS2 and not settings.link.startswith(("ws://", "wss://")):
        raise ConfigError(f"{where}: link: got {settings.link!r}, want 'ros2', or a rosbridge as 'ws://arm-pc:9090'")


def _check_command(command: ActionTopic, settings: RosSettings, where: str) -> None:
    _one_of(f"{where}: type", command.type, (ARRAY, JOINT_STATE, TWIST_TYPE, TRAJECTORY))
    _one_of(f"{where}: values", command.values, get_args(Values))
    for name in command.fields:
        _one_of(f"{where}: fields", name, TWIST)
    if command.dim < 1:
        wants = "numbers, how many it takes" if command.type == ARRAY else "names, those of the joints"
        raise ConfigError(f"{where}: got a {command.type} without numbers, want {wants}")
    if command.type == TRAJECTORY and not command.reach_s > 0:
        raise ConfigError(f"{where}: reach_s: got {command.reach_s}, want above 0")
    if not command.stop and command.type != TWIST_TYPE:
        raise ConfigError(
            f"{where}: stop: got none, want what stops {command.topic}: {ZEROS!r} where numbers are velocities or "
            f"deltas, a part of the state with the measured pose where they are targets, or {NOTHING!r} where the "
            f"controller stays at its last target and that is right"
        )
    if command.stop and command.stop not in (ZEROS, NOTHING):
        _one_of(f"{where}: stop", command.stop, (ZEROS, NOTHING, *settings.state))


def _reading(stated: Any, where: str, kind: str) -> InputTopic:
    reading: InputTopic = _made(InputTopic, {"type": kind, **_mapping(stated, where)}, where)
    return reading


def _made(kind: type[Any], stated: Any, where: str) -> Any:
    given = dict(_mapping(stated, where))
    for name in given.keys() & {"names", "fields"}:
        value = given[name]
        if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
            raise ConfigError(f"{where}: {name}: got {value!r}, want a list of names")
        given[name] = tuple(value)
    require_arguments(where, kind, given)
    return kind(**given)


def _mapping(stated: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(stated, Mapping):
        raise ConfigError(f"{where}: got {type(stated).__name__}, want keys with values; see docs/ros.md")
    return stated


def _one_of(what: str, got: object, want: tuple[object, ...]) -> None:
    if got not in want:
        raise ConfigError(f"{what}: got {got!r}, want one of {list(want)}")
