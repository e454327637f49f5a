"""On the robot's own computer: the control loop, what makes it safe, and recording. As light as `client`."""

from vlagents_ray.robot.loop import LoopReport, Robot, run_loop
from vlagents_ray.robot.safety import Guard, Watchdog

__all__ = ["Guard", "LoopReport", "Robot", "Watchdog", "run_loop"]
