"""CALVIN: five tasks one after another, told in words, at a table with drawer, sliding door, lights and blocks.

with Calvin("D") as env:
    obs, _ = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(Act(action=np.array([0, 0, 0, 0, 0, 0, 1], np.float32)))
"""

from vlagents_ray.envs.calvin.env import Calvin

__all__ = ["Calvin"]
