"""What holds for the doors of all dialects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from dialect_house import ALL, LIMITS, METADATA, body, call, hear, libero, say, seen, serving
from served_agents import Mirror
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.dialects.config import DialectArgs
from vlagents_ray.serve.dialects.door import House
from vlagents_ray.serve.dialects.routes import describe, dialect_routes, require_fit
from vlagents_ray.serve.docs import docs_page
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.files import deployment
from vlagents_ray.serve.ingress import build_ingress


def test_a_replica_that_stops_keeps_no_session_that_nobody_will_ask_for() -> None:
    with serving(Mirror(), ALL) as (client, engine):
        with client.websocket_connect("/openpi") as pi, client.websocket_connect("/vla-eval") as benchmark:
            pi.receive_bytes()
            call(pi, libero(1))
            say(benchmark, "observation", seen(1), 1)
            assert hear(benchmark).kind == "action"
            engine.draining = True
            assert client.post("/act", json=body(5)).status_code == 200
            assert len(engine.sessions) == 2
        assert len(engine.sessions) == 0


def test_a_connection_that_the_replica_has_no_room_for_is_told_to_come_later() -> None:
    with serving(Mirror(), ALL, session_limit=1) as (client, _), client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        call(socket, libero(1))
        for path in ("/openpi", "/vla-eval"):
            with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(path):
                pass
            assert (refused.value.status_code, refused.value.json()["code"]) == (503, "unavailable")


def test_dialects_count_in_the_statistics_by_their_names() -> None:
    with serving(Mirror(), ALL) as (client, engine):
        engine.stats.keep()
        with client.websocket_connect("/openpi") as socket:
            socket.receive_bytes()
            call(socket, libero(1))
        client.post("/act", json=body(1))
        client.post("/act", content=b"")
        with client.websocket_connect("/vla-eval") as socket:
            say(socket, "observation", seen(4), 4)
            hear(socket)
        handled = engine.stats.collect().requests
    assert list(handled) == [
        ("reset", "openpi", "robot", "ok"),
        ("act", "openpi", "robot", "ok"),
        ("reset", "openvla", "robot", "ok"),
        ("act", "openvla", "robot", "ok"),
        ("act", "openvla", "robot", "malformed"),
        ("reset", "vla_eval", "simulation", "ok"),
        ("act", "vla_eval", "simulation", "ok"),
    ]


def test_until_the_policy_is_loaded_every_door_says_503() -> None:
    house = House(Engine(Mirror()), lambda: METADATA, LIMITS)
    door = build_ingress(house.engine, lambda: METADATA, LIMITS, dialects=dialect_routes(DialectArgs(**ALL), house))
    with TestClient(door) as client:
        assert client.get("/health").status_code == 503
        assert client.post("/act", json=body(1)).status_code == 503
        for path in ("/", "/openpi", "/roboarena", "/vla-eval"):
            with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(path):
                pass
            assert refused.value.status_code == 503


def test_a_dialect_that_is_off_is_not_there() -> None:
    with serving(Mirror(), {"openvla": {}}) as (client, _):
        for path in ("/", "/openpi", "/vla-eval"):
            with pytest.raises(WebSocketDisconnect), client.websocket_connect(path):
                pass
        assert client.get("/health").status_code == 404
        assert client.get("/act").status_code == 405


@pytest.mark.parametrize(
    ("dialects", "said"),
    [
        ({"openpi": {"mapping": "libero"}}, "openpi-droid"),
        ({"openpi": {}}, "mapping"),
        ({"open_pi": {}}, "open_pi"),
        ({"openvla": {"mapping": {"camera": {}}}}, "cameras"),
        ({"roboarena": {"n_external_cameras": 3}}, "n_external_cameras"),
        ({"openpi": {"mapping": "openpi-droid"}}, "mapping wants 8"),
    ],
)
def test_a_wrong_setting_is_refused_before_anything_starts(dialects: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        deployment("served_agents:Mirror", dialects=dialects)


def test_a_mapping_that_lacks_what_the_policy_needs_is_refused_at_the_start() -> None:
    args = DialectArgs(openvla={})  # type: ignore[arg-type]

    class Two(Agent):
        contract = Contract({"front": CameraSpec(), "wrist": CameraSpec()}, action=ActionSpec(dim=7))

        def act(self, obs: Obs) -> Act:
            return Act(np.zeros(7))

    with pytest.raises(ConfigError, match=r"dialects.openvla: camera 'wrist'"):
        require_fit(args, Two.contract)
    engine = Engine(Two(), check=lambda contract: require_fit(args, contract))
    with pytest.raises(PolicyFailed, match="wrist"):
        engine.start()


def test_what_is_on_stands_in_the_metadata_and_on_the_page() -> None:
    told = describe(DialectArgs(**ALL))
    assert told["vla_eval"]["paths"] == ["WS /vla-eval"]
    assert describe(DialectArgs(vla_eval={}))["vla_eval"]["paths"] == ["WS /", "WS /vla-eval"]  # type: ignore[arg-type]
    assert told["openvla"]["mapping"]["instruction"] == "instruction"
    page = docs_page(METADATA | {"dialects": told})
    assert "WS /, WS /openpi" in page
    assert "Clients of OpenVLA" in page
    assert ServerArgs(policy="noop").dialects.model_dump(exclude_none=True) == {}
