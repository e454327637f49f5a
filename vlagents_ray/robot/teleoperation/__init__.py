"""What a human moves a robot with: leaders for `ChunkPlayer(..., override=leader)`."""

from vlagents_ray.chunking.control import Leader
from vlagents_ray.robot.teleoperation.agent import TeleoperatedAgent
from vlagents_ray.robot.teleoperation.axes import AxesDevice, AxesLeader
from vlagents_ray.robot.teleoperation.keyboard import Keyboard
from vlagents_ray.robot.teleoperation.spacemouse import SpaceMouse

__all__ = [
    "AxesDevice",
    "AxesLeader",
    "Keyboard",
    "Leader",
    "SpaceMouse",
    "TeleoperatedAgent",
]
