"""One adapter's values are pushed to several replicas: all of them act with these, or none."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from adapted_network import DIM, LAYERS, Small, base, pairs, save
from in_flight import answered
from pushed_weights import push

from vlagents_ray import Obs
from vlagents_ray.errors import UnchangedWeights
from vlagents_ray.protocol.messages import Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.weights import PushOptions
from vlagents_ray_learn.weight_push import ThisReplica, WeightPusher

pytestmark = pytest.mark.torch

RANKS = {"stack": 4, "pour": 2}


@pytest.fixture
def engines(tmp_path: Path) -> Iterator[list[Engine]]:
    """Two replicas with the adapters `RANKS`."""
    config: dict[str, Any] = {"checkpoint": str(base(tmp_path))}
    network = _network(config)
    for name, rank in RANKS.items():
        save(tmp_path / name, pairs(network, LAYERS, rank, seed=rank))
    config["adapters"] = {name: str(tmp_path / name) for name in RANKS}
    found = [Engine(Small.from_config(config)) for _ in range(2)]
    for engine in found:
        engine.start()
    yield found
    for engine in found:
        engine.close()


@pytest.fixture
def trained(tmp_path: Path) -> dict[str, np.ndarray]:
    """New values of the adapter "stack", by the policy's names."""
    network = _network({"checkpoint": str(base(tmp_path))})
    values = pairs(network, LAYERS, RANKS["stack"], seed=9)
    return {f"stack/{name}": value for name, value in values.items()}


def _network(config: dict[str, Any]) -> Any:
    policy = Small.from_config(config)
    policy.initialize()
    return policy.model


def acted(engine: Engine) -> dict[str, tuple[bytes, dict[str, Any]]]:
    """The first action of an episode with each adapter, and the weights that it states."""
    found = {}
    for name in RANKS:
        first, second = (
            Obs(state={"joints": np.random.default_rng(seed).normal(size=DIM).astype(np.float32)})
            for seed in range(2)
        )
        kwargs = {"seed": 3, "adapter": name}
        reset = Request("reset", first, None, kwargs, priority="simulation")
        assert answered(engine, name, reset).error is None
        act = answered(engine, name, Request("act", second, priority="simulation")).act
        found[name] = act.action.tobytes(), act.info["policy"]
    return found


def pushing(own: Engine, other: Engine, values: dict[str, np.ndarray]) -> Any:
    async def others() -> list[ThisReplica]:
        return [ThisReplica("other", other.weights)]

    pusher = WeightPusher(ThisReplica("own", own.weights), others)
    return asyncio.run(pusher.push(values, PushOptions(partial=True)))


def test_all_replicas_act_with_it(engines: list[Engine], trained: dict[str, np.ndarray]) -> None:
    own, other = engines
    before = acted(own)
    assert pushing(own, other, trained).replicas == ("other", "own")
    assert acted(own) == acted(other)
    assert acted(own)["stack"][0] != before["stack"][0]


def test_no_replica_acts_with_it_if_one_refuses(
    engines: list[Engine], trained: dict[str, np.ndarray]
) -> None:
    own, other = engines
    push(other, trained, partial=True)  # it rejects the values that it has already
    before = [acted(engine) for engine in engines]
    with pytest.raises(UnchangedWeights):
        pushing(own, other, trained)
    assert [acted(engine) for engine in engines] == before
