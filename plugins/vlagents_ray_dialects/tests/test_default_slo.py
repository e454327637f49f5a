"""Robots of other systems send no SLO: each of their sessions has the SLO of the deployment."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from dialect_server import ALL, body, call, libero, receive, seen, send, serving
from gr00t_client import PolicyClient
from in_process_replicas import Replicas
from served_agents import Mirror, Witness

from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.slo import Slo

OF_FILE = Slo(10, age_ms=500, share=0.9)


@pytest.fixture(name="replicas")
def one_replica_with_an_slo() -> Iterator[Replicas]:
    replicas = Replicas([Witness()], slo=OF_FILE)
    yield replicas
    replicas.close()


def plans(engine: Engine) -> list[tuple[float, float | None, float] | None]:
    """Return the rate, the maximum age and the share of each session's robot; None for a session
    without an SLO.
    """
    needs = [(session.plan.need, session.plan.share) for session in engine.sessions.all()]
    return [None if need is None else (need.hz, need.age_s, share) for need, share in needs]


def test_sessions_of_websockets_and_http_have_the_slo_of_the_deployment() -> None:
    with serving(Mirror(chunk=2), ALL, slo=OF_FILE) as (client, engine):
        with client.websocket_connect("/openpi") as socket:
            socket.receive_bytes()
            call(socket, libero(1))
            assert plans(engine) == [(10, 0.5, 0.9)]
        answer = client.post("/act", json=body(1), headers={"x-session-id": "arm"})
        assert answer.status_code == 200
        assert plans(engine) == [(10, 0.5, 0.9)]


def test_sessions_of_a_benchmark_need_nothing_in_time() -> None:
    with (
        serving(Mirror(chunk=2), ALL, slo=OF_FILE) as (client, engine),
        client.websocket_connect("/vla-eval") as socket,
    ):
        send(socket, "observation", seen(1), 1)
        assert receive(socket).kind == "action"
        assert plans(engine) == [None]


def test_sessions_of_a_gateway_have_the_slo_of_the_deployment(open_dialect, replicas) -> None:
    observation = {
        "video": {"ego": np.zeros((1, 1, 4, 6, 3), np.uint8)},
        "state": {"arm": np.zeros((1, 1, 2), np.float32)},
        "language": {"task": [["go"]]},
    }
    with PolicyClient(open_dialect("gr00t")) as client:
        client.get_action(observation)
        [engine] = replicas.engines
        assert plans(engine) == [(10, 0.5, 0.9)]
