"""Measures the time that topics of ROS 2 add: from an image on a topic to the action computed from
it on another topic.

A driver publishes images with a number in their first pixel, and times the actions, which repeat
it. The policy is in this process and computes nothing, and no tick is awaited, so the time is that
of both transports, decoding, and the chunk player with its guard. `--link ros2` and a real
rosbridge (`--link ws://…`) need rclpy.
"""

from __future__ import annotations

import argparse
import contextlib
import sys
import threading
import time
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.robot import Guard
from vlagents_ray_robot.ros import RosRobot
from vlagents_ray_robot.ros.links import Ros2
from vlagents_ray_robot.ros.robot import settings_from

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins/vlagents_ray_robot/tests/support"))

IMAGE, COMMANDS = "/camera/image_raw", "/arm/commands"
Publish = Callable[[str, dict[str, Any]], object]


class Repeating(Agent):
    """Returns the number in the first pixels of an image as the action."""

    contract = Contract(action=ActionSpec(dim=1, delta=False))

    def act(self, obs: Obs) -> Act:
        return Act(np.array([np.round(obs.cameras["front"][:8, :8, 0].mean())], np.float32))


class Stopwatch:
    """The times at which numbers were published and returned."""

    def __init__(self) -> None:
        self.sent: dict[int, float] = {}
        self.took_ms: list[float] = []
        self.came = threading.Event()

    def arrived(self, message: Any) -> None:
        """Record an action."""
        now = time.perf_counter()
        number = round((message["data"] if isinstance(message, dict) else message.data)[0])
        if number in self.sent:
            self.took_ms.append((now - self.sent.pop(number)) * 1e3)
            self.came.set()


@contextlib.contextmanager
def driver(link: str, kind: str, watch: Stopwatch) -> Iterator[tuple[str, Publish]]:
    """Yield the robot's link, and the driver's function that publishes."""
    if link == "double":
        with import_module("rosbridge_double").rosbridge_double() as double:
            double.noticed = watch.arrived
            yield double.url, double.publish
        return
    node = Ros2("driver")
    node.advertise(IMAGE, kind)
    node.subscribe(COMMANDS, "std_msgs/msg/Float64MultiArray", watch.arrived)
    node.open()
    try:
        yield link, node.publish
    finally:
        node.close()


def image(number: int, compressed: bool) -> dict[str, Any]:
    """Return a message of 640 x 480 pixels with a number in it."""
    now = time.time_ns()
    pixels = np.random.default_rng(0).integers(0, 32, (480, 640, 3), np.uint8)
    pixels[:8, :8] = number
    header = {"stamp": {"sec": now // 10**9, "nanosec": now % 10**9}, "frame_id": ""}
    if compressed:
        return {"header": header, "format": "jpeg", "data": encode_jpeg(pixels)}
    said = {"height": 480, "width": 640, "encoding": "rgb8", "is_bigendian": 0, "step": 1920}
    return {"header": header, **said, "data": pixels.tobytes()}


def measure(link: str, *, compressed: bool, images: int) -> list[float]:
    """Return the times from each image to its action, ms."""
    watch = Stopwatch()
    kind = f"sensor_msgs/msg/{'CompressedImage' if compressed else 'Image'}"
    with contextlib.ExitStack() as stack:
        address, publish = stack.enter_context(driver(link, kind, watch))
        over = threading.Event()
        stack.callback(over.set)
        action = {
            "topic": COMMANDS,
            "type": "std_msgs/msg/Float64MultiArray",
            "numbers": 1,
            "stop": "nothing",
        }
        stated = {
            "link": address,
            "cameras": {"front": {"topic": IMAGE, "type": kind}},
            "actions": [action],
        }
        settings = settings_from({**stated, "max_age_s": 60.0, "silent_s": 60.0}, "benchmark")
        begin = threading.Thread(target=_publish_until, args=(publish, compressed, over))
        begin.start()
        robot = stack.enter_context(RosRobot(settings))
        player = stack.enter_context(ChunkPlayer(Repeating(), check=Guard(Repeating.contract)))
        player.initialize()
        player.reset(robot.observe())
        robot.apply(np.zeros(1, np.float32))
        time.sleep(1.0)  # waits until the nodes have found each other
        over.set()
        begin.join()
        done = threading.Event()
        loop = threading.Thread(target=_act_on_each, args=(robot, player, done))
        loop.start()
        stack.callback(loop.join)
        stack.callback(done.set)
        for i in range(images):
            message, number = image(1 + i % 200, compressed), 1 + i % 200
            watch.came.clear()
            watch.sent = {number: time.perf_counter()}
            publish(IMAGE, message)
            watch.came.wait(1.0)
            time.sleep(0.01)
    return watch.took_ms


def _publish_until(publish: Publish, compressed: bool, over: threading.Event) -> None:
    while not over.wait(0.1):
        publish(IMAGE, image(0, compressed))


def _act_on_each(robot: RosRobot, player: ChunkPlayer, done: threading.Event) -> None:
    last = None
    while not done.is_set():
        obs = robot.observe()
        if obs.info["captured_at"] != last:
            last = obs.info["captured_at"]
            robot.apply(player.act(obs).action)
        time.sleep(0.0001)


def main() -> None:
    """Measure each kind of image, and print a row for each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--link", default="double", help="double, ros2, or the address of a rosbridge beside ROS 2"
    )
    parser.add_argument("--images", type=int, default=300)
    options = parser.parse_args()
    print(f"{'link':<24}{'images':<12}{'n':>5}{'p10 ms':>9}{'p50 ms':>9}{'p99 ms':>9}{'lost':>6}")  # noqa: T201
    for compressed in (False, True):
        took = measure(options.link, compressed=compressed, images=options.images)
        name = "JPEG" if compressed else "rgb8"
        p10, p50, p99 = np.percentile(took, [10, 50, 99])
        lost = options.images - len(took)
        print(  # noqa: T201
            f"{options.link:<24}{name:<12}{len(took):>5}{p10:>9.2f}{p50:>9.2f}{p99:>9.2f}{lost:>6}",
            flush=True,
        )


if __name__ == "__main__":
    main()
