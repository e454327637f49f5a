"""LeRobot 0.4.4's policies: ACT, Diffusion, SmolVLA, X-VLA, π0, π0.5, VQ-BeT, TD-MPC and others."""

from vlagents_ray.policies.lerobot.config import LeRobotConfig
from vlagents_ray.policies.lerobot.policy import LeRobot

__all__ = ["LeRobot", "LeRobotConfig"]
