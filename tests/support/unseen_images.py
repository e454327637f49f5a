"""An env's episode with all images, and once more with those alone that the policy gets."""

from __future__ import annotations

from typing import Any

import numpy as np

from vlagents_ray.envs import EvalEnv
from vlagents_ray.interface import Act, Obs

_CHUNK = 3


def require_same_without_unseen_images(env: EvalEnv) -> None:
    """Require that an env leaves out the images that no policy looks at, and that nothing else
    depends on them.

    Everything but the images of every step, and the images that are looked at, are equal to the
    bit.
    """
    told, images = _played(env, every=1)
    sparing, few = _played(env, every=_CHUNK)
    assert sparing == told
    assert all(images)
    assert few == [image if i % _CHUNK == 0 else {} for i, image in enumerate(images)]


def _played(env: EvalEnv, *, every: int) -> tuple[list[Any], list[Any]]:
    """What an episode of random actions gave, and its images, as bytes."""
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
