"""One tiny checkpoint of each kind, and policies that loaded them, for all tests."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from vlagents_ray import Obs
from vlagents_ray.policies.base import ModelPolicy
from vlagents_ray.registry import policy_class

# They run in this family's environment; in another one there is nothing to collect.
collect_ignore_glob = [] if importlib.util.find_spec("tokenizers") else ["test_*.py"]
torch.set_num_threads(1)  # of products this small, several cores make slower ones

LIBRARIES = [
    # timm 0.9.10 scripts some activations, which torch 2.13 deprecates
    pytest.mark.filterwarnings("ignore:`torch.jit.:DeprecationWarning"),
]
WORDS = (
    "Pick up the black bowl",
    "open the drawer",
    "put the bowl, which stands on the stove, into the top drawer",
)


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """The folder of a kind's checkpoint."""
    from plugins.vlagents_ray_models.tests.families.openvla import tiny

    root = tmp_path_factory.mktemp("openvla")
    return lru_cache(lambda kind: tiny.make(root / kind, kind))


@pytest.fixture(scope="session")
def loaded(checkpoint: Callable[[str], Path]) -> Callable[..., ModelPolicy]:
    """Loads a policy with a kind's checkpoint, for the dataset `bridge_orig` by default."""

    @lru_cache
    def load(kind: str, **config: Any) -> ModelPolicy:
        settings = {"checkpoint": str(checkpoint(kind)), "unnorm_key": "bridge_orig"} | config
        cls = policy_class("openvla_oft" if "oft" in kind else "openvla")
        policy: ModelPolicy = cls.from_config(settings)
        policy.initialize()
        return policy

    return load


def seen(seed: int, **info: Any) -> Obs:
    """Return an observation of session `seed`, with LIBERO's cameras and states."""
    rng = np.random.default_rng(seed)
    return Obs(
        cameras={
            name: rng.integers(0, 256, (80, 96, 3), dtype=np.uint8) for name in ("front", "wrist")
        },
        state={
            "xyz_axis_angle": rng.normal(size=6).astype(np.float32),
            "gripper_qpos": rng.normal(size=2).astype(np.float32),
        },
        info=info,
    )


def begun(policy: Any, seed: int, **options: Any) -> Any:
    """Return session `seed` of a loaded policy, in an episode."""
    session = type(policy)(policy.config)
    session.model = policy.model
    session.reset(seen(seed), WORDS[seed % len(WORDS)], seed=seed, **options)
    return session
