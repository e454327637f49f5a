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
    """A node of ROS 2, which a thread spins; raises `MissingDependency` without rclpy, or if ROS was not sourced."""

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

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None]) -> None:
        """Have messages of a topic given to `take`, on the link's thread; before `open`.

        The newest message is wanted and a lost one is not sent again; such a subscription also matches a reliable
        publisher.
        """
        qos = require("rclpy.qos")
        newest = qos.QoSProfile(depth=1, reliability=qos.ReliabilityPolicy.BEST_EFFORT)
        self._node.create_subscription(message_class(kind), topic, take, newest)

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
    """Return the class of a message type, "sensor_msgs/msg/Image"; raises `ConfigError` if it is not installed."""
    package, _, name = kind.split("/")
    try:
        found: type[Any] = getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"{kind}: ROS has no such message here ({error}); install the package {package} of this ROS"
        ) from error
    return found


def filled(instance: Any, message: Mapping[str, Any]) -> Any:
    """Fill in fields of a message, of which the others keep their values, and return it.

    Lists of mappings are lists of the messages that the type of the field names.
    """
    for name, value in message.items():
        if isinstance(value, Mapping):
            filled(getattr(instance, name), value)
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            # "sequence<trajectory_msgs/JointTrajectoryPoint>"
            kind = instance.get_fields_and_field_types()[name].partition("<")[2].removesuffix(">")
            package, part = kind.partition(",")[0].split("/")
            made = message_class(f"{package}/msg/{part}")
            setattr(instance, name, [filled(made(), one) for one in value])
        else:
            setattr(instance, name, value)
    return instance
