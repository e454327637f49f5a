"""robosuite's tasks of the robomimic study: Panda arms over a table in MuJoCo.

with Robosuite("Lift") as env:
    obs, _ = env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(7, np.float32)))
"""

from vlagents_ray.envs.robosuite.env import Robosuite

__all__ = ["Robosuite"]
