"""Random observations, for policies without recorded ones."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from vlagents_ray.contract import CameraSpec, Contract, StateSpec
from vlagents_ray.interface import Obs

_SIDE = 64  # px
_DIM = 7


def random_observation(
    contract: Contract | None, seed: int, *, side: int = _SIDE, dims: Mapping[str, int] | None = None
) -> Obs:
    """Make a random observation that fits a contract.

    Returns:
        The observation; equal seeds give equal observations.
    """
    rng = np.random.default_rng(seed)
    cameras: Mapping[str, CameraSpec] = {"front": CameraSpec()}
    state: Mapping[str, StateSpec] = {"joints": StateSpec()}
    if contract is not None:
        cameras = cameras if contract.cameras is None else contract.cameras
        state = state if contract.state is None else contract.state
    sizes = {name: part.dim or (dims or {}).get(name, _DIM) for name, part in state.items()}
    return Obs(
        cameras={
            name: rng.integers(0, 256, (camera.height or side, camera.width or side, 3), dtype=np.uint8)
            for name, camera in cameras.items()
        },
        gripper=float(rng.uniform()),
        state={name: rng.uniform(-1, 1, size).astype(np.float32) for name, size in sizes.items()},
    )
