"""Links to topics of ROS 2: rclpy, if ROS 2 is installed, or a rosbridge.

A rosbridge uses version 2 of its protocol over a WebSocket, as specified in ROSBRIDGE_PROTOCOL.md
of https://github.com/RobotWebTools/rosbridge_suite.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import connect

from vlagents_ray.client.limited_websocket import LimitedWebSocket, SharedConnection
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    MalformedMessage,
    MissingDependency,
    VLAgentsError,
    shown,
)
from vlagents_ray.registry import require

logger = logging.getLogger(__name__)
_SILENT_S = 2.0  # time without a message after which the connection or a topic is checked, s
_GET_ROS = (
    "source the setup file of ROS 2 (`. /opt/ros/jazzy/setup.bash`) and start its Python, or reach "
    "ROS through a rosbridge, `link: ws://arm-pc:9090`"
)
# Time limit of a message, s: without it, a dead link would block the control loop for minutes.
_SEND_S = 0.2
_OPEN_S = 5.0  # time limit of the opening handshake
_CLOSE_S = 1.0  # maximum time of a closing handshake
_LARGEST = 64 << 20  # largest frame, bytes; a 4K image in base64 has 34 million


class Ros2:
    """A node of ROS 2, which a thread spins.

    Args:
        node: The name of the node.

    Raises:
        MissingDependency: rclpy is not installed, or the setup file of ROS was not sourced.
    """

    name = "ros2"
    up = True  # there is no connection; a lost peer is silent
    connections = 1

    def __init__(self, node: str = "vlagents_ray") -> None:
        try:
            rclpy: Any = require("rclpy")
        except MissingDependency as error:
            raise MissingDependency(f"'rclpy' is not installed; {_GET_ROS}") from error

        self._context: Any = rclpy.context.Context()
        self._context.init()
        self._node: Any = rclpy.create_node(node, context=self._context)
        self._publishers: dict[str, tuple[Any, type[Any]]] = {}
        self._executor: Any = None
        self._thread: threading.Thread | None = None

    def subscribe(self, topic: str, message_type: str, take: Callable[[Any], None]) -> None:
        """Pass the messages of a topic to a function, on the link's thread; called before `open`.

        Only the newest message is kept, and a lost message is not sent again; this quality of
        service also matches reliable publishers.

        Args:
            topic: The topic.
            message_type: The type of its messages, such as "sensor_msgs/msg/Image".
            take: The function for the messages.
        """
        qos = require("rclpy.qos")
        newest = qos.QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(message_class(message_type), topic, take, newest)

    def advertise(self, topic: str, message_type: str) -> None:
        """Announce that messages of a type will be published on a topic; called before `open`."""
        cls = message_class(message_type)
        publisher = self._node.create_publisher(cls, topic, 1)
        self._publishers[topic] = publisher, cls

    def open(self) -> None:
        """Begin to receive messages."""
        self._executor = require("rclpy.executors").SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="vlagents-ray-ros2", daemon=True)
        self._thread.start()

    def publish(self, topic: str, message: Mapping[str, Any]) -> bool:
        """Publish a message with these fields; return True, as there is no connection to lose."""
        publisher, cls = self._publishers[topic]
        publisher.publish(filled(cls(), message))
        return True

    def close(self) -> None:
        """End the thread and the node."""
        self._context.try_shutdown()
        if self._thread is not None:
            self._thread.join()
        self._node.destroy_node()

    def _spin(self) -> None:
        """Receive messages until the node ends; runs on its own thread."""
        with contextlib.suppress(require("rclpy.executors").ExternalShutdownException):
            self._executor.spin()


def message_class(message_type: str) -> type[Any]:
    """Return the class of a type of messages.

    Args:
        message_type: The type, such as "sensor_msgs/msg/Image".

    Raises:
        ConfigError: ROS has no such type on this machine.
    """
    package, _, name = message_type.split("/")
    try:
        cls: type[Any] = getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{message_type}: ROS has no such message here ({error}); install the package "
            f"{package} of this ROS"
        ) from error
    return cls


def filled(instance: Any, message: Mapping[str, Any]) -> Any:
    """Set fields of a message, and return it; other fields keep their values.

    Args:
        instance: The message, an object of rclpy.
        message: The values of its fields. A list of mappings becomes a list of messages of the
            field's type.
    """
    for name, value in message.items():
        if isinstance(value, Mapping):
            filled(getattr(instance, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            # The type is written as "sequence<trajectory_msgs/JointTrajectoryPoint>".
            field_type = instance.get_fields_and_field_types()[name]
            item_type = field_type.partition("<")[2].removesuffix(">").partition(",")[0]
            package, type_name = item_type.split("/")
            item_class = message_class(f"{package}/msg/{type_name}")
            setattr(instance, name, [filled(item_class(), item) for item in value])
        else:
            setattr(instance, name, value)
    return instance


class Rosbridge:
    """A link through a rosbridge, which needs no ROS on this machine.

    A thread receives messages, and connects again if the connection is lost.

    Args:
        url: The URL of the server, such as "ws://arm-pc:9090".
    """

    name = "rosbridge"

    def __init__(self, url: str) -> None:
        self._url = url
        # For each subscribed topic: the function for its messages, its type, and the time of its
        # last message or subscription, s of `time.monotonic`.
        self._take: dict[str, Callable[[Any], None]] = {}
        self._types: dict[str, str] = {}
        self._heard_at: dict[str, float] = {}
        self._published_types: dict[str, str] = {}  # the types of the published messages by topic

        self._socket: LimitedWebSocket | None = None
        self._open = contextlib.ExitStack()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self.connections = 0  # the number of connections since `open`

    def subscribe(self, topic: str, message_type: str, take: Callable[[Any], None]) -> None:
        """Pass the messages of a topic to a function, on the link's thread; called before `open`.

        While no messages arrive, the topic is subscribed to again: the server chooses the quality
        of service according to the publishers at the time of the subscription, and would not
        receive from a later publisher with best effort.

        Args:
            topic: The topic.
            message_type: The type of its messages, such as "sensor_msgs/msg/Image".
            take: The function for the messages.
        """
        self._take[topic] = take
        self._types[topic] = message_type
        self._heard_at[topic] = 0.0

    def advertise(self, topic: str, message_type: str) -> None:
        """Announce that messages of a type will be published on a topic; called before `open`."""
        self._published_types[topic] = message_type

    def open(self) -> None:
        """Connect, and begin to receive messages.

        Raises:
            ConnectionLost: The server cannot be reached.
        """
        self._connect()
        self._thread = threading.Thread(
            target=self._run, name="vlagents-ray-rosbridge", daemon=True
        )
        self._thread.start()

    @property
    def up(self) -> bool:
        """Whether the connection is up, as far as this machine knows."""
        return self._socket is not None

    def publish(self, topic: str, message: dict[str, Any]) -> bool:
        """Publish a message; return False, without sending it, if the connection is lost."""
        socket = self._socket
        if socket is None:
            return False
        request = {"op": "publish", "topic": topic, "msg": message}
        try:
            socket.send(json.dumps(request, allow_nan=False), _SEND_S)
        except (WebSocketException, OSError):
            self._lose(socket)
            return False
        return True

    def close(self) -> None:
        """End the thread and the connection."""
        self._closing.set()
        socket, self._socket = self._socket, None
        if socket is not None:
            # The closing handshake lets the last messages arrive.
            socket.close(2 * _CLOSE_S)
        if self._thread is not None:
            self._thread.join()
        self._open.close()

    def _connect(self) -> None:
        """Connect to the server, and announce and subscribe to the topics."""
        self._open.close()  # the previous connection
        try:
            opening = connect(
                self._url,
                compression=None,
                max_size=_LARGEST,
                open_timeout=_OPEN_S,
                close_timeout=_CLOSE_S,
                create_connection=SharedConnection,
            )
            socket = LimitedWebSocket(self._open.enter_context(opening))
            self._open.callback(socket.shut_down)
            for topic, message_type in self._published_types.items():
                announcement = {"op": "advertise", "topic": topic, "type": message_type}
                socket.send(json.dumps(announcement), _SEND_S)
            for topic in self._types:
                self._send_subscription(topic, socket)
        except (WebSocketException, OSError, TimeoutError) as error:
            raise ConnectionLost(
                f"{self._url}: cannot connect ({error}); does a rosbridge_server run there? "
                f"`ros2 launch rosbridge_server rosbridge_websocket_launch.xml` starts one"
            ) from error
        self._socket = socket
        self.connections += 1

    def _run(self) -> None:
        """Receive messages, and connect again if the connection is lost; runs on its own thread."""
        while not self._closing.is_set():
            socket = self._socket
            if socket is None:
                self._reconnect()
                continue

            try:
                try:
                    self._receive(socket.connection.recv(_SILENT_S))
                except TimeoutError:
                    # Without an answer, the server counts as lost, for instance after a power
                    # failure.
                    if not socket.connection.ping().wait(_SILENT_S):
                        self._lose(socket)
                        continue

                for topic, heard_at in self._heard_at.items():
                    if time.monotonic() - heard_at > _SILENT_S:
                        socket.send(json.dumps({"op": "unsubscribe", "topic": topic}), _SEND_S)
                        self._send_subscription(topic, socket)
            except (ConnectionClosed, OSError):
                self._lose(socket)

    def _send_subscription(self, topic: str, socket: LimitedWebSocket) -> None:
        """Subscribe to a topic. On a slow link, the newest message replaces unsent ones."""
        request = {"op": "subscribe", "topic": topic, "type": self._types[topic], "queue_length": 1}
        socket.send(json.dumps(request), _SEND_S)
        self._heard_at[topic] = time.monotonic()

    def _reconnect(self) -> None:
        """Try to connect again once; wait for half a second if the attempt fails."""
        try:
            self._connect()
        except ConnectionLost:
            self._closing.wait(0.5)
            return

        # `close` may have run before the new connection was made.
        socket = self._socket
        if self._closing.is_set() and socket is not None:
            self._lose(socket)
            return
        logger.warning("%s: connected again", self._url)

    def _lose(self, socket: LimitedWebSocket) -> None:
        """Drop a connection without the closing handshake, which would wait for a dead peer."""
        if self._socket is socket:
            self._socket = None
            if not self._closing.is_set():
                logger.warning("%s: the connection is lost", self._url)
        socket.shut_down()

    def _receive(self, frame: str | bytes) -> None:
        """Handle a message of the server."""
        try:
            message = decoded(frame)
        except VLAgentsError as error:
            logger.warning("%s: sent an unreadable message, which is ignored: %s", self._url, error)
            return

        if message.get("op") == "publish":
            topic = str(message.get("topic"))
            take = self._take.get(topic)
            if take is not None:
                self._heard_at[topic] = time.monotonic()
                take(message.get("msg"))
        elif message.get("op") == "status":
            logger.warning("%s: %s: %s", self._url, message.get("level"), message.get("msg"))


Link = Ros2 | Rosbridge


def decoded(frame: str | bytes) -> dict[str, Any]:
    """Decode a message of the protocol.

    Args:
        frame: The message, JSON.

    Returns:
        The message, an object with the key "op".

    Raises:
        MalformedMessage: The message is not such an object.
    """
    try:
        message = json.loads(frame)
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"rosbridge: expected JSON, got {frame[:40]!r} ({error})") from error
    if not isinstance(message, dict) or not isinstance(message.get("op"), str):
        raise MalformedMessage(f"rosbridge: expected an object with `op`, got {shown(message)}")
    return message
