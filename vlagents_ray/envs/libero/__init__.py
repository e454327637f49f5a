"""LIBERO: 130 table-top tasks of a Panda arm in MuJoCo, as the literature evaluates policies in them.

    with Libero("libero_spatial/0") as env:
        obs, _ = env.reset(seed=0, options={"init_state": 3})
        obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(7, np.float32)))

The protocol is in `tasks.py`. The scenes' meshes and textures are in no package: `Libero.missing()` says
how to download them.
"""

from vlagents_ray.envs.libero.env import Libero

__all__ = ["Libero"]
