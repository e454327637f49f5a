"""A server with two LoRA adapters of one base. Sessions of both adapters act in one batch, with the
same actions as each fine-tuned policy alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapted_network import base, merge
from adapted_server import observation, policy, save_adapters, serving_adapters

from vlagents_ray import RemoteAgent
from vlagents_ray.errors import UnknownCheckpoint
from vlagents_ray.interface import Act
from vlagents_ray.serve.launch.server import Server

pytestmark = pytest.mark.torch


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return base(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def values(folder: Path) -> dict[str, dict[str, np.ndarray]]:
    return save_adapters(folder)


@pytest.fixture(scope="module")
def server(
    shared_ray: None, folder: Path, values: dict[str, dict[str, np.ndarray]]
) -> Iterator[Server]:
    with serving_adapters(folder) as server:
        yield server


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
                observation(seed), None, seed=seed, **({} if name is None else {"checkpoint": name})
            )
            for seed, (session, name) in enumerate(zip(sessions, chosen, strict=True))
        ]
        served = agent.act_batch([observation(10 + seed) for seed in range(len(chosen))], sessions)
        with pytest.raises(
            UnknownCheckpoint, match=r"expected one of \['pour', 'stack'\] or none, for its own"
        ):
            agent.reset(observation(0), None, checkpoint="../stack")
    assert [info["checkpoint"] for info in infos] == [
        str(folder.parent / (name or folder.name)) for name in chosen
    ]
    assert len({info["weights"] for info in infos}) == len(chosen)
    for seed, (name, act) in enumerate(zip(chosen, served, strict=True)):
        alone = policy(folder)
        if name is not None:
            merge(alone.model, values[name])
        alone.reset(observation(seed), None, seed=seed)
        assert isinstance(act, Act)
        assert act.info["rows"] == len(chosen)
        np.testing.assert_allclose(
            act.action, alone.act(observation(10 + seed)).action, rtol=1e-5, atol=1e-5
        )
