"""LIBERO: 130 table-top tasks of a Panda arm in MuJoCo, as the literature evaluates policies in them.

    with Libero("libero_spatial/0") as env:
        obs, _ = env.reset(seed=0, options={"init_state": 3})
        obs, reward, terminated, truncated, info = env.step(Act(action=np.zeros(7, np.float32)))

The protocol is in `protocol.py`, in one place. The scenes' meshes and textures come with no package:
`Libero.missing()` says how to get them.
"""

from vlagents_ray.envs.libero.env import Libero

__all__ = ["Libero"]
