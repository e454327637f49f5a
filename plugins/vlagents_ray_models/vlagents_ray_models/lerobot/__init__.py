"""Policies of LeRobot 0.4 and 0.6: ACT, Diffusion, SmolVLA, X-VLA, GR00T, π0, π0.5, VQ-BeT,
TD-MPC and others.
"""

from vlagents_ray_models.lerobot.config import LeRobotConfig
from vlagents_ray_models.lerobot.policy import LeRobot

__all__ = ["LeRobot", "LeRobotConfig"]
