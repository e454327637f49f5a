"""Compare an episode with all images with an episode with only the images that the policy
receives.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.envs import EvalEnv
from vlagents_ray.interface import Act, Obs

_CHUNK = 3


def require_same_without_unseen_images(env: EvalEnv) -> None:
    """Check that an environment omits the images that no policy uses, and that nothing else depends
    on these images.

    All other data of each step, and the images in use, must be bit-identical.
    """
    told, images = _played(env, every=1)
    sparing, few = _played(env, every=_CHUNK)
    assert sparing == told
    assert all(images)
    assert few == [image if i % _CHUNK == 0 else {} for i, image in enumerate(images)]


def _played(env: EvalEnv, *, every: int) -> tuple[list[Any], list[Any]]:
    """Return the data of an episode with random actions, and its images, as bytes."""
    rng = np.random.default_rng(5)
    told, images = [], []

    def add(obs: Obs, *outcome: Any) -> None:
        told.append([_plain(obs.state), obs.gripper, _plain(dict(obs.info)), outcome])
        images.append(_plain(obs.cameras))

    add(env.reset(seed=3)[0])
    for i in range(1, env.max_steps + 1):
        env.looked_at = i % every == 0
        obs, *outcome, info = env.step(
            Act(rng.uniform(-0.3, 0.3, env.contract.action.dim or 0).astype(np.float32))
        )
        add(obs, *outcome, info["success"])
    return told, images


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(one) for name, one in value.items()}
    return value.tobytes() if isinstance(value, np.ndarray) else value
