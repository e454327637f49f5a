"""Short episodes of LIBERO, and the fingerprint with which two of them are compared."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from vlagents_ray.interface import Act, Obs
from vlagents_ray_sims.libero import Libero, LiberoSimulation

STILL = Act(np.array([0, 0, 0, 0, 0, 0, -1], np.float32))


def begin(env: Libero, state: int = 0, seed: int = 0) -> Obs:
    return env.reset(seed=seed, options={"init_state": state})[0]


def play(env: Libero, state: int = 0, between: Callable[[], object] = lambda: None) -> list[Obs]:
    """Return the first observation, and those after three steps with motion."""
    seen = [begin(env, state)]
    for i in range(3):
        between()
        seen.append(
            env.step(Act(np.array([0.5, -0.5, 0.2 * i, 0, 0, 0.3, (-1) ** i], np.float32)))[0]
        )
    return seen


def fingerprint(seen: list[Obs]) -> str:
    parts = [
        array.tobytes()
        for obs in seen
        for group in (obs.cameras, obs.state)
        for array in group.values()
    ]
    return hashlib.sha256(b"".join(parts)).hexdigest()


def world(env: Libero) -> LiberoSimulation:
    assert env._env is not None
    return env._env
