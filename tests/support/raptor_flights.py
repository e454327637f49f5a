"""RAPTOR of examples/raptor: the reference data that its authors publish with the weights, and
flights with a policy.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from quadrotor import HoverBatch
from raptor import INPUTS, Raptor

from vlagents_ray import Act, Obs

TOLERANCE = 1e-6  # the authors' own tolerance of the mean error, here of the largest error
Acts = Callable[[Sequence[Obs]], Sequence[Act]]


class LocatedRaptor(Raptor):
    """A RAPTOR policy that reports its process at each reset and act, for tests that kill the
    process. A session may have moved since its reset.
    """

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        super().reset(obs, instruction, **kwargs)
        return {"pid": os.getpid()}

    def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Any]) -> list[Act]:
        return [
            Act(act.action, info={"pid": os.getpid()}) for act in super().act_batch(obs, sessions)
        ]


def reference() -> tuple[np.ndarray, np.ndarray]:
    """Return the inputs, (500, 2, 22), and the actions, (500, 2, 4), of two sequences."""
    import foundation_policy
    import h5py

    with h5py.File(Path(foundation_policy.__file__).parent / "blob" / "checkpoint.h5") as file:
        return file["example/input"][()], file["example/output"][()]


def observation(inputs: np.ndarray) -> Obs:
    """Return an observation with the policy's 22 inputs."""
    ends = np.cumsum([spec.dim for spec in INPUTS.values()])[:-1]
    return Obs(state=dict(zip(INPUTS, np.split(inputs, ends), strict=True)))


def loaded() -> Raptor:
    policy = Raptor()
    policy.initialize()
    return policy


def fly(seeds: Sequence[int], acts: Acts, steps: int) -> np.ndarray:
    """Fly from the start of each seed, and return the quadrotors' states after each step, (steps,
    17, flights).
    """
    batch = HoverBatch(len(seeds))
    obs = batch.reset(seeds=seeds)
    states = []
    for _ in range(steps):
        obs, *_ = batch.step(acts(obs))
        states.append(batch.flights.state)
    return np.array(states)


def together(policy: Raptor, flights: int) -> Acts:
    """Return a function that acts for all flights in one batch, with a policy in this process."""
    sessions = [session(policy) for _ in range(flights)]
    return lambda obs: policy.act_batch(obs, sessions)


def session(policy: Raptor) -> Raptor:
    """Return a copy of the policy in a new episode, with shared weights."""
    one = Raptor()
    one.weights = policy.weights
    one.reset(Obs(), None)
    return one
