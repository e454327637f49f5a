"""A file of observations, for the processes that act on them, without what reads recordings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vlagents_ray.interface import Obs

_CAMERA, _STATE, _GRIPPER = "camera", "state", "gripper"  # keys: NUMBER/camera/NAME, NUMBER/state/NAME, NUMBER/gripper


def save_observations(observations: Sequence[Obs], file: Path) -> None:
    """Write observations into a .npz file."""
    arrays: dict[str, np.ndarray] = {}
    for number, obs in enumerate(observations):
        arrays |= {f"{number}/{_CAMERA}/{name}": image for name, image in obs.cameras.items()}
        arrays |= {f"{number}/{_STATE}/{name}": values for name, values in obs.state.items()}
        if obs.gripper is not None:
            arrays[f"{number}/{_GRIPPER}"] = np.array(obs.gripper)
    np.savez(file, **arrays)  # type: ignore[arg-type]


def load_observations(file: Path) -> list[Obs]:
    """Read what `save_observations` wrote."""
    found: dict[int, Obs] = {}
    with np.load(file, allow_pickle=False) as arrays:
        for key in arrays.files:
            number, kind, *name = key.split("/", 2)
            obs = found.setdefault(int(number), Obs())
            if kind == _GRIPPER:
                obs.gripper = float(arrays[key])
            else:
                (obs.cameras if kind == _CAMERA else obs.state)[name[0]] = arrays[key]
    return [found[number] for number in sorted(found)]
