"""Sessions are distributed evenly among the replicas, both when they begin and when a replica
joins.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from eval_fakes import wait_for
from shared_ray import shared_server

from tests.integration.conftest import deploy
from tests.integration.test_sessions import obs, url
from vlagents_ray import RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server

# Number of sessions by transport. Among equal connections the oldest are moved first.
HELD: dict[TransportName, int] = {"handle": 2, "shm": 2, "http": 2, "websocket": 6}


def deployed(replicas: int) -> Deployment:
    """Return the deployment, as `serve deploy` would see it with another `num_replicas`."""
    reacher = deployment("served_agents:Reacher").model_dump(exclude_unset=True)
    reacher["applications"][0]["deployments"] = [{"name": "Policy", "num_replicas": replicas}]
    return Deployment(applications=reacher["applications"])


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    with shared_server(deployed(1)) as server:
        yield server


def test_sessions_move_to_a_replica_that_joins(server: Server) -> None:
    """Sessions that are pinned to a replica move on each such transport, and continue with the same
    state. Several sessions of one connection move together.

    Then the sessions that moved first end, and the remaining ones are uneven again.
    """
    agents = {
        (way, i): RemoteAgent(url(server, way), transport=way)
        for way, n in HELD.items()
        for i in range(n)
    }
    vector = RemoteAgent(url(server, "shm"), transport="shm")
    envs = vector.sessions(2)
    pids = {key: agent.reset(obs(key[1]), f"{key}")["pid"] for key, agent in agents.items()}
    vector.reset_batch([obs(i) for i in range(2)], [f"env {i}" for i in range(2)], envs)
    counts = dict.fromkeys(agents, 0)
    together = 0
    moves: Counter[tuple[str, int]] = Counter()

    def act() -> dict[object, int]:
        """Act once in each session, and return each session's replica."""
        nonlocal together
        for key, agent in agents.items():
            counts[key] += 1
            act = agent.act(obs(0, 10 * counts[key]))
            assert act.info["instruction"] == f"{key}"
            assert act.action.tolist() == [counts[key], 5 * counts[key] * (counts[key] + 1), key[1]]
            assert "resumed" not in act.info
            moves[key] += act.info["pid"] != pids[key]
            pids[key] = act.info["pid"]
        together += 1
        acts = vector.act_batch([obs(0, 1)] * len(envs), envs) if envs else []
        where = []
        for i, one in enumerate(acts):
            assert not isinstance(one, Exception), one
            assert one.action.tolist() == [together, together, i]
            assert "resumed" not in one.info
            where.append(one.info["pid"])
        assert len(set(where)) <= 1, "sessions of one connection were separated"
        return dict(pids) | {f"env {i}": pid for i, pid in enumerate(where)}

    assert len(set(act().values())) == 1
    deploy(deployed(2))

    def even() -> bool:
        held = Counter(act().values())
        return len(held) == 2 and max(held.values()) <= min(held.values()) + 2

    def become_even() -> None:
        begun = time.monotonic()
        wait_for(even, every_s=0.25)  # the sums of more acts would not fit exactly into float32
        print(f"{len(pids) + len(envs)} sessions were even after {time.monotonic() - begun:.1f} s")

    become_even()
    for env in envs:
        env.close()
    envs.clear()
    for key in [key for key in agents if key[0] != "websocket"]:
        agents.pop(key).close()
        del pids[key]
    become_even()
    assert {way for way, _ in +moves} == set(HELD)
    settled = Counter(moves)
    until = time.monotonic() + 8
    while time.monotonic() < until:
        act()
        time.sleep(0.05)
    assert sum((moves - settled).values()) <= 2, "sessions move back and forth"
    for agent in agents.values():
        agent.close()


@pytest.mark.parametrize("way", ["shm", "handle", "websocket"])
def test_new_sessions_spread_evenly(server: Server, way: TransportName) -> None:
    """Sixteen sessions begin at the same time; the previous test started two replicas."""
    agents = [RemoteAgent(url(server, way), transport=way) for _ in range(16)]
    for _ in range(4):
        with ThreadPoolExecutor(len(agents)) as pool:
            held = Counter(
                pool.map(lambda i: agents[i].reset(obs(i), f"task {i}")["pid"], range(len(agents)))
            )
        for agent in agents:
            agent.close()
        print(f"{way}: {sorted(held.values())}")
        if len(held) == 2 and min(held.values()) >= 7:
            break
        # On a busy machine, a replica that did not report its load within 0.3 s gets no session for
        # 3 s.
        time.sleep(4)
    else:
        pytest.fail(f"{way}: {held}")
