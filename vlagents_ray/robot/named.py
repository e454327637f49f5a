"""Robots by name: "module:Class", "mujoco:ARM" and "lerobot:TYPE"."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any

from vlagents_ray.errors import ConfigError
from vlagents_ray.robot.loop import ROBOT, Robot, import_class

ADAPTERS = {
    "mujoco": "vlagents_ray.robot.mujoco_arm:MujocoArm",
    "lerobot": "vlagents_ray.robot.lerobot_robot:LeRobotRobot",
}


def robot_named(option: str, name: str, settings: Iterable[str] = ()) -> Callable[..., Robot]:
    """Return what makes the robot that an option such as "--robot" names.

    Args:
        option: The option, for errors.
        name: "module:Class", or an adapter and its first argument: "mujoco:so101", "lerobot:so101_follower".
        settings: Further arguments as KEY=VALUE; the value is JSON, or else text.

    Raises:
        ConfigError: There is no such class, it lacks a method, or a setting is not KEY=VALUE.
    """
    given: dict[str, Any] = {}
    for text in settings:
        key, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"{option}-set: got {text!r}, want KEY=VALUE, as in port=/dev/ttyACM0")
        try:
            given[key] = json.loads(value)
        except json.JSONDecodeError:
            given[key] = value
    adapter, _, first = name.partition(":")
    if adapter in ADAPTERS:
        return partial(import_class(option, ADAPTERS[adapter], ROBOT), first, **given)
    return partial(import_class(option, name, ROBOT), **given)
