"""A server with two LoRA adapters of one base, for tests of the core and of plug-ins."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from adapted_network import DIM, LAYERS, Small, pairs, save

from tests.integration.conftest import serving
from vlagents_ray import Obs
from vlagents_ray.serve.launch.server import Server

RANKS = {"stack": 4, "pour": 2}


def policy(folder: Path) -> Small:
    """Return the initialized base policy, without adapters."""
    base_alone = Small.from_config({"checkpoint": str(folder)})
    base_alone.initialize()
    return base_alone


def save_adapters(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """Save each adapter in a folder of its name next to the base, and return the adapters by name."""
    network = policy(folder).model
    adapters = {name: pairs(network, LAYERS, rank, seed=rank) for name, rank in RANKS.items()}
    for name, adapter in adapters.items():
        save(folder.parent / name, adapter)
    return adapters


@contextmanager
def serving_adapters(folder: Path) -> Iterator[Server]:
    """Serve the base in `folder` and the adapters next to it."""
    choices = {name: {"adapter": str(folder.parent / name)} for name in RANKS}
    config = {"checkpoint": str(folder)}
    checkpoints = {"choices": choices}
    with serving("adapted_network:Small", config=config, checkpoints=checkpoints) as server:
        yield server


def observation(seed: int) -> Obs:
    """Return an observation with random joints for a seed."""
    joints = np.random.default_rng(seed).normal(size=DIM)
    return Obs(state={"joints": joints.astype(np.float32)})
