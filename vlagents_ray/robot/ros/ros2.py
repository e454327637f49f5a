"""ROS topics through rclpy, where ROS 2 is installed."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import require


class Ros2:
    """A node of ROS 2. A thread spins it.

    Args:
        node: Its name.

    Raises:
        MissingDependency: rclpy is not installed, or its setup file has not been sourced.
    """

    name = "ros2"
    up = True  # there is no connection to be lost; a peer that is gone is silent
    connections = 1

    def __init__(self, node: str = "vlagents_ray") -> None:
        rclpy: Any = require("rclpy")
        self._context: Any = rclpy.context.Context()
        self._context.init()
        self._node: Any = rclpy.create_node(node, context=self._context)
        self._publishers: dict[str, tuple[Any, type[Any]]] = {}
        self._executor: Any = None
        self._thread: threading.Thread | None = None

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None], *, sensor: bool) -> None:
        """Have messages of a topic given to `take`, on the link's thread; before `open`.

        Args:
            topic: The topic.
            kind: Its type, "sensor_msgs/msg/Image".
            take: Gets each message.
            sensor: Whether it is a sensor's, of which the newest message is wanted and a lost one is not sent again;
                such a subscription also matches a reliable publisher.
        """
        qos = require("rclpy.qos")
        reliability = qos.ReliabilityPolicy.BEST_EFFORT if sensor else qos.ReliabilityPolicy.RELIABLE
        self._node.create_subscription(
            message_class(kind), topic, take, qos.QoSProfile(depth=1, reliability=reliability)
        )

    def advertise(self, topic: str, kind: str) -> None:
        """Say that messages of this type will be published; before `open`."""
        made = message_class(kind)
        self._publishers[topic] = self._node.create_publisher(made, topic, 1), made

    def open(self) -> None:
        """Let messages come."""
        self._executor = require("rclpy.executors").SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._spin, name="vlagents-ray-ros2", daemon=True)
        self._thread.start()

    def publish(self, topic: str, message: Mapping[str, Any]) -> bool:
        """Publish a message; returns True."""
        publisher, made = self._publishers[topic]
        publisher.publish(filled(made(), message))
        return True

    def close(self) -> None:
        """End the node, and its thread."""
        self._context.try_shutdown()
        if self._thread is not None:
            self._thread.join()
        self._node.destroy_node()

    def _spin(self) -> None:
        with contextlib.suppress(require("rclpy.executors").ExternalShutdownException):
            self._executor.spin()


def message_class(kind: str) -> type[Any]:
    """Return the class of a message type, "sensor_msgs/msg/Image".

    Raises:
        ConfigError: Its package is not installed, or has no such message.
    """
    package, _, name = kind.split("/")
    try:
        found: type[Any] = getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{kind}: ROS has no such message here ({error}); install the package {package} of this ROS"
        ) from error
    return found


def filled(instance: Any, message: Mapping[str, Any]) -> Any:
    """Fill in the fields of a message.

    Args:
        instance: The message; fields that are not stated keep their values.
        message: The fields. Lists of mappings are lists of the messages that the field's type names.

    Returns:
        The instance.
    """
    for name, value in message.items():
        if isinstance(value, Mapping):
            filled(getattr(instance, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            package, part = _element(instance.get_fields_and_field_types()[name])
            made = message_class(f"{package}/msg/{part}")
            setattr(instance, name, [filled(made(), one) for one in value])
        else:
            setattr(instance, name, value)
    return instance


def _element(kind: str) -> tuple[str, str]:
    """Return package and name of the elements of "sequence<trajectory_msgs/JointTrajectoryPoint>"."""
    package, _, part = kind.partition("<")[2].removesuffix(">").partition(",")[0].partition("/")
    return package, part
