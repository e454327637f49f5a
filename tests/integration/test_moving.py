"""Sessions outlive their replica: they move when it stops, and begin again when it is killed."""

from __future__ import annotations

import http.client
import json
import os
import signal
import threading
from collections.abc import Iterator
from urllib.parse import urlsplit

import numpy as np
import pytest
from eval_fakes import wait_for
from shared_ray import shared_server

from tests.integration.conftest import deploy, states
from tests.integration.test_sessions import TRANSPORTS, obs, url
from vlagents_ray import RemoteAgent
from vlagents_ray.images.jpeg_png import encode_jpeg
from vlagents_ray.serve.launch.deployment_file import Deployment, deployment
from vlagents_ray.serve.launch.server import Server


def deployed(replicas: int) -> Deployment:
    """Return a deployment with two policies, the first with `replicas` replicas, as `serve deploy`
    would see it with another `num_replicas`.
    """
    reacher = deployment("served_agents:Reacher", replicas=3).model_dump(exclude_unset=True)
    remembering = deployment("served_agents:Remembering", replicas=2).model_dump(exclude_unset=True)
    reacher["applications"][0]["deployments"] = [{"name": "Policy", "num_replicas": replicas}]
    remembering["applications"][0]["route_prefix"] = "/remembering"
    return Deployment(applications=reacher["applications"] + remembering["applications"])


@pytest.fixture(scope="module")
def server(shared_ray: None) -> Iterator[Server]:
    with shared_server(deployed(3)) as server:
        yield server


def scale(replicas: int) -> None:
    deploy(deployed(replicas))
    wait_for(lambda: states("Reacher").get("RUNNING") == replicas)


def test_sessions_go_on_when_replicas_stop(server: Server) -> None:
    """Three replicas become one under busy and idle sessions, on every transport, and all sessions
    keep their state.
    """
    scale(3)
    busy = {(t, i): RemoteAgent(url(server, t), transport=t) for t in TRANSPORTS for i in range(3)}
    idle = {
        (t, i): RemoteAgent(url(server, t), transport=t) for t in TRANSPORTS for i in range(3, 6)
    }
    agents = busy | idle
    counts = dict.fromkeys(agents, 0)
    pids: dict[tuple[str, int], int] = {}

    def spread() -> bool:
        """Return whether all replicas have sessions. A replica that does not report its load at
        once gets no session for a while.
        """
        for key, agent in agents.items():
            agent.close()
            pids[key] = agent.reset(obs(key[1]), f"{key}")["pid"]
        return len(set(pids.values())) == 3

    wait_for(spread)

    def act(key: tuple[str, int]) -> None:
        counts[key] += 1
        act = agents[key].act(obs(0, 10 * counts[key]))
        assert act.info["instruction"] == f"{key}"
        assert act.action.tolist() == [counts[key], 5 * counts[key] * (counts[key] + 1), key[1]]
        assert "resumed" not in act.info, "the session began again instead of moving"
        pids[key] = act.info["pid"]

    for _ in range(20):
        for key in agents:
            act(key)
    scaling = threading.Thread(target=scale, args=(1,))
    scaling.start()
    while scaling.is_alive() or states("Reacher") != {"RUNNING": 1}:
        for key in busy:
            act(key)
    scaling.join()
    for _ in range(5):
        for key in agents:
            act(key)
    assert len(set(pids.values())) == 1
    for agent in agents.values():
        agent.close()


def test_any_http_client_keeps_its_session_when_its_replica_stops(server: Server) -> None:
    """The client needs no code for moves: the session's id is enough."""
    scale(3)
    names = [f"curl-{i}" for i in range(9)]
    image = encode_jpeg(np.zeros((8, 8, 3), np.uint8))

    def post(op: str, name: str, document: dict) -> dict:
        connection = http.client.HTTPConnection(urlsplit(server.url).netloc, timeout=30)
        headers = {"content-type": "multipart/form-data; boundary=b", "x-session-id": name}
        head = b"--b\r\ncontent-disposition: form-data; name="
        camera = head + b"cameras.front; filename=f.jpg\r\n\r\n" + image
        text = head + b"obs\r\n\r\n" + json.dumps(document).encode()
        connection.request("POST", f"/v1/{op}", text + b"\r\n" + camera + b"\r\n--b--\r\n", headers)
        answer = connection.getresponse()
        body = answer.read()
        connection.close()
        assert answer.status == 200, body
        return dict(json.loads(body))

    def replicas() -> int:
        return len({post("reset", name, {"instruction": name})["info"]["pid"] for name in names})

    # The load balancer is updated some time after a new replica has started.
    wait_for(lambda: replicas() > 1)
    for value in range(3):
        for name in names:
            assert post("act", name, {"info": {"value": value}})["action"][0] == value + 1
    scale(1)
    for name in names:
        answer = post("act", name, {"info": {"value": 0}})
        assert (answer["action"][:2], answer["info"]["instruction"]) == ([4, 3], name)


def test_what_a_policy_remembers_is_shown_to_it_again(server: Server) -> None:
    with RemoteAgent(server.apps["Remembering"]) as agent:
        pid = agent.reset(obs(0, 1), "put the cup down", seed=7)["pid"]
        for value in (2, 3, 4):
            assert agent.act(obs(0, value)).info["pid"] == pid
        os.kill(pid, signal.SIGKILL)
        act = agent.act(obs(0, 5))
        assert act.info["resumed"]
        assert act.info["pid"] != pid
        assert act.action.tolist() == [3, 4, 5]
        assert (act.info["instruction"], act.info["seed"]) == ("put the cup down", 7)


def test_sessions_of_one_connection_act_in_one_message(server: Server) -> None:
    for transport in TRANSPORTS:
        with RemoteAgent(url(server, transport), transport=transport) as agent:
            envs = agent.sessions(8)
            infos = agent.reset_batch(
                [obs(i) for i in range(8)], [f"task {i}" for i in range(8)], envs
            )
            assert len({info["pid"] for info in infos if isinstance(info, dict)}) == 1
            for step in range(1, 4):
                acts = agent.act_batch([obs(0, i) for i in range(8)], envs)
                for i, act in enumerate(acts):
                    assert not isinstance(act, Exception)
                    assert act.action.tolist() == [step, step * i, i]
                    assert act.info["instruction"] == f"task {i}"
            envs[3].close()
            acts = agent.act_batch([obs(0, i) for i in (2, 4)], [envs[2], envs[4]])
            assert [act.action[0] for act in acts if not isinstance(act, Exception)] == [4, 4]
            for env in envs:
                env.close()
