"""A robot behind topics of ROS 2, the parts of its observation and its action, and the file that
names the topics.
"""

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
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
JOINT_STATE, BOOL = "sensor_msgs/msg/JointState", "std_msgs/msg/Bool"
POSES = ("geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseStamped")
NUMBERS = tuple(
    f"std_msgs/msg/{name}"
    for name in ("Float64MultiArray", "Float32MultiArray", "Float64", "Float32")
)
ARRAY, TWIST_TYPE, TRAJECTORY = (
    NUMBERS[0],
    "geometry_msgs/msg/Twist",
    "trajectory_msgs/msg/JointTrajectory",
)
ZEROS, NOTHING = "zeros", "nothing"
_AGES = ("max_age_s", "silent_s")


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
    max_age_s: float = 0.3  # without a newer message the robot holds still
    silent_s: float = 1.0  # without a newer message the robot is stopped


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
    # Which of its numbers; None: the joints of the gripper's topic.
    grippers: tuple[int, ...] | None = None

    @property
    def dim(self) -> int:
        """The count of an action's numbers that it takes."""
        if self.type == ARRAY:
            return self.numbers or 0
        return len(self.fields) if self.type == TWIST_TYPE else len(self.names)


@dataclass(frozen=True)
class HeartbeatTopic:
    """A `std_msgs/msg/Bool`, published while the control loop runs: whether it may move the
    robot.
    """

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
    # Whether a message's age counts from its header's time stamp, or from its arrival ("arrival")
    clock: str = "stamp"
    ready_s: float = 10.0  # time limit for the first message of each topic

    @property
    def sensors(self) -> list[InputTopic]:
        """The topics whose readings must be recent."""
        return [
            *self.cameras.values(),
            *self.state.values(),
            *([self.gripper] if self.gripper else []),
        ]

    @property
    def dim(self) -> int:
        """The count of numbers of an action."""
        return sum(command.dim for command in self.actions)

    @property
    def delta(self) -> bool | None:
        """Whether actions are relative: False if the measured pose stops the robot, as their
        numbers are targets then.

        Else it is None: zeros stop velocities as well as deltas, and a topic without a stop states
        nothing.
        """
        stops = {command.stop for command in self.actions} - {NOTHING}
        return False if stops and stops <= self.state.keys() else None

    def gripper_columns(self, command: ActionTopic) -> list[int]:
        """Return which numbers of a topic are grippers; joints are compared by name with those
        of `gripper`.
        """
        if command.grippers is not None:
            return list(command.grippers)
        measured = self.state.get(command.stop)
        names = command.names or (() if measured is None else measured.names)
        fingers = () if self.gripper is None else self.gripper.names
        return [number for number, name in enumerate(names) if name in fingers]


def read_settings(file: Path | str) -> RosSettings:
    """Read a YAML file of topics, as docs/ros.md explains it.

    Raises:
        ConfigError: The file cannot be read, or a setting is unknown, missing or wrong.
        MissingDependency: PyYAML is not installed.
    """
    try:
        stated = load_yaml(
            Path(file).read_text(encoding="utf-8"), extra="ros", distribution=DISTRIBUTION
        )
    except (OSError, ValueError) as error:
        raise ConfigError(f"{file}: cannot be read as a file of ROS topics ({error})") from error
    return settings_from(stated, str(file))


def settings_from(stated: Any, where: str) -> RosSettings:
    """Check the decoded document of a file with the name `where`, and return it; raises
    `ConfigError`.
    """
    top = dict(_mapping(stated, where))
    usual = {key: top.pop(key) for key in _AGES if key in top}  # of all readings
    for part, kind in (("cameras", IMAGE), ("state", JOINT_STATE)):
        named = _mapping(top.get(part) or {}, f"{where}: {part}")
        top[part] = {
            str(name): _reading(one, f"{where}: {part}.{name}", kind, usual)
            for name, one in named.items()
        }
    if top.get("gripper") is not None:
        top["gripper"] = _reading(top["gripper"], f"{where}: gripper", JOINT_STATE, usual)
    if top.get("heartbeat") is not None:
        top["heartbeat"] = _made(HeartbeatTopic, top["heartbeat"], f"{where}: heartbeat")
    actions = top.get("actions") or []
    if not isinstance(actions, list):
        raise ConfigError(f"{where}: actions: got {type(actions).__name__}, want a list of topics")
    top["actions"] = tuple(
        _made(ActionTopic, one, f"{where}: actions[{i}]") for i, one in enumerate(actions)
    )
    settings: RosSettings = _made(RosSettings, top, where)
    _check(settings, where)
    return settings


