"""A robot behind topics of ROS 2, and the file that names the topics of observation and action."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np

from vlagents_ray.chunking.buffer import SKEW_S, CaptureClock
from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError, InvalidAction, VLAgentsError
from vlagents_ray.interface import CAPTURED, Obs
from vlagents_ray.robot.watchdog import Watchdog
from vlagents_ray.settings import require_arguments
from vlagents_ray.yaml_text import load_yaml
from vlagents_ray_robot import DISTRIBUTION
from vlagents_ray_robot.ros import messages
from vlagents_ray_robot.ros.links import Link, Ros2, Rosbridge
from vlagents_ray_robot.ros.messages import TWIST, PoseRotation, Values

logger = logging.getLogger(__name__)
ROS2 = "ros2"
# Types of messages
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
JOINT_STATE = "sensor_msgs/msg/JointState"
BOOL = "std_msgs/msg/Bool"
POSES = ("geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseStamped")
ARRAY = "std_msgs/msg/Float64MultiArray"
NUMBERS = (ARRAY, "std_msgs/msg/Float32MultiArray", "std_msgs/msg/Float64", "std_msgs/msg/Float32")
TWIST_TYPE = "geometry_msgs/msg/Twist"
TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
# Values of `stop` that are not the name of a part of the state.
ZEROS = "zeros"
NOTHING = "nothing"
_AGE_KEYS = ("max_age_s", "silent_s")


@dataclass(frozen=True)
class InputTopic:
    """A topic from which a camera, a part of the state or the gripper is read."""

    topic: str
    type: str = ""  # such as "sensor_msgs/msg/Image"; the file's section has a default
    names: tuple[str, ...] = ()  # joints of a JointState, in the policy's order; all if empty
    values: Values = "position"  # the field of a JointState that is read
    rotation: PoseRotation = "quat_xyzw"  # the form of the rotation of a pose
    open: float | None = None  # the value on the topic at which the gripper is open
    closed: float | None = None  # the value on the topic at which the gripper is closed
    max_age_s: float = 0.3  # if the newest message is older, the robot holds still
    silent_s: float = 1.0  # if the newest message is older, the watchdog stops the robot


@dataclass(frozen=True)
class ActionTopic:
    """A topic on which numbers of an action are published."""

    topic: str
    type: str
    # The message that stops the robot: "zeros", "nothing", or the part of the state with the
    # measured pose.
    stop: str = ""
    numbers: int | None = None  # how many numbers a Float64MultiArray has
    names: tuple[str, ...] = ()  # the joints of a JointState or JointTrajectory
    values: Values = "position"  # the field of a JointState
    fields: tuple[str, ...] = TWIST  # the fields of a Twist
    reach_s: float = 0.1  # the time in which the arm should reach the point of a JointTrajectory
    # The indices of the grippers among the topic's numbers; None finds them by name, see
    # `RosSettings.grippers_of`.
    grippers: tuple[int, ...] | None = None

    @property
    def dim(self) -> int:
        """How many numbers of an action are published on this topic."""
        if self.type == ARRAY:
            return self.numbers or 0
        return len(self.fields) if self.type == TWIST_TYPE else len(self.names)


@dataclass(frozen=True)
class HeartbeatTopic:
    """A topic of type `std_msgs/msg/Bool` whose messages say whether the control loop may move the
    robot.
    """

    topic: str
    hz: float = 10.0


@dataclass(frozen=True)
class RosSettings:
    """The settings of the file; see docs/ros.md."""

    link: str  # "ros2", or the address of a rosbridge, such as "ws://arm-pc:9090"
    # The topics on which the numbers of an action are published, in this order.
    actions: tuple[ActionTopic, ...]
    cameras: Mapping[str, InputTopic] = field(default_factory=dict)
    state: Mapping[str, InputTopic] = field(default_factory=dict)
    gripper: InputTopic | None = None
    heartbeat: HeartbeatTopic | None = None
    # The age of a message counts from the time stamp in its header ("stamp") or from its arrival
    # ("arrival").
    clock: str = "stamp"
    ready_s: float = 10.0  # the time limit for the first message of each topic

    @property
    def sensors(self) -> list[InputTopic]:
        """The topics whose readings must be recent."""
        topics = [*self.cameras.values(), *self.state.values()]
        if self.gripper is not None:
            topics.append(self.gripper)
        return topics

    @property
    def dim(self) -> int:
        """How many numbers an action has."""
        return sum(command.dim for command in self.actions)

    @property
    def delta(self) -> bool | None:
        """Whether actions are relative.

        False if the measured pose stops the robot, as the numbers of an action are then targets.
        None otherwise: zeros stop both velocities and deltas, and the meaning of a topic's numbers
        is unknown if it has no stop.
        """
        stops = {command.stop for command in self.actions} - {NOTHING}
        return False if stops and stops <= self.state.keys() else None

    def grippers_of(self, command: ActionTopic) -> list[int]:
        """Return the indices of the grippers among the numbers of a topic.

        Without a setting, these are the joints that the topic of the gripper names, the joints
        whose names contain "gripper", and the only number of a topic whose name contains "gripper".
        Numbers that zeros stop are velocities or deltas, of which only the joints of the gripper's
        topic are known to be a position.
        """
        if command.grippers is not None:
            return list(command.grippers)

        measured = self.state.get(command.stop)
        names = command.names
        if not names and measured is not None:
            names = measured.names
        fingers = () if self.gripper is None else self.gripper.names
        by_name = command.stop != ZEROS
        if not names and by_name and command.dim == 1 and "gripper" in command.topic.lower():
            return [0]

        grippers = []
        for index, name in enumerate(names):
            if name in fingers or (by_name and "gripper" in name.lower()):
                grippers.append(index)
        return grippers

    @property
    def grippers(self) -> list[int]:
        """The indices of all grippers in an action."""
        grippers = []
        first = 0
        for command in self.actions:
            grippers += [first + index for index in self.grippers_of(command)]
            first += command.dim
        return grippers


def read_settings(file: Path | str) -> RosSettings:
    """Read a YAML file of topics, as docs/ros.md explains it.

    Args:
        file: The path of the file.

    Returns:
        The settings.

    Raises:
        ConfigError: The file cannot be read, or a setting is unknown, missing or wrong.
        MissingDependency: PyYAML is not installed.
    """
    try:
        text = Path(file).read_text(encoding="utf-8")
        document = load_yaml(text, extra="ros", distribution=DISTRIBUTION)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read as a file of ROS topics ({error})") from error
    return settings_from(document, str(file))


def settings_from(document: Any, where: str) -> RosSettings:
    """Check the content of a file of topics.

    Args:
        document: The decoded content.
        where: The name of the file, for errors.

    Returns:
        The settings.

    Raises:
        ConfigError: A setting is unknown, missing or wrong.
    """
    top = dict(_mapping(document, where))
    # Ages at the top of the file are defaults for all sensors.
    default_ages = {key: top.pop(key) for key in _AGE_KEYS if key in top}

    for section, default_type in (("cameras", IMAGE), ("state", JOINT_STATE)):
        topics = {}
        for name, node in _mapping(top.get(section) or {}, f"{where}: {section}").items():
            setting = f"{where}: {section}.{name}"
            topics[str(name)] = _input_topic(node, setting, default_type, default_ages)
        top[section] = topics

    if top.get("gripper") is not None:
        setting = f"{where}: gripper"
        top["gripper"] = _input_topic(top["gripper"], setting, JOINT_STATE, default_ages)
    if top.get("heartbeat") is not None:
        top["heartbeat"] = _settings(HeartbeatTopic, top["heartbeat"], f"{where}: heartbeat")

    nodes = top.get("actions") or []
    if not isinstance(nodes, list):
        raise ConfigError(
            f"{where}: actions: expected a list of topics, got {type(nodes).__name__}"
        )
    actions = []
    for i, node in enumerate(nodes):
        actions.append(_settings(ActionTopic, node, f"{where}: actions[{i}]"))
    top["actions"] = tuple(actions)

    settings: RosSettings = _settings(RosSettings, top, where)
    _check_sensors(settings, where)
    _check_actions(settings, where)
    _check_link(settings, where)
    return settings


def _named_sensors(settings: RosSettings) -> list[tuple[str, InputTopic, tuple[str, ...]]]:
    """Return the name of each sensor in the file, its topic, and the types that it may have."""
    sensors: list[tuple[str, InputTopic, tuple[str, ...]]] = []
    for name, topic in settings.cameras.items():
        sensors.append((f"cameras.{name}", topic, (IMAGE, COMPRESSED)))
    for name, topic in settings.state.items():
        sensors.append((f"state.{name}", topic, (JOINT_STATE, *POSES, *NUMBERS)))
    if settings.gripper is not None:
        sensors.append(("gripper", settings.gripper, (JOINT_STATE, *NUMBERS)))
    return sensors


def _check_sensors(settings: RosSettings, where: str) -> None:
    """Raise `ConfigError` if a setting of a sensor is wrong."""
    sensors = _named_sensors(settings)
    for name, topic, types in sensors:
        _require_one_of(f"{where}: {name}: type", topic.type, types)
        _require_one_of(f"{where}: {name}: values", topic.values, get_args(Values))
        _require_one_of(f"{where}: {name}: rotation", topic.rotation, get_args(PoseRotation))

    type_of_topic: dict[str, str] = {}
    for name, topic, _ in sensors:
        if type_of_topic.setdefault(topic.topic, topic.type) != topic.type:
            raise ConfigError(
                f"{where}: {name}: expected {topic.topic} as {type_of_topic[topic.topic]}, as "
                f"elsewhere in the file, got {topic.type}; use one type for it"
            )

    if not settings.sensors:
        raise ConfigError(
            f"{where}: expected a camera, state or gripper, since the robot is stopped if its "
            f"messages are too old, got none; add one"
        )
    for name, topic, _ in sensors:
        _require_above_zero(f"{where}: {name}: max_age_s", topic.max_age_s)
        _require_above_zero(f"{where}: {name}: silent_s", topic.silent_s)

    gripper = settings.gripper
    if gripper is None:
        return
    if gripper.open is None or gripper.closed is None or gripper.open == gripper.closed:
        raise ConfigError(
            f"{where}: gripper: expected two different numbers, got open={gripper.open} and "
            f"closed={gripper.closed}; set `open` and `closed` to the values on the topic"
        )


def _check_actions(settings: RosSettings, where: str) -> None:
    """Raise `ConfigError` if a setting of a topic for actions is wrong."""
    if not settings.actions:
        raise ConfigError(
            f"{where}: actions: expected the topics that command the robot, got none; add them"
        )
    for i, command in enumerate(settings.actions):
        _check_command(command, settings, f"{where}: actions[{i}]")


def _check_link(settings: RosSettings, where: str) -> None:
    """Raise `ConfigError` if a setting of the connection is wrong."""
    _require_above_zero(f"{where}: ready_s", settings.ready_s)
    if settings.heartbeat is not None:
        _require_above_zero(f"{where}: heartbeat: hz", settings.heartbeat.hz)
    _require_one_of(f"{where}: clock", settings.clock, ("stamp", "arrival"))
    if settings.link != ROS2 and not settings.link.startswith(("ws://", "wss://")):
        raise ConfigError(
            f"{where}: link: expected 'ros2', or a rosbridge as 'ws://arm-pc:9090', got "
            f"{settings.link!r}"
        )


def _check_command(command: ActionTopic, settings: RosSettings, where: str) -> None:
    """Raise `ConfigError` if a setting of one topic for actions is wrong."""
    types = (ARRAY, JOINT_STATE, TWIST_TYPE, TRAJECTORY)
    _require_one_of(f"{where}: type", command.type, types)
    _require_one_of(f"{where}: values", command.values, get_args(Values))
    for name in command.fields:
        _require_one_of(f"{where}: fields", name, TWIST)
    if command.dim < 1:
        needed = (
            "`numbers`, how many numbers it has"
            if command.type == ARRAY
            else "`names`, the names of the joints"
        )
        raise ConfigError(f"{where}: expected {needed}, got none for a {command.type}; add them")
    if command.type == TRAJECTORY and not command.reach_s > 0:
        raise ConfigError(f"{where}: reach_s: expected a number above 0, got {command.reach_s}")

    if not command.stop and command.type != TWIST_TYPE:
        raise ConfigError(
            f"{where}: stop: expected the value that stops {command.topic}, got none; set "
            f"{ZEROS!r} where numbers are velocities or deltas, a part of the state with the "
            f"measured pose where they are targets, or {NOTHING!r} where it is right that the "
            f"controller stays at its last target"
        )
    if command.stop and command.stop not in (ZEROS, NOTHING):
        _require_one_of(f"{where}: stop", command.stop, (ZEROS, NOTHING, *settings.state))

    for index in command.grippers or ():
        _require_one_of(f"{where}: grippers", index, tuple(range(command.dim)))
    if command.grippers and command.stop == ZEROS and settings.gripper is None:
        raise ConfigError(
            f"{where}: grippers: got {list(command.grippers)} in a topic that zeros stop, and no "
            "`gripper`; add the topic of the gripper's opening, which a stop publishes in place "
            "of a zero"
        )


def _input_topic(
    node: Any, where: str, default_type: str, default_ages: Mapping[str, Any]
) -> InputTopic:
    """Return the settings of a sensor, with the defaults of the file."""
    values = {"type": default_type, **default_ages, **_mapping(node, where)}
    topic: InputTopic = _settings(InputTopic, values, where)
    return topic


def _settings(cls: type[Any], node: Any, where: str) -> Any:
    """Return an object of a dataclass of settings, from a mapping in the file."""
    arguments = dict(_mapping(node, where))
    for name in arguments.keys() & {"names", "fields"}:
        value = arguments[name]
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise ConfigError(f"{where}: {name}: expected a list of names, got {value!r}")
        arguments[name] = tuple(value)

    grippers = arguments.get("grippers")
    if grippers is not None:
        if not isinstance(grippers, list) or not all(type(number) is int for number in grippers):
            raise ConfigError(
                f"{where}: grippers: expected a list of numbers from 0, such as [2], got "
                f"{grippers!r}"
            )
        arguments["grippers"] = tuple(grippers)

    require_arguments(where, cls, arguments)
    return cls(**arguments)


def _mapping(node: Any, where: str) -> Mapping[str, Any]:
    """Return a node of the file; raise `ConfigError` if it is not a mapping."""
    if not isinstance(node, Mapping):
        raise ConfigError(
            f"{where}: expected keys with values, got {type(node).__name__}; see docs/ros.md"
        )
    return node


def _require_one_of(setting: str, value: object, allowed: tuple[object, ...]) -> None:
    """Raise `ConfigError` if the value of a setting is not allowed."""
    if value not in allowed:
        raise ConfigError(f"{setting}: expected one of {list(allowed)}, got {value!r}")


def _require_above_zero(setting: str, value: float) -> None:
    """Raise `ConfigError` if the value of a setting is not above 0."""
    if not value > 0:
        raise ConfigError(f"{setting}: expected a number above 0, got {value}")


class TopicReader:
    """The newest readable message of a topic, as a value of the observation.

    Args:
        reading: The settings of the topic.
        by_stamp: Whether the age of a message counts from the time stamp in its header.
    """

    def __init__(self, reading: InputTopic, by_stamp: bool) -> None:
        self.topic = reading.topic
        self.value: Any = None  # None before the first message
        self.captured_at = 0.0  # capture time of the value, s since 1970
        self.unreadable = 0  # the number of messages that could not be read

        self._reading = reading
        self._by_stamp = by_stamp
        self._clock = CaptureClock()
        self._captured_s = -math.inf  # the same time, s of `time.monotonic`

        # A stop by the watchdog reads the pose at the same time as the control loop.
        self._lock = threading.Lock()
        # The newest message and the last decoded message, with the times of their arrival, s since
        # 1970.
        self._newest: tuple[Any, float] | None = None
        self._decoded: tuple[Any, float] | None = None

    def take(self, message: Any) -> None:
        """Store a message, on the link's thread; the control loop decodes only the newest
        message.
        """
        self._newest = message, time.time()

    def refresh(self) -> None:
        """Decode the newest message, if it is not decoded yet.

        An unreadable message is ignored, so that the age of the reading grows.

        Raises:
            ConfigError: The first message is unreadable.
        """
        with self._lock:
            newest = self._newest
            if newest is None or newest is self._decoded:
                return
            self._decoded = newest
            message, arrived_at = newest

            try:
                value = self._read(message)
                stamp = messages.stamp(message) if self._by_stamp else None
            except VLAgentsError as error:
                self.unreadable += 1
                if self.value is None:
                    raise ConfigError(f"{self.topic}: {error}") from error
                if self.unreadable == 1:
                    logger.warning(
                        "%s: ignored an unreadable message, and will ignore others without a "
                        "warning: %s",
                        self.topic,
                        error,
                    )
                return

            self.value = value
            self.captured_at = stamp or arrived_at
            self._captured_s = self._clock(Obs(info={CAPTURED: self.captured_at}))

    def _read(self, message: Any) -> Any:
        """Return the image, the part of the state or the gripper's opening in a message; the
        opening follows from the first number.
        """
        reading = self._reading
        if reading.type == IMAGE:
            return messages.image(message)
        if reading.type == COMPRESSED:
            return messages.compressed_image(message)

        if reading.type == JOINT_STATE:
            numbers = messages.joints(message, reading.names, reading.values)
        elif reading.type in POSES:
            numbers = messages.pose(message, reading.rotation)
        else:
            numbers = messages.numbers(message)

        if reading.open is None or reading.closed is None:
            return numbers
        opening = (float(numbers[0]) - reading.closed) / (reading.open - reading.closed)
        return min(1.0, max(0.0, opening))

    @property
    def age_s(self) -> float:
        """The age of the reading, s; infinite if its capture time is in the future."""
        return time.monotonic() - self._captured_s


class RosRobot:
    """A `Robot` whose cameras, state and actions are topics.

    An observation has the newest message of each topic, and the time of the oldest of these
    messages as `captured_at`. While a message is older than its `max_age_s`, or the link is lost,
    `holds` is the reason why the control loop stops the robot; it continues by itself later. After
    `silent_s` without a new message the watchdog stops the robot. Use it as a context manager,
    which connects and waits for the first message of each topic.

    Args:
        settings: The topics, or the path of their YAML file.
        link: The link to the topics; default: the link that the settings name.
    """

    dates_pictures = True
    """Whether `captured_at` is from the messages, so that the age of a picture grows if its camera
    hangs.
    """

    def __init__(self, settings: RosSettings | Path | str, link: Link | None = None) -> None:
        if not isinstance(settings, RosSettings):
            settings = read_settings(settings)
        self.settings = settings
        self.holds: str | None = None
        self.watchdog: Watchdog | None = None
        """The watchdog of the control loop, with `silent_s` among its sources."""
        if link is None:
            link = Ros2() if settings.link == ROS2 else Rosbridge(settings.link)
        self._link: Link = link

        self._readers: dict[int, TopicReader] = {}  # the readers by the id of their settings
        for sensor in settings.sensors:
            self._readers[id(sensor)] = TopicReader(sensor, settings.clock == "stamp")

        self._beat_at = -math.inf  # the time of the last heartbeat, s of `time.monotonic`
        self._connections = 0
        # The last time at which the connection was lost, s of `time.monotonic`.
        self._lost_at = -math.inf
        self._stop_unsent = False
        # The last numbers that were published on each topic of the actions, by the topic's index.
        self._commanded: dict[int, np.ndarray] = {}

        types = {sensor.topic: sensor.type for sensor in settings.sensors}
        for topic, message_type in types.items():
            self._link.subscribe(topic, message_type, partial(self._take, topic))
        for command in settings.actions:
            self._link.advertise(command.topic, command.type)
        if settings.heartbeat is not None:
            self._link.advertise(settings.heartbeat.topic, BOOL)

    def __enter__(self) -> RosRobot:
        self._link.open()
        self._connections = self._link.connections
        try:
            self._wait_for_messages()
        except BaseException:
            self._link.close()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        self._beat(alive=False)
        self._link.close()

    @property
    def silent_s(self) -> dict[str, float]:
        """The sources for a `Watchdog`: each topic, and its maximum time without a new
        message, s.
        """
        limits: dict[str, float] = {}
        for reading in self.settings.sensors:
            limits[reading.topic] = min(reading.silent_s, limits.get(reading.topic, math.inf))
        return limits

    @property
    def joint_names(self) -> list[str]:
        """The joints in the order of an action, as far as the settings of its topics name them."""
        names: list[str] = []
        for command in self.settings.actions:
            names += command.names
        return names

    @property
    def contract(self) -> Contract:
        """The contract of the topics, from the messages received so far."""
        images = self._values(self.settings.cameras)
        state = self._values(self.settings.state)
        return Contract(
            cameras={name: CameraSpec(*image.shape[:2]) for name, image in images.items()},
            state={name: StateSpec(len(vector)) for name, vector in state.items()},
            gripper=self.settings.gripper is not None,
            action=ActionSpec(
                dim=self.settings.dim,
                delta=self.settings.delta,
                grippers=tuple(self.settings.grippers),
            ),
        )

    def observe(self) -> Obs:
        """Return the newest message of each topic; also publishes the heartbeat."""
        for reader in self._readers.values():
            reader.refresh()
        self._hold_if_old()
        self._beat(alive=True)

        gripper = self.settings.gripper
        captured_at = min(reader.captured_at for reader in self._readers.values())
        return Obs(
            cameras=self._values(self.settings.cameras),
            gripper=None if gripper is None else self._value(gripper),
            state=self._values(self.settings.state),
            info={CAPTURED: captured_at},
        )

    def apply(self, action: np.ndarray) -> None:
        """Publish an action on the topics.

        Args:
            action: The numbers of all topics, (D,), in the order of the settings.

        Raises:
            InvalidAction: The length of the action differs from that of the topics' numbers.
        """
        if action.shape != (self.settings.dim,):
            raise InvalidAction(
                f"action: expected shape ({self.settings.dim},), as the topics need, got "
                f"{action.shape}"
            )
        first = 0
        for index, command in enumerate(self.settings.actions):
            row = action[first : first + command.dim].copy()
            self._commanded[index] = row
            self._publish(command, row)
            first += command.dim

    def stop(self) -> None:
        """Publish the stop of each topic: zeros, or the measured pose if that is recent.

        Grippers keep their last command, as the measured opening would loosen their grasp. For the
        same reason, nothing is published on a topic of targets with a gripper before the first
        command.
        """
        self._stop_unsent = not self._link.up  # An unsent stop is sent when the link is up again.
        for index, command in enumerate(self.settings.actions):
            if command.stop == NOTHING:
                continue

            grippers = self.settings.grippers_of(command)
            is_target = command.stop not in ("", ZEROS)
            if is_target and grippers and index not in self._commanded:
                continue  # the goals of its grippers are not known, and it was not moved
            if not is_target:
                row = np.zeros(command.dim, np.float32)
                row[grippers] = self._measured_opening()
            else:
                reading = self.settings.state[command.stop]
                reader = self._readers[id(reading)]
                reader.refresh()
                if reader.age_s > reading.max_age_s or self._from_before_loss(reader):
                    self._stop_unsent = True  # The stop is sent when a pose is known.
                    logger.warning(
                        "%s: no stop was published, as the pose of %s is old",
                        command.topic,
                        reading.topic,
                    )
                    continue
                row = reader.value.copy()

            if index in self._commanded:
                row[grippers] = self._commanded[index][grippers]
            self._publish(command, row)

    def _measured_opening(self) -> float:
        """Return the opening of the gripper in the units of its topic; 0 without such a topic."""
        reading = self.settings.gripper
        if reading is None or reading.open is None or reading.closed is None:
            return 0.0
        return float(reading.closed + self._value(reading) * (reading.open - reading.closed))

    def _from_before_loss(self, reader: TopicReader) -> bool:
        """Return whether the reading is older than the last loss of the connection."""
        return time.monotonic() - self._lost_at <= reader.age_s < math.inf

    def _publish(self, command: ActionTopic, row: np.ndarray) -> None:
        """Publish numbers on a topic, as a message of its type."""
        if command.type == ARRAY:
            message = messages.float64_multi_array(row)
        elif command.type == JOINT_STATE:
            message = messages.joint_state(row, command.names, command.values)
        elif command.type == TWIST_TYPE:
            message = messages.twist(row, command.fields)
        else:
            message = messages.joint_trajectory(row, command.names, command.reach_s)
        self._link.publish(command.topic, message)

    def _hold_if_old(self) -> None:
        """Set `holds` if a reading is too old or the link is lost, and report the age of each topic
        to the watchdog.
        """
        connections = self._link.connections
        # The connection was lost and made again between two ticks.
        was_lost = connections != self._connections
        if not self._link.up or was_lost:
            self._connections = connections
            self._lost_at = time.monotonic()
            # The last stop may have been sent before the loss was detected.
            self._stop_unsent = True

        lost = any(self._from_before_loss(reader) for reader in self._readers.values())
        self.holds = f"the connection to the {self._link.name} was lost" if lost else None
        for reading in self.settings.sensors:
            reader = self._readers[id(reading)]
            if reader.age_s > reading.max_age_s and self.holds is None:
                self.holds = (
                    f"no new message of {reading.topic} for more than {reading.max_age_s:g} s"
                )
            if self.watchdog is not None and reader.age_s < math.inf:
                self.watchdog.heard(reading.topic, max(0.0, reader.age_s))

        if self._stop_unsent and self.holds is None:
            self.stop()

    def _beat(self, *, alive: bool) -> None:
        """Publish the heartbeat, if it is due.

        Args:
            alive: Whether the control loop runs; otherwise a last heartbeat is sent immediately.
        """
        heartbeat = self.settings.heartbeat
        now = time.monotonic()
        if heartbeat is None or (alive and now - self._beat_at < 1 / heartbeat.hz):
            return

        self._beat_at = now
        is_stopped = self.watchdog is not None and self.watchdog.control.stopped
        may_move = alive and not is_stopped and self.holds is None
        self._link.publish(heartbeat.topic, {"data": may_move})

    def _value(self, reading: InputTopic) -> Any:
        """Return the newest value of a topic."""
        return self._readers[id(reading)].value

    def _values(self, readings: Mapping[str, InputTopic]) -> dict[str, Any]:
        """Return the newest value of each topic, by name."""
        return {name: self._value(reading) for name, reading in readings.items()}

    def _take(self, topic: str, message: Any) -> None:
        """Pass a message of a topic to the readers of the topic."""
        for reader in self._readers.values():
            if reader.topic == topic:
                reader.take(message)

    def _wait_for_messages(self) -> None:
        """Wait for the first message of each topic, and check it; raise `ConfigError` if one is
        missing or wrong.
        """
        deadline = time.monotonic() + self.settings.ready_s
        while True:
            for reader in self._readers.values():
                reader.refresh()
            readers = self._readers.values()
            missing = sorted({reader.topic for reader in readers if reader.value is None})
            if not missing:
                break
            if time.monotonic() > deadline:
                raise ConfigError(
                    f"{self.settings.link}: expected a message of each topic within "
                    f"{self.settings.ready_s:g} s, got none of {missing}; compare names and types "
                    "with `ros2 topic list --show-types`"
                )
            time.sleep(0.01)

        for reading in self.settings.sensors:
            ago_s = time.time() - self._readers[id(reading)].captured_at
            if not -SKEW_S <= ago_s <= reading.silent_s:
                when = f"{abs(ago_s):.3g} s {'ahead' if ago_s < 0 else 'ago'}"
                raise ConfigError(
                    f"{reading.topic}: expected messages with the present time as their stamp, "
                    f"got one of {when}; synchronize the clocks of both machines, or count from "
                    "the arrival: `clock: arrival`"
                )

        for command in self.settings.actions:
            pose = self.settings.state.get(command.stop)
            if pose is not None and self._value(pose).shape != (command.dim,):
                raise ConfigError(
                    f"{command.topic}: stop: expected {command.dim} numbers, as the topic needs, "
                    f"got {command.stop!r} with {len(self._value(pose))}; name a part of the "
                    f"state with these numbers, in this order"
                )
