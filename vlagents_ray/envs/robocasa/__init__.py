"""RoboCasa365's kitchen tasks: a Panda arm on a mobile base, in MuJoCo.

with RoboCasa("NavigateKitchen") as env:
    obs, _ = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(12, np.float32)))
"""

from vlagents_ray.envs.robocasa.env import RoboCasa

__all__ = ["RoboCasa"]
