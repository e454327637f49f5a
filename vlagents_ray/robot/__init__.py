"""The control loop of a robot, with its guard, watchdog and recorder; it needs the same packages as
`client`.
"""

from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.client.commands import CommandInbox
from vlagents_ray.robot.guard import Guard
from vlagents_ray.robot.limits import MotionLimits
from vlagents_ray.robot.loop import LoopOptions, LoopReport, Robot, run_loop
from vlagents_ray.robot.watchdog import Watchdog

__all__ = [
    "CommandInbox",
    "Guard",
    "LoopOptions",
    "LoopReport",
    "MotionLimits",
    "Robot",
    "RobotControl",
    "Watchdog",
    "run_loop",
]
