"""A learner pushes the values of one of two adapters to a server, over the network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapted_network import LAYERS, Small, base, pairs, save
from adapted_server import RANKS, observation, policy, save_adapters, serving_adapters

from vlagents_ray import RemoteAgent
from vlagents_ray.errors import InvalidWeights
from vlagents_ray.serve.launch.server import Server
from vlagents_ray_learn import Publisher

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


def played(server: Server, **options: Any) -> tuple[bytes, dict[str, Any]]:
    """The first action of an episode, and the weights that it states."""
    with RemoteAgent(server.url, transport="http", priority="simulation") as agent:
        agent.reset(observation(0), None, seed=0, **options)
        act = agent.act(observation(1))
        return act.action.tobytes(), act.info["policy"]


def test_an_adapter_that_is_pushed_over_the_network_acts_as_the_saved_one(
    server: Server, folder: Path, values: dict[str, dict[str, np.ndarray]]
) -> None:
    before = {name: played(server, checkpoint=name) for name in RANKS}
    plain, trained = played(server), pairs(policy(folder).model, LAYERS, RANKS["stack"], seed=9)
    with Publisher(server.url) as weights:
        version = weights.push(named(trained), partial=True)
        with pytest.raises(InvalidWeights, match=r"expected one of the policy's 16 names"):
            weights.push({f"fold/{name}": value for name, value in trained.items()}, partial=True)
        save(folder.parent / "trained", trained)
        alone = Small.from_config(
            {"checkpoint": str(folder), "adapters": {"stack": str(folder.parent / "trained")}}
        )
        alone.initialize()
        alone.reset(observation(0), None, seed=0, adapter="stack")
        action, stated = played(server, checkpoint="stack")
        assert action == alone.act(observation(1)).action.tobytes() != before["stack"][0]
        assert stated["version"] == version
        assert played(server, checkpoint="pour") == (before["pour"][0], stated)
        assert played(server) == plain
        weights.push(named(values["stack"]), partial=True)
        assert played(server, checkpoint="stack")[0] == before["stack"][0]


def named(values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    return {f"stack/{name}": value for name, value in values.items()}
