"""One small random checkpoint for all tests, and policies and sessions of it."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from plugins.vlagents_ray_models.tests.families.pi0 import tiny
from vlagents_ray import Obs
from vlagents_ray_models.pi0 import Pi0

torch.set_num_threads(1)  # the model is too small for more: threads would wait for one another

WORDS = ("pick up the cube", "push", "open the upper drawer of the white cabinet")
BATCHED = 1e-5  # how far a batch's actions may be off those of a lone row, in float32 on a CPU


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.save(tmp_path_factory.mktemp("pi0"))


def made(folder: Path, **config: Any) -> Pi0:
    policy = Pi0.from_config({"checkpoint": str(folder), **config})
    policy.initialize()
    return policy


def seen(seed: int, side: tuple[int, int] = (224, 224), **info: Any) -> Obs:
    rng = np.random.default_rng(seed)
    return Obs(
        cameras={
            name: rng.integers(0, 256, (*side, 3), dtype=np.uint8) for name in ("front", "wrist")
        },
        state={
            "xyz_axis_angle": rng.normal(size=6).astype(np.float32),
            "gripper_qpos": rng.normal(size=2).astype(np.float32),
        },
        info=info,
    )


def begun(policy: Pi0, i: int) -> Pi0:
    """Return session `i`, in an episode with its own instruction and seed."""
    session = copy.copy(policy)
    session.reset(seen(i), WORDS[i % len(WORDS)], seed=i)
    return session
