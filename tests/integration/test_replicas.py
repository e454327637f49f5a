"""Several replicas: a session stays on one replica, on any transport."""

from __future__ import annotations

import contextlib
import os
import signal
from collections import Counter
from collections.abc import Iterator

import pytest
import ray
from eval_fakes import wait_for

from tests.integration.conftest import serving
from tests.integration.test_sessions import obs
from vlagents_ray import ConnectionLost, NotReset, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.client.transports.serve_handle import ReplicaNodes
from vlagents_ray.serve.launch.server import Server

BY_HANDLE_OR_SHM: tuple[TransportName, ...] = ("handle", "shm")


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    with serving("served_agents:Reacher", replicas=3) as server:
        yield server


def opened(agents: list[RemoteAgent]) -> list[int]:
    """Reset each session, and return the process id of each session's replica."""
    return [agent.reset(obs(i), f"task {i}")["pid"] for i, agent in enumerate(agents)]


def spread(agents: list[RemoteAgent], evenly: bool = False) -> list[int]:
    """Reset the sessions until all three replicas, including replacements of killed ones, have
    some; return the same as `opened`.

    Sessions that are distributed `evenly` stay at their replicas, since the replicas do not change
    such a balance.
    """
    pids: list[int] = []

    def done() -> bool:
        for agent in agents:
            agent.close()
        pids[:] = opened(agents)
        held = Counter(pids).values()
        return len(held) == 3 and (not evenly or max(held) - min(held) <= 1)

    wait_for(done)
    return pids


def check(agents: list[RemoteAgent], pids: list[int], steps: int) -> None:
    for step in range(1, steps):
        for i, agent in enumerate(agents):
            act = agent.act(obs(0))
            assert (act.info["pid"], act.info["instruction"], act.action[0]) == (
                pids[i],
                f"task {i}",
                step,
            )


def test_http_sessions_stay_on_their_replica(server: Server) -> None:
    # With so many sessions, the hashes reach each replica.
    agents = [RemoteAgent(server.url, transport="http") for _ in range(30)]
    check(agents, spread(agents), 20)
    for agent in agents:
        agent.close()


def test_a_caller_learns_on_which_nodes_the_replicas_are_and_of_no_application_nothing(
    server: Server,
) -> None:
    assert server.apps.keys() == {"Reacher"}
    nodes, here = ReplicaNodes("Reacher"), ray.get_runtime_context().get_node_id()
    wait_for(lambda: nodes.query() == {here: 3})
    assert ReplicaNodes("Nobody").query() == {}


def test_a_dead_replica_ends_its_own_sessions_and_no_others(server: Server) -> None:
    """One replica is killed for both transports: when its replacement joins, sessions would move
    while the test runs.
    """
    transports = 8 * BY_HANDLE_OR_SHM
    agents = [
        RemoteAgent("serve://Reacher", transport=transport, resume=False)
        for transport in transports
    ]
    with contextlib.ExitStack() as stack:
        for agent in agents:
            stack.callback(agent.close)
        pids = spread(agents, evenly=True)
        check(agents, pids, 5)
        os.kill(pids[0], signal.SIGKILL)

        ended: Counter[str] = Counter()
        for i, agent in enumerate(agents):
            if pids[i] == pids[0]:
                ended[agent.transport] += 1
                with pytest.raises(ConnectionLost):
                    agent.act(obs(0))
                with pytest.raises(NotReset):
                    agent.act(obs(0))
            else:
                assert agent.act(obs(0)).info["instruction"] == f"task {i}"
    assert ended.keys() == set(BY_HANDLE_OR_SHM)

    assert agents[0].reset(obs(0), "elsewhere")["instruction"] == "elsewhere"
    agents[0].close()
