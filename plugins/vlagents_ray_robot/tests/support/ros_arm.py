"""An arm with a camera behind topics. A thread runs its driver, which publishes and executes
commands at 30 Hz.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

CAMERA, JOINTS, COMMANDS, BEAT = "/camera/image_raw", "/joint_states", "/arm/commands", "/alive"
NAMES = ["shoulder", "elbow"]
SIDE = 32
HZ = 30.0


def settings(link: str, **more: Any) -> dict[str, Any]:
    """Return the settings of the arm's topics, with limits for a busy machine."""
    return {
        "link": link,
        "cameras": {"front": {"topic": CAMERA}},
        "state": {"joints": {"topic": JOINTS, "names": NAMES}},
        "actions": [
            {
                "topic": COMMANDS,
                "type": "std_msgs/msg/Float64MultiArray",
                "numbers": 2,
                "stop": "joints",
            },
        ],
        "heartbeat": {"topic": BEAT, "hz": 50.0},
        "max_age_s": 1.0,
        "silent_s": 60.0,
        **more,
    }


class RosArm(threading.Thread):
    """The arm; its joints reach a commanded position immediately.

    Args:
        publish: Publishes a message on a topic.
        commands: Returns the commands that have arrived so far.
    """

    def __init__(
        self,
        publish: Callable[[str, dict[str, Any]], None],
        commands: Callable[[], list[dict[str, Any]]],
    ) -> None:
        super().__init__(name="arm")
        self.joints = [0.0, 0.0]
        self.poses: list[list[float]] = []  # all poses in which the arm has been
        self.broken: set[str] = set()  # topics on which the arm does not publish
        self.images = 0
        self.varies = True  # whether each picture differs, as with the noise of a sensor
        self._publish, self._commands = publish, commands
        self._over = threading.Event()

    def __enter__(self) -> RosArm:
        self.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._over.set()
        self.join()

    def run(self) -> None:
        while not self._over.wait(1 / HZ):
            if came := self._commands():
                self.joints = list(came[-1]["data"])
            self.poses.append(self.joints)
            for topic, message in ((JOINTS, self._state()), (CAMERA, self._image())):
                if topic not in self.broken:
                    self._publish(topic, message)

    def _state(self) -> dict[str, Any]:
        # The joints are in another order than the policy's, with an additional joint.
        numbers = np.array([0.5, self.joints[1], self.joints[0]])
        return {"header": header(), "name": ["gripper", "elbow", "shoulder"], "position": numbers}

    def _image(self) -> dict[str, Any]:
        self.images += self.varies
        pixels = np.full((SIDE, SIDE, 3), self.images % 256, np.uint8)
        said = {
            "height": SIDE,
            "width": SIDE,
            "encoding": "bgr8",
            "is_bigendian": 0,
            "step": 3 * SIDE,
        }
        return {"header": header(), **said, "data": pixels.tobytes()}


class Wire:
    """A link whose messages a test delivers."""

    name, up, connections = "rosbridge", True, 1

    def __init__(self) -> None:
        self.takes: dict[str, Callable[[Any], None]] = {}
        self.published: list[tuple[str, dict[str, Any]]] = []

    def subscribe(self, topic: str, kind: str, take: Callable[[Any], None]) -> None:
        self.takes[topic] = take

    def advertise(self, topic: str, kind: str) -> None: ...

    def open(self) -> None:
        self.deliver(0.0, 0.0)

    def publish(self, topic: str, message: dict[str, Any]) -> bool:
        self.published.append((topic, message))
        return True

    def close(self) -> None: ...

    def deliver(self, *joints: float) -> None:
        arm = RosArm(lambda topic, message: self.takes[topic](message), list)
        arm.joints = list(joints)
        self.takes[JOINTS](arm._state())
        self.takes[CAMERA](arm._image())

    @property
    def commands(self) -> list[list[float]]:
        return [message["data"] for topic, message in self.published if topic == COMMANDS]


def header() -> dict[str, Any]:
    now = time.time_ns()
    return {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": "arm"}
