"""A server of two LoRA adapters over one base: sessions of both act in one pass, each as its
fine-tune alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapted_network import DIM, LAYERS, Small, base, merge, pairs, save

from tests.integration.conftest import serving
from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.errors import UnknownCheckpoint
from vlagents_ray.interface import Act
from vlagents_ray.serve.launch.server import Server

pytestmark = pytest.mark.torch

RANKS = {"stack": 4, "pour": 2}


def policy(folder: Path) -> Small:
    """The base alone."""
    made = Small.from_config({"checkpoint": str(folder)})
    made.initialize()
    return made


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return base(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def values(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    """The adapters by name, which lie in folders of that name beside the base."""
    network = policy(folder).model
    made = {name: pairs(network, LAYERS, rank, seed=rank) for name, rank in RANKS.items()}
    for name, one in made.items():
        save(folder.parent / name, one)
    return made


@pytest.fixture(scope="module")
def server(
    shared_ray: None, folder: Path, values: dict[str, dict[str, np.ndarray]]
) -> Iterator[Server]:
    choices = {name: {"adapter": str(folder.parent / name)} for name in values}
    config = {"checkpoint": str(folder)}
    with serving(
        "adapted_network:Small", config=config, checkpoints={"choices": choices}
    ) as server:
        yield server


def at(seed: int) -> Obs:
    return Obs(state={"joints": np.random.default_rng(seed).normal(size=DIM).astype(np.float32)})


@pytest.mark.parametrize("transport", ["shm", "http"])
def test_sessions_of_two_adapters_act_in_one_batch_as_each_merged_alone(
    server: Server, folder: Path, values: dict[str, dict[str, np.ndarray]], transport: Any
) -> None:
    chosen = ["stack", "pour", None]
    with ExitStack() as opened:
        agent = opened.enter_context(RemoteAgent(server.url, transport=transport))
        sessions = [opened.enter_context(session) for session in agent.sessions(len(chosen))]
        infos = [
            session.reset(
                at(seed), None, seed=seed, **({} if name is None else {"checkpoint": name})
            )
            for seed, (session, name) in enumerate(zip(sessions, chosen, strict=True))
        ]
        served = agent.act_batch([at(10 + seed) for seed in range(len(chosen))], sessions)
        with pytest.raises(
            UnknownCheckpoint, match=r"want one of \['pour', 'stack'\] or none, for its own"
        ):
            agent.reset(at(0), None, checkpoint="../stack")
    assert [info["checkpoint"] for info in infos] == [
        str(folder.parent / (name or folder.name)) for name in chosen
    ]
    assert len({info["weights"] for info in infos}) == len(chosen)
    for seed, (name, act) in enumerate(zip(chosen, served, strict=True)):
        alone = policy(folder)
        if name is not None:
            merge(alone.model, values[name])
        alone.reset(at(seed), None, seed=seed)
        assert isinstance(act, Act)
        assert act.info["rows"] == len(chosen)
        np.testing.assert_allclose(
            act.action, alone.act(at(10 + seed)).action, rtol=1e-5, atol=1e-5
        )
