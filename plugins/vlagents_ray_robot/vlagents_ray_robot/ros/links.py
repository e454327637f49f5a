"""Links to topics of ROS 2: rclpy, if ROS 2 is installed, or a rosbridge.

A rosbridge uses version 2 of its protocol over a WebSocket, as specified in ROSBRIDGE_PROTOCOL.md
of https://github.com/RobotWebTools/rosbridge_suite.
"""

from __future__ import annotations

import contextlib
import json
import logging
import struct
import threading
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from socket import SHUT_RDWR, SO_SNDTIMEO, SOL_SOCKET
from typing import Any

from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect

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
_SILENT_S = 2.0
_GET_ROS = (
    "source the setup file of ROS 2 (`. /opt/ros/jazzy/setup.bash`) and start its Python, or reach "
    "ROS through a rosbridge, `link: ws://arm-pc:9090`"
)
# The kernel's time limit for a send, which websockets lacks: a dead link would block the control
# loop for minutes.
_SEND_LIMIT = struct.pack("@ll", 0, 200_000)
_LARGEST = 64 << 20  # bytes of a frame; a 4K image in base64 has 34 million


class Ros2:
    """A node of ROS 2, which a thread spins; raises `MissingDependency` without rclpy, or if ROS
    was not sourced.
    """

    name = "ros2"
    up = True  # it has no connection; a lost peer is silent
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

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None]) -> None:
        """Pass messages of a topic to `take` on the link's thread; call it before `open`.

        Only the newest message is kept, and a lost one is not sent again; this also matches
        reliable publishers.
        """
        qos = require("rclpy.qos")
        newest = qos.QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(message_class(kind), topic, take, newest)

    def advertise(self, topic: str, kind: str) -> None:
        """Announce that messages of this type will be published; call it before `open`."""
        message_type = message_class(kind)
        publisher = self._node.create_publisher(message_type, topic, 1)
        self._publishers[topic] = publisher, message_type

    def open(self) -> None:
        """Begin to receive messages."""
        self._executor = require("rclpy.executors").SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="vlagents-ray-ros2", daemon=True)
        self._thread.start()

    def publish(self, topic: str, message: Mapping[str, Any]) -> bool:
        """Publish a message; returns True."""
        publisher, message_type = self._publishers[topic]
        publisher.publish(filled(message_type(), message))
        return True

    def close(self) -> None:
        """End the thread and the node."""
        self._context.try_shutdown()
        if self._thread is not None:
            self._thread.join()
        self._node.destroy_node()

    def _spin(self) -> None:
        with contextlib.suppress(require("rclpy.executors").ExternalShutdownException):
            self._executor.spin()


def message_class(kind: str) -> type[Any]:
    """Return the class of a message type such as "sensor_msgs/msg/Image"; raises `ConfigError`
    if it is missing.
    """
    package, _, name = kind.split("/")
    try:
        message_type: type[Any] = getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{kind}: ROS has no such message here ({error}); install the package {package} of "
            "this ROS"
        ) from error
    return message_type


