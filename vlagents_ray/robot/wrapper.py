"""The base class of robots that wrap another robot."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.interface import Obs
from vlagents_ray.robot.loop import Robot


class RobotWrapper(Robot):
    """A robot that wraps another robot, and has all attributes of this inner robot.

    Optional attributes of a `Robot`, such as `holds`, are read from and written to the inner robot
    at each access. A subclass overrides the methods that it changes. The attributes of a subclass
    begin with an underscore or are declared in the class.

    Args:
        robot: The inner robot.
    """

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    def observe(self) -> Obs:
        return self._robot.observe()

    def apply(self, action: np.ndarray) -> None:
        self._robot.apply(action)

    def stop(self) -> None:
        self._robot.stop()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # includes `_robot` itself, before `__init__` or in a copy
            raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")
        return getattr(self._robot, name)

    def __setattr__(self, name: str, value: Any) -> None:
        if name.startswith("_") or hasattr(type(self), name):
            super().__setattr__(name, value)
        else:
            setattr(self._robot, name, value)
