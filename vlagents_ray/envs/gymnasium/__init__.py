"""Any registered Gymnasium environment, through a small mapping.

`gymnasium/<id>`, for instance `gymnasium/Pendulum-v1` or `gymnasium/gym_pusht/PushT-v0`. Images and
vectors that the observation space names are found by themselves; an environment without images is
rendered. Everything else is an option of `Gymnasium`.
"""

from vlagents_ray.envs.gymnasium.env import Gymnasium

__all__ = ["Gymnasium"]