def filled(instance: Any, message: Mapping[str, Any]) -> Any:
    """Set fields of a message and return it; other fields keep their values.

    Lists of mappings are lists of the messages that the type of the field names.
    """
    for name, value in message.items():
        if isinstance(value, Mapping):
            filled(getattr(instance, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            # The type reads as "sequence<trajectory_msgs/JointTrajectoryPoint>".
            kind = instance.get_fields_and_field_types()[name].partition("<")[2].removesuffix(">")
            package, type_name = kind.partition(",")[0].split("/")
            item_type = message_class(f"{package}/msg/{type_name}")
            setattr(instance, name, [filled(item_type(), item) for item in value])
        else:
            setattr(instance, name, value)
    return instance


class Rosbridge:
    """A link to ROS that needs no ROS here, by the URL of a server, "ws://arm-pc:9090".

    A thread receives, and connects again if the connection is lost.
    """

    name = "rosbridge"

    def __init__(self, url: str) -> None:
        self._url = url
        self._take: dict[str, Callable[[Any], None]] = {}
        self._types: dict[str, str] = {}
        # By topic: the time of its last message or subscription, s of `time.monotonic`.
        self._heard: dict[str, float] = {}
        self._outlets: dict[str, str] = {}
        self._socket: ClientConnection | None = None
        self._open = contextlib.ExitStack()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self.connections = 0  # since `open`

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None]) -> None:
        """Pass messages of a topic to `take` on the link's thread; call it before `open`.

        While the topic is silent, it is subscribed to again: the server sets the quality of service
        by the present publishers, and would miss a later one with best effort.
        """
        self._take[topic], self._types[topic] = take, kind
        self._heard[topic] = 0.0

    def advertise(self, topic: str, kind: str) -> None:
        """Announce that messages of this type will be published; call it before `open`."""
        self._outlets[topic] = kind

    def open(self) -> None:
        """Connect; raises `ConnectionLost` if the server cannot be reached."""
        self._connect()
        self._thread = threading.Thread(
            target=self._run, name="vlagents-ray-rosbridge", daemon=True
        )
        self._thread.start()

    @property
    def up(self) -> bool:
        """Whether the connection is up, as far as is known here."""
        return self._socket is not None

    def publish(self, topic: str, message: dict[str, Any]) -> bool:
        """Publish a message; return False, without sending it, if the connection is lost."""
        socket = self._socket
        if socket is None:
            return False
        try:
            socket.send(
                json.dumps({"op": "publish", "topic": topic, "msg": message}, allow_nan=False)
            )
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
            socket.close()
        if self._thread is not None:
            self._thread.join()
        self._open.close()

    def _connect(self) -> None:
        self._open.close()  # the previous connection
        try:
            opening = connect(
                self._url, compression=None, max_size=_LARGEST, open_timeout=5, close_timeout=1
            )
            socket = self._open.enter_context(opening)
            socket.socket.setsockopt(SOL_SOCKET, SO_SNDTIMEO, _SEND_LIMIT)
            for topic, kind in self._outlets.items():
                socket.send(json.dumps({"op": "advertise", "topic": topic, "type": kind}))
            for topic in self._types:
                self._ask_for(topic, socket)
        except (WebSocketException, OSError, TimeoutError) as error:
            raise ConnectionLost(
                f"{self._url}: cannot connect ({error}); does a rosbridge_server run there? "
                f"`ros2 launch rosbridge_server rosbridge_websocket_launch.xml` starts one"
            ) from error
        self._socket = socket
        self.connections += 1

    def _run(self) -> None:
        while not self._closing.is_set():
            socket = self._socket
            if socket is None:
                self._reconnect()
                continue
            try:
                try:
                    self._receive(socket.recv(_SILENT_S))
                except TimeoutError:
                    # Without an answer, the server is gone, as after a power failure.
                    if not socket.ping().wait(_SILENT_S):
                        self._lose(socket)
                        continue

                for topic, heard_s in self._heard.items():
                    if time.monotonic() - heard_s > _SILENT_S:
                        socket.send(json.dumps({"op": "unsubscribe", "topic": topic}))
                        self._ask_for(topic, socket)
            except (ConnectionClosed, OSError):
                self._lose(socket)

    def _ask_for(self, topic: str, socket: ClientConnection) -> None:
        # Only the newest message: it replaces unsent ones on a slow link.
        request = {"op": "subscribe", "topic": topic, "type": self._types[topic], "queue_length": 1}
        socket.send(json.dumps(request))
        self._heard[topic] = time.monotonic()

    def _reconnect(self) -> None:
        try:
            self._connect()
        except ConnectionLost:
            self._closing.wait(0.5)
            return

        # `close` may have run before the connection was up.
        socket = self._socket
        if self._closing.is_set() and socket is not None:
            self._lose(socket)
            return
        logger.warning("%s: connected again", self._url)

    def _lose(self, socket: ClientConnection) -> None:
        """Drop a connection without the closing handshake, which would wait for a dead peer."""
        if self._socket is socket:
            self._socket = None
            if not self._closing.is_set():
                logger.warning("%s: the connection is lost", self._url)
        with contextlib.suppress(OSError):
            socket.socket.shutdown(SHUT_RDWR)

    def _receive(self, frame: str | bytes) -> None:
        try:
            message = decoded(frame)
        except VLAgentsError as error:
            logger.warning("%s: sent what is left out: %s", self._url, error)
            return

        if message.get("op") == "publish":
            topic = str(message.get("topic"))
            take = self._take.get(topic)
            if take is not None:
                self._heard[topic] = time.monotonic()
                take(message.get("msg"))
        elif message.get("op") == "status":
            logger.warning("%s: %s: %s", self._url, message.get("level"), message.get("msg"))


Link = Ros2 | Rosbridge


def decoded(frame: str | bytes) -> dict[str, Any]:
    """Decode a message of the protocol, which is JSON; raises `MalformedMessage`."""
    try:
        message = json.loads(frame)
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"rosbridge: got {frame[:40]!r}, want JSON ({error})") from error
    if not isinstance(message, dict) or not isinstance(message.get("op"), str):
        raise MalformedMessage(f"rosbridge: got {shown(message)}, want an object with `op`")
    return message
