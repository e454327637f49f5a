"""New weights for two replicas of a server, through Ray's object store."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from eval_fakes import wait_for
from served_acts import first_act
from shared_ray import shared_server

from tests.integration.conftest import deploy, states
from vlagents_ray.errors import InvalidWeights, PolicyUnavailable, UnchangedWeights
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server
from vlagents_ray_learn import Publisher

TRANSPORTS = ("shm", "plasma", "websocket", "http", "handle")


def deployed(replicas: int) -> Deployment:
    """A policy that can be trained."""
    document = deployment("served_agents:Trainable", replicas=2).model_dump(exclude_unset=True)
    document["applications"][0]["deployments"] = [{"name": "Policy", "num_replicas": replicas}]
    return Deployment(**document)


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    with shared_server(deployed(2)) as server:
        yield server


def gain(value: float) -> dict[str, np.ndarray]:
    return {"gain": np.full(200_000, value, np.float32)}


def acts(server: Server, transport: str) -> tuple[int, float]:
    return first_act(server, "Trainable", transport)


def test_both_replicas_act_with_a_push_on_every_transport(server: Server) -> None:
    assert [acts(server, transport) for transport in TRANSPORTS] == [(0, 0.0)] * 5
    weights = Publisher("serve://Trainable")
    version = weights.push(gain(1))
    assert weights.acknowledged(version) == 2
    assert [acts(server, transport) for transport in TRANSPORTS for _ in range(2)] == [
        (1, 1.0)
    ] * 10
    for wrong, error in ((gain(np.nan), InvalidWeights), (gain(1), UnchangedWeights)):
        with pytest.raises(error):
            weights.push(wrong)
    assert weights.push(gain(2)) == 2


def test_a_push_over_the_network_reaches_both_replicas(server: Server) -> None:
    with Publisher(server.url) as weights:
        version = weights.push(gain(5))
        assert weights.acknowledged(version) == 2
        assert [acts(server, "http") for _ in range(4)] == [(version, 5.0)] * 4
        with pytest.raises(UnchangedWeights):
            weights.push(gain(5))


@pytest.mark.parametrize("target", ["serve://Trainable", "URL"])
def test_both_replicas_sleep_and_wake_with_new_weights(server: Server, target: str) -> None:
    with (
        Publisher(server.url if target == "URL" else target) as weights,
        ThreadPoolExecutor(4) as threads,
    ):
        weights.sleep()
        waiting = [threads.submit(acts, server, "http") for _ in range(4)]
        with pytest.raises(PolicyUnavailable, match="got one that sleeps"):
            weights.push(gain(20))
        newest = 20.0 + len(target)
        version = weights.wake(gain(newest))
        assert [act.result() for act in waiting] == [(version, newest)] * 4


def test_a_replica_that_starts_later_has_the_weights_of_the_others(server: Server) -> None:
    weights = Publisher("serve://Trainable")
    version = weights.push(gain(7))
    deploy(deployed(3))
    wait_for(lambda: states("Trainable").get("RUNNING") == 3)
    assert weights.acknowledged(version) == 3
