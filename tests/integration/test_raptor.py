"""examples/raptor on real servers: sessions whose state cannot be recomputed."""

from __future__ import annotations

import itertools
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import psutil
import pytest
from eval_fakes import wait_for
from raptor_flights import TOLERANCE, fly, loaded, observation, reference, together
from shared_ray import shared_server

from tests.integration.conftest import deploy, states
from tests.integration.test_sessions import TRANSPORTS
from vlagents_ray import Act, Agent, ConnectionLost, Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

FLIGHTS, STEPS = 32, 500
APP = "LocatedRaptor"
START = observation(np.zeros(22, np.float32))


def deployed(replicas: int) -> Deployment:
    config = deployment(
        f"raptor_flights:{APP}", replicas=2, batch={"max_size": FLIGHTS}
    ).model_dump(exclude_unset=True)
    config["applications"][0]["deployments"] = [{"name": "Policy", "num_replicas": replicas}]
    return Deployment(**config)


def scale(replicas: int) -> None:
    deploy(deployed(replicas))
    wait_for(lambda: states(APP).get("RUNNING") == replicas)


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    with shared_server(deployed(2)) as server:
        yield server


@pytest.fixture
def two_replicas(server: Server) -> Server:
    scale(2)
    return server


def client(server: Server, transport: TransportName, **options: Any) -> RemoteAgent:
    url = f"serve://{APP}" if transport in ("handle", "plasma") else server.url
    return RemoteAgent(url, transport=transport, **options)


@pytest.mark.parametrize("transport", TRANSPORTS)
def test_each_transport_carries_the_reference(server: Server, transport: TransportName) -> None:
    # tests/policies/test_raptor.py tests all sequences in one process.
    inputs, wanted = (rows[:150] for rows in reference())
    agents = [client(server, transport) for _ in range(2)]
    for agent in agents:
        agent.reset(START)
        assert agent.transport == transport
    actions = [[agents[i].act(observation(row[i])).action for i in range(2)] for row in inputs]
    for agent in agents:
        agent.close()
    error = np.abs(np.array(actions) - wanted).max()
    print(f"largest error over {transport}: {error:.2e}")
    assert error < TOLERANCE


def test_served_flights_are_those_in_process_to_the_bit(server: Server) -> None:
    agent = client(server, "shm")
    sessions: list[Agent] = list(agent.sessions(FLIGHTS))
    agent.reset_batch([START] * FLIGHTS, [None] * FLIGHTS, sessions)
    timings: list[dict[str, float]] = []

    def acts(obs: Sequence[Obs]) -> list[Act]:
        found = [act for act in agent.act_batch(obs, sessions) if isinstance(act, Act)]
        timings.append(found[0].info["timing"])
        return found

    served = fly(range(FLIGHTS), acts, STEPS)
    for session in (*sessions, agent):
        session.close()
    assert {timing["batch_size"] for timing in timings} == {FLIGHTS}
    times = {
        name: np.median([timing[name] for timing in timings])
        for name in ("inference_ms", "round_trip_ms")
    }
    print(f"{FLIGHTS} sessions in a batch over shm, median: {times}")
    np.testing.assert_array_equal(served, fly(range(FLIGHTS), together(loaded(), FLIGHTS), STEPS))


@pytest.mark.integration
@pytest.mark.parametrize("transport", TRANSPORTS)
def test_a_killed_replica_costs_no_flight(server: Server, transport: TransportName) -> None:
    """The client reports that the session began again, and its actions equal those of the
    reference.
    """
    scale(2)
    inputs, wanted = reference()
    with client(server, transport) as agent:
        pid = agent.reset(START)["pid"]
        for i, row in enumerate(inputs[:300, 0]):
            if i == 200:
                os.kill(pid, signal.SIGKILL)
                wait_for(lambda pid=pid: not psutil.pid_exists(pid))
            act = agent.act(observation(row))
            assert ("resumed" in act.info) == (i == 200), i
            pid = act.info["pid"]
            assert np.abs(act.action - wanted[i, 0]).max() < TOLERANCE, i


def test_a_killed_replica_is_an_error_where_sessions_are_not_resumed(server: Server) -> None:
    scale(2)
    with client(server, "websocket", resume=False) as agent:
        pid = agent.reset(START)["pid"]
        os.kill(pid, signal.SIGKILL)
        wait_for(lambda pid=pid: not psutil.pid_exists(pid))
        with pytest.raises(ConnectionLost):
            agent.act(START)


@pytest.mark.integration
def test_flights_go_on_to_the_bit_while_a_replica_stops(server: Server) -> None:
    scale(2)
    agents = [client(server, transport) for transport in TRANSPORTS for _ in range(2)]
    wait_for(
        lambda: len({agent.reset(START)["pid"] for agent in agents if agent.close() is None}) == 2
    )
    scaling = threading.Thread(target=scale, args=(1,))
    steps = itertools.count()

    def acts(obs: Sequence[Obs]) -> list[Act]:
        match next(steps):
            case 100:
                scaling.start()
            case 400:
                scaling.join()
        found = [agent.act(one) for agent, one in zip(agents, obs, strict=True)]
        assert not any("resumed" in act.info for act in found)
        return found

    served = fly(range(len(agents)), acts, STEPS)
    assert states(APP) == {"RUNNING": 1}
    for agent in agents:
        agent.close()
    np.testing.assert_array_equal(
        served, fly(range(len(agents)), together(loaded(), len(agents)), STEPS)
    )
