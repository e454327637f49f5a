"""One tiny checkpoint of each kind for all tests, and sessions of its policy."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from plugins.vlagents_ray_models.tests.families.diffusion_policy import tiny
from vlagents_ray import Obs
from vlagents_ray_models.diffusion_policy import DiffusionPolicy

Checkpoint = Callable[[str], Path]
LIBRARIES = [
    # The authors' save_checkpoint leaves its file open; robomimic 0.2.0 asks torchvision for a
    # network as of old.
    pytest.mark.filterwarnings("ignore:unclosed file .*latest.ckpt:ResourceWarning"),
    pytest.mark.filterwarnings("ignore:The parameter 'pretrained' is deprecated:UserWarning"),
    pytest.mark.filterwarnings("ignore:Arguments other than a weight enum:UserWarning"),
]


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Checkpoint:
    """The file of a kind, made when it is first asked for."""
    return lru_cache(
        lambda kind: tiny.save(tmp_path_factory.mktemp("diffusion_policy") / kind, kind)
    )


def made(checkpoint: Path, **config: Any) -> DiffusionPolicy:
    return DiffusionPolicy.from_config(
        {"checkpoint": str(checkpoint), "trust_checkpoint": True, **config}
    )


def loaded(checkpoint: Path, **config: Any) -> DiffusionPolicy:
    policy = made(checkpoint, **config)
    policy.initialize()
    return policy


def seen(seed: int, size: tuple[int, int] = (48, 48), **info: Any) -> Obs:
    rng = np.random.default_rng(seed)
    return Obs(
        cameras={"front": rng.integers(0, 256, (*size, 3), dtype=np.uint8)},
        state={
            "agent_pos": rng.uniform(-2, 1, 2).astype(np.float32),
            "state": rng.uniform(-2, 1, 4).astype(np.float32),
        },
        info=info,
    )


def begun(policy: DiffusionPolicy, seed: int = 0) -> DiffusionPolicy:
    session = copy.copy(policy)
    session.reset(seen(0), None, seed=seed)
    return session