def _check(settings: RosSettings, where: str) -> None:
    readings = [
        *((f"cameras.{name}", one, (IMAGE, COMPRESSED)) for name, one in settings.cameras.items()),
        *(
            (f"state.{name}", one, (JOINT_STATE, *POSES, *NUMBERS))
            for name, one in settings.state.items()
        ),
        *(
            [("gripper", gripper, (JOINT_STATE, *NUMBERS))]
            if (gripper := settings.gripper) is not None
            else []
        ),
    ]
    for name, reading, types in readings:
        _one_of(f"{where}: {name}: type", reading.type, types)
        _one_of(f"{where}: {name}: values", reading.values, get_args(Values))
        _one_of(f"{where}: {name}: rotation", reading.rotation, get_args(PoseRotation))
    types_of: dict[str, str] = {}
    for name, reading, _ in readings:
        if types_of.setdefault(reading.topic, reading.type) != reading.type:
            raise ConfigError(
                f"{where}: {name}: got {reading.topic} as {reading.type}, and elsewhere as "
                f"{types_of[reading.topic]}"
            )

    if not settings.sensors:
        raise ConfigError(
            f"{where}: got no camera, state or gripper, want one, by whose age the robot is stopped"
        )
    if not settings.actions:
        raise ConfigError(f"{where}: actions: got none, want the topics that command the robot")
    if gripper is not None and (
        gripper.open is None or gripper.closed is None or gripper.open == gripper.closed
    ):
        raise ConfigError(
            f"{where}: gripper: got no two numbers, want `open` and `closed` as the topic gives "
            "them"
        )
    for i, command in enumerate(settings.actions):
        _check_command(command, settings, f"{where}: actions[{i}]")

    limits = [
        ("ready_s", settings.ready_s),
        *([("heartbeat: hz", beat.hz)] if (beat := settings.heartbeat) else []),
    ]
    limits += [(f"{name}: {key}", getattr(one, key)) for name, one, _ in readings for key in _AGES]
    for name, limit in limits:
        if not limit > 0:
            raise ConfigError(f"{where}: {name}: got {limit}, want above 0")
    _one_of(f"{where}: clock", settings.clock, ("stamp", "arrival"))
    if settings.link != ROS2 and not settings.link.startswith(("ws://", "wss://")):
        raise ConfigError(
            f"{where}: link: got {settings.link!r}, want 'ros2', or a rosbridge as "
            "'ws://arm-pc:9090'"
        )


def _check_command(command: ActionTopic, settings: RosSettings, where: str) -> None:
    _one_of(f"{where}: type", command.type, (ARRAY, JOINT_STATE, TWIST_TYPE, TRAJECTORY))
    _one_of(f"{where}: values", command.values, get_args(Values))
    for name in command.fields:
        _one_of(f"{where}: fields", name, TWIST)
    if command.dim < 1:
        wants = (
            "numbers, how many it takes" if command.type == ARRAY else "names, those of the joints"
        )
        raise ConfigError(f"{where}: got a {command.type} without numbers, want {wants}")
    if command.type == TRAJECTORY and not command.reach_s > 0:
        raise ConfigError(f"{where}: reach_s: got {command.reach_s}, want above 0")
    if not command.stop and command.type != TWIST_TYPE:
        raise ConfigError(
            f"{where}: stop: got none, want what stops {command.topic}: {ZEROS!r} where numbers "
            "are velocities or deltas, a part of the state with the measured pose where they are "
            f"targets, or {NOTHING!r} where the controller stays at its last target and that is "
            "right"
        )
    if command.stop and command.stop not in (ZEROS, NOTHING):
        _one_of(f"{where}: stop", command.stop, (ZEROS, NOTHING, *settings.state))
    for number in command.grippers or ():
        _one_of(f"{where}: grippers", number, tuple(range(command.dim)))
    if command.grippers and command.stop == ZEROS and settings.gripper is None:
        raise ConfigError(
            f"{where}: grippers: got {list(command.grippers)} in a topic that zeros stop, and no "
            "`gripper`; add the topic of its opening, as a stop publishes that in place of a zero"
        )


