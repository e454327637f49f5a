"""ManiSkill 3: eleven table-top tasks that need no downloads, and any other task registered with ManiSkill.

    with ManiSkill("PushCube-v1", width=224, height=224) as env:
        obs, _ = env.reset(seed=0)
        obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(7, np.float32)))

It needs a Vulkan device, for example Mesa's software one; `ManiSkill.missing()` reports a missing one.
"""

from vlagents_ray.envs.maniskill.env import ManiSkill

__all__ = ["ManiSkill"]
