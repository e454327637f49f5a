"""A robot whose reset contains no SLO has the SLO of its deployment, however its session was
opened.
"""

from __future__ import annotations

from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest
from in_flight import answered
from starlette.testclient import TestClient

from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.interface import SLO, Obs
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.frames import decode_replies, encode_requests
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.fleet import RobotNeed
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.slo import Slo

OF_FILE = Slo(10, age_ms=500, share=0.9, rows=4)
NEED = RobotNeed(10, 4, 0.5)


@pytest.fixture
def engine() -> Iterator[Engine]:
    engine = Engine(Noop.from_config({"chunk": 8}), EngineSettings(slo=OF_FILE))
    engine.start()
    yield engine
    engine.close()


def plan(engine: Engine) -> tuple[RobotNeed | None, float]:
    """Return the needs of the only session's robot, and its required share of ticks in time."""
    [session] = engine.sessions.all()
    return session.plan.need, session.plan.share


def test_a_reset_in_process_has_the_slo_of_the_deployment(engine: Engine) -> None:
    info = answered(engine, "arm", Request("reset", Obs())).info
    assert info[SLO] == {"load": 0.0, "in_time": True}  # no batch has been measured yet
    assert plan(engine) == (NEED, 0.9)


def test_an_slo_of_its_own_replaces_that_of_the_deployment(engine: Engine) -> None:
    answered(engine, "arm", Request("reset", Obs(), kwargs={SLO: {"hz": 5}}))
    assert plan(engine) == (RobotNeed(5, 8), 0.98)


def test_a_simulation_needs_nothing_in_time_unless_it_states_it(engine: Engine) -> None:
    info = answered(engine, "env", Request("reset", Obs(), priority="simulation")).info
    assert SLO not in info
    assert plan(engine) == (None, 0.98)
    stated = Request("reset", Obs(), kwargs={SLO: {"hz": 5}}, priority="simulation")
    assert answered(engine, "env", stated).info[SLO]["in_time"]


def test_a_reset_over_http_has_the_slo_of_the_deployment(engine: Engine) -> None:
    inside = build_http_app(engine, dict, DEFAULT_LIMITS)
    with TestClient(AccessMiddleware(inside, None, "app")) as client:
        answer = client.post("/v1/reset", json={}, headers={"x-session-id": "arm"})
        assert answer.json()["info"][SLO]["in_time"] is True
        assert plan(engine) == (NEED, 0.9)


def test_a_reset_over_a_websocket_of_the_servers_port_has_the_slo_of_the_deployment(
    engine: Engine,
) -> None:
    inside = build_http_app(engine, dict, DEFAULT_LIMITS)
    with (
        TestClient(AccessMiddleware(inside, None, "app")) as client,
        client.websocket_connect("/v1/stream") as socket,
    ):
        socket.send_bytes(encode_requests([Request("reset", Obs())]))
        [reply] = decode_replies(socket.receive_bytes())
        assert reply.info[SLO]["in_time"] is True
        assert plan(engine) == (NEED, 0.9)


def test_a_reset_over_a_websocket_of_the_replicas_port_has_the_slo_of_the_deployment(
    engine: Engine,
) -> None:
    endpoint = OwnPortServer(engine, DEFAULT_LIMITS, "127.0.0.1", None, NoKey.OPEN)
    endpoint.open()
    try:
        address = endpoint.address
        socket = Stream(urlsplit("http://127.0.0.1"), address.port, address.path, 5)
        socket.send(encode_requests([Request("reset", Obs())]), 5)
        [reply] = decode_replies(socket.recv(5))
        assert reply.info[SLO]["in_time"] is True
        assert plan(engine) == (NEED, 0.9)
        socket.close()
    finally:
        endpoint.close()


def test_the_setting_reaches_the_engine_and_the_metadata() -> None:
    args = ServerArgs(policy="noop", slo=OF_FILE.to_json())
    policy = LocalPolicy(args, {})
    assert policy.engine.settings.slo == OF_FILE
    # In the form in which Serve passes them to a replica.
    assert ServerArgs(**args.model_dump(mode="json")).slo == args.slo
    policy.initialize()
    assert policy.metadata["slo"] == OF_FILE.to_json()
    assert SLO not in policy.reset(Obs(), None), "the key's sessions must be simulations"
    policy.close()