def _reading(stated: Any, where: str, kind: str, usual: Mapping[str, Any]) -> InputTopic:
    reading: InputTopic = _made(
        InputTopic, {"type": kind, **usual, **_mapping(stated, where)}, where
    )
    return reading


def _made(kind: type[Any], stated: Any, where: str) -> Any:
    arguments = dict(_mapping(stated, where))
    for name in arguments.keys() & {"names", "fields"}:
        value = arguments[name]
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            raise ConfigError(f"{where}: {name}: got {value!r}, want a list of names")
        arguments[name] = tuple(value)

    grippers = arguments.get("grippers")
    if grippers is not None:
        if not isinstance(grippers, list) or not all(type(number) is int for number in grippers):
            raise ConfigError(
                f"{where}: grippers: got {grippers!r}, want a list of numbers from 0, such as [2]"
            )
        arguments["grippers"] = tuple(grippers)

    require_arguments(where, kind, arguments)
    return kind(**arguments)


def _mapping(stated: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(stated, Mapping):
        raise ConfigError(
            f"{where}: got {type(stated).__name__}, want keys with values; see docs/ros.md"
        )
    return stated


def _one_of(what: str, got: object, want: tuple[object, ...]) -> None:
    if got not in want:
        raise ConfigError(f"{what}: got {got!r}, want one of {list(want)}")


class TopicReader:
    """The newest readable message of a topic, as one part of the observation."""

    def __init__(self, reading: InputTopic, by_stamp: bool) -> None:
        self.topic = reading.topic
        self.value: Any = None  # None before the first message
        self.captured_at = 0.0  # s since 1970
        self.unreadable = 0  # messages
        self._reading = reading
        self._by_stamp = by_stamp
        self._clock = CaptureClock()
        self._seen_at = -math.inf  # s of `time.monotonic`
        # A stop by the watchdog reads the pose beside the control loop.
        self._lock = threading.Lock()
        self._came: tuple[Any, float] | None = None
        self._looked_at: tuple[Any, float] | None = None

    def take(self, message: Any) -> None:
        """Keep a message, on the link's thread; the control loop decodes only the newest one."""
        self._came = message, time.time()

    def refresh(self) -> None:
        """Decode the newest message, if any. An unreadable one is ignored, so that the reading
        ages.
        """
        with self._lock:
            came = self._came
            if came is None or came is self._looked_at:
                return
            self._looked_at = message, arrived_at = came
            try:
                value = self._read(message)
                at = (messages.stamp(message) if self._by_stamp else None) or arrived_at
            except VLAgentsError as error:
                self.unreadable += 1
                if self.value is None:
                    raise ConfigError(f"{self.topic}: {error}") from error
                if self.unreadable == 1:
                    logger.warning(
                        "%s: a message is left out, as are others like it: %s", self.topic, error
                    )
                return
            self.value, self.captured_at = value, at
            self._seen_at = self._clock(Obs(info={CAPTURED: at}))

    def _read(self, message: Any) -> Any:
        """Return the image, the part of the state or, by its first number, the gripper's opening
        in a message.
        """
        reading = self._reading
        if reading.type == IMAGE:
            return messages.image(message)
        if reading.type == COMPRESSED:
            return messages.compressed_image(message)
        if reading.type == JOINT_STATE:
            part = messages.joints(message, reading.names, reading.values)
        else:
            part = (
                messages.pose(message, reading.rotation)
                if reading.type in POSES
                else messages.numbers(message)
            )
        if reading.open is None or reading.closed is None:
            return part
        return min(
            1.0, max(0.0, (float(part[0]) - reading.closed) / (reading.open - reading.closed))
        )

    @property
    def age_s(self) -> float:
        """The age of the reading, s; infinite if its time is in the future."""
        return time.monotonic() - self._seen_at


class RosRobot:
    """A `Robot` whose cameras, state and actions are topics.

    An observation has the newest message of each topic, and the time of the oldest of them as
    `captured_at`. While a message is older than its `max_age_s`, or the link is lost, `holds` is
    the reason: the control loop stops the robot, and continues by itself later. After `silent_s`
    without a new message the watchdog stops it. Use it as a context manager, which connects and
    waits for the first message of each topic.

    Args:
        settings: The topics, or the path of their YAML file.
        link: The link to them; by default that of the settings.
    """

    dates_pictures = True
    """Whether `captured_at` is from the messages, so that a camera that hangs is found by the
    age of its picture.
    """

    def __init__(self, settings: RosSettings | Path | str, link: Link | None = None) -> None:
        if not isinstance(settings, RosSettings):
            settings = read_settings(settings)
        self.settings = settings
        self.holds: str | None = None
        self.watchdog: Watchdog | None = None
        """The watchdog of the control loop, with `silent_s` among its sources."""
        self._link: Link = link or (Ros2() if settings.link == ROS2 else Rosbridge(settings.link))
        self._readers = {
            id(one): TopicReader(one, settings.clock == "stamp") for one in settings.sensors
        }
        self._beat_at = -math.inf
        self._connections = 0
        self._lost_at = -math.inf  # s of `time.monotonic`
        self._stop_unsent = False
        # The last numbers of each topic of the actions, by its place.
        self._commanded: dict[int, np.ndarray] = {}
        for topic, kind in {reading.topic: reading.type for reading in settings.sensors}.items():
            self._link.subscribe(topic, kind, partial(self._take, topic))
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
        """The sources for a `Watchdog`: each topic, and its longest time without a new message,
        s.
        """
        limits: dict[str, float] = {}
        for reading in self.settings.sensors:
            limits[reading.topic] = min(reading.silent_s, limits.get(reading.topic, math.inf))
        return limits

    @property
    def joint_names(self) -> list[str]:
        """The joints in the order of an action, as far as the settings of its topics name them."""
        return [name for topic in self.settings.actions for name in topic.names]

    @property
    def contract(self) -> Contract:
        """The contract of the topics, from the messages received so far."""
        cameras = {name: self._value(one) for name, one in self.settings.cameras.items()}
        state = {name: self._value(one) for name, one in self.settings.state.items()}
        return Contract(
            cameras={name: CameraSpec(*image.shape[:2]) for name, image in cameras.items()},
            state={name: StateSpec(len(part)) for name, part in state.items()},
            gripper=self.settings.gripper is not None,
            action=ActionSpec(dim=self.settings.dim, delta=self.settings.delta),
        )

    def observe(self) -> Obs:
        """Return the newest message of each topic; also publishes the heartbeat."""
        for reader in self._readers.values():
            reader.refresh()
        self._hold_if_old()
        self._beat(alive=True)
        gripper = self.settings.gripper
        return Obs(
            {name: self._value(one) for name, one in self.settings.cameras.items()},
            None if gripper is None else self._value(gripper),
            {name: self._value(one) for name, one in self.settings.state.items()},
            {CAPTURED: min(reader.captured_at for reader in self._readers.values())},
        )

    def apply(self, action: np.ndarray) -> None:
        """Publish an action.

        Raises:
            InvalidAction: The number of values differs from that of the topics.
        """
        if action.shape != (self.settings.dim,):
            raise InvalidAction(
                f"action: got {action.shape}, want ({self.settings.dim},), as the topics take"
            )
        first = 0
        for index, command in enumerate(self.settings.actions):
            row = self._commanded[index] = action[first : first + command.dim].copy()
            self._publish(command, row)
            first += command.dim

    def stop(self) -> None:
        """Publish the stop of each topic: zeros, or the measured pose if that is recent.

        Grippers keep their last command, as the measured opening would loosen their grasp.
        """
        self._stop_unsent = not self._link.up  # if so, it is sent on reconnection
        for index, command in enumerate(self.settings.actions):
            if command.stop == NOTHING:
                continue

            grippers = self.settings.gripper_columns(command)
            if command.stop in ("", ZEROS):
                row = np.zeros(command.dim, np.float32)
                row[grippers] = self._measured_opening()
            else:
                reading = self.settings.state[command.stop]
                reader = self._readers[id(reading)]
                reader.refresh()
                if reader.age_s > reading.max_age_s or self._from_before_loss(reader):
                    self._stop_unsent = True  # until a pose is known
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
        """Return the opening of the gripper in the numbers of its topic; 0 without such a topic."""
        reading = self.settings.gripper
        if reading is None or reading.open is None or reading.closed is None:
            return 0.0
        return float(reading.closed + self._value(reading) * (reading.open - reading.closed))

    def _from_before_loss(self, reader: TopicReader) -> bool:
        return time.monotonic() - self._lost_at <= reader.age_s < math.inf

    def _publish(self, command: ActionTopic, row: np.ndarray) -> None:
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
        up, connections = self._link.up, self._link.connections
        if not up or connections != self._connections:  # or the link was lost between two ticks
            self._connections, self._lost_at = connections, time.monotonic()
            # The last stop may have been sent before the loss was detected.
            self._stop_unsent = True
        lost = any(self._from_before_loss(reader) for reader in self._readers.values())
        self.holds = f"the connection to the {self._link.name} was lost" if lost else None
        for reading in self.settings.sensors:
            reader = self._readers[id(reading)]
            if reader.age_s > reading.max_age_s:
                self.holds = (
                    self.holds
                    or f"no new message of {reading.topic} for more than {reading.max_age_s:g} s"
                )
            if self.watchdog is not None and reader.age_s < math.inf:
                self.watchdog.heard(reading.topic, max(0.0, reader.age_s))
        if self._stop_unsent and self.holds is None:
            self.stop()

    def _beat(self, *, alive: bool) -> None:
        beat, now = self.settings.heartbeat, time.monotonic()
        if beat is None or (alive and now - self._beat_at < 1 / beat.hz):
            return
        self._beat_at = now
        stopped = self.watchdog is not None and self.watchdog.control.stopped
        self._link.publish(beat.topic, {"data": alive and not stopped and self.holds is None})

    def _value(self, reading: InputTopic) -> Any:
        return self._readers[id(reading)].value

    def _take(self, topic: str, message: Any) -> None:
        for reader in self._readers.values():
            if reader.topic == topic:
                reader.take(message)

    def _wait_for_messages(self) -> None:
        deadline = time.monotonic() + self.settings.ready_s
        while True:
            for reader in self._readers.values():
                reader.refresh()
            missing = sorted({one.topic for one in self._readers.values() if one.value is None})
            if not missing:
                break
            if time.monotonic() > deadline:
                raise ConfigError(
                    f"{self.settings.link}: got no message of {missing} within "
                    f"{self.settings.ready_s:g} s, want one of each; compare names and types with "
                    "`ros2 topic list --show-types`"
                )
            time.sleep(0.01)

        for reading in self.settings.sensors:
            ago_s = time.time() - self._readers[id(reading)].captured_at
            if not -SKEW_S <= ago_s <= reading.silent_s:
                when = f"{abs(ago_s):.3g} s {'ahead' if ago_s < 0 else 'ago'}"
                raise ConfigError(
                    f"{reading.topic}: got a message with the time stamp of {when}, want one of "
                    "now; synchronize the clocks of both machines, or count from the arrival: "
                    "`clock: arrival`"
                )

        for command in self.settings.actions:
            pose = self.settings.state.get(command.stop)
            if pose is not None and self._value(pose).shape != (command.dim,):
                raise ConfigError(
                    f"{command.topic}: stop: got {command.stop!r} with {len(self._value(pose))} "
                    f"numbers, want {command.dim}, as the topic takes; name a part of the state "
                    "with these, in this order"
                )
