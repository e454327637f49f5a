"""OpenVLA's clients: what they are answered, and what they are never told."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dialect_server import LIMITS, METADATA, body, serving
from served_agents import Mirror
from starlette.testclient import TestClient

from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.access.key_store import new_key, revoke
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import ReplicaContext
from vlagents_ray.serve.dialects.routes import dialect_routes
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.wire import openvla as openvla_codec


def test_openvla_answers_an_action_plain_and_encoded_twice(context: tuple[TestClient, Engine]) -> None:
    client, engine = context
    before = len(engine.sessions)
    plain = client.post("/act", json=body(5))
    assert plain.status_code == 200
    action, _ = openvla_codec.decode(b'{"action": %s}' % plain.content)
    assert action["action"].tolist() == [5, 0, 1, 1, 0, 0, 0]
    twice = client.post("/act", json={"encoded": json.dumps(body(6))})
    action, _ = openvla_codec.decode(b'{"action": %s}' % twice.json().encode())
    assert action["action"].tolist() == [6, 0, 1, 1, 0, 0, 0]
    assert len(engine.sessions) == before


def test_openvla_keeps_a_session_that_has_a_name(context: tuple[TestClient, Engine]) -> None:
    def count(instruction: str, session: str) -> float:
        answer = context[0].post("/act", json=body(5, instruction), headers={"x-session-id": session})
        return openvla_codec.decode(b'{"action": %s}' % answer.content)[0]["action"][2]

    assert [count("task 1", "robot-a") for _ in range(3)] == [1, 2, 3]
    assert [count("task 1", "robot-b"), count("task 2", "robot-a"), count("task 1", "robot-b")] == [1, 1, 2]
    assert context[0].post("/v1/close", headers={"x-session-id": "robot-a"}).status_code == 200
    assert count("task 2", "robot-a") == 1


def test_each_key_has_openvla_sessions_of_its_own_and_pays_once_a_request(tmp_path: Path) -> None:
    keys = {name: new_key(tmp_path / "keys", name, rate=rate) for name, rate in (("a", None), ("b", None), ("slow", 1))}
    engine = Engine(Mirror())
    engine.start()
    routes = dialect_routes(DialectArgs(openvla={}), ReplicaContext(engine, lambda: METADATA, LIMITS))
    inside = build_http_app(engine, lambda: METADATA, LIMITS, dialects=routes)
    with TestClient(AccessMiddleware(inside, Keys.from_file(tmp_path / "keys"), "app")) as client:

        def act(key: str, pixel: int, **headers: str) -> Any:
            headers["authorization"] = f"Bearer {keys[key]}"
            answer = client.post("/act", json=body(pixel), headers=headers)
            assert answer.status_code == 200, answer.text
            return openvla_codec.decode(b'{"action": %s}' % answer.content)[0]["action"][:3].tolist()

        named = {"x-session-id": "robot"}
        for step in (1, 2, 3):
            assert act("a", 5, **named) == [5, 0, step]
        assert act("b", 6, **named) == [6, 0, 1]
        assert act("a", 7, **named) == [7, 0, 4]
        assert act("slow", 8) == [8, 0, 1]  # a reset and an act, of the one request that its rate holds
        assert sorted(engine.sessions.ids()) == ["a/robot", "b/robot"]
    engine.close()


def test_oft_clients_get_all_rows_of_a_chunk() -> None:
    with serving(Mirror(chunk=3), {"openvla": {"mapping": "openvla-oft", "chunk": True}}) as (client, _):
        state = json.loads(openvla_codec.encode(np.array([0, 0, 0, 0, 0, 1, 0.0, 0.0]), twice=False))
        full = {"full_image": body(9)["image"], "state": state, "instruction": "task 4"}
        rows = openvla_codec.decode(b'{"rows": %s}' % client.post("/act", json=full).content)[0]["rows"]
        assert [row.tolist() for row in rows] == [[9, 1, 1, 4, i, 0, 0] for i in range(3)]  # closed


@pytest.mark.parametrize(
    ("content", "status", "said"),
    [
        (b"", 400, "JSON"),
        (b"[1]", 400, "object"),
        (b"[" * 9000, 400, "JSON"),
        (b"{" + b'"a":[],' * 9000 + b'"b":1}', 413, "values"),
        (json.dumps({"encoded": {}}).encode(), 400, "encoded"),
        (json.dumps(body(1) | {"image": [1, 2]}).encode(), 422, "image"),
        (json.dumps({"instruction": "task 1"}).encode(), 422, "'image'"),
        (json.dumps(body(1, instruction=3)).encode(), 422, "instruction"),  # type: ignore[arg-type]
        (json.dumps({"image": body(1)["image"]}).encode(), 422, "instruction"),
        (json.dumps(body(1) | {"unnorm_key": "broken"}).encode(), 500, "RuntimeError"),
        (bytes(400_000), 413, "limit"),
    ],
)
def test_openvlas_errors_have_their_status(
    context: tuple[TestClient, Engine], content: bytes, status: int, said: str
) -> None:
    answer = context[0].post("/act", content=content)
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")
    assert said in answer.json()["detail"]
    assert answer.json()["request_id"]
    assert "/no/path" not in answer.text
    assert "Traceback" not in answer.text


def test_a_new_key_of_a_revoked_ones_name_goes_on_with_its_sessions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray.serve.access.api_keys._CHECK_S", 0.0)
    file = tmp_path / "keys"
    engine = Engine(Mirror())
    engine.start()
    routes = dialect_routes(DialectArgs(openvla={}), ReplicaContext(engine, lambda: METADATA, LIMITS))
    inside = build_http_app(engine, lambda: METADATA, LIMITS, dialects=routes)
    old = new_key(file, "arm")
    with TestClient(AccessMiddleware(inside, Keys.from_file(file), "app")) as client:

        def act(key: str) -> int:
            headers = {"authorization": f"Bearer {key}", "x-session-id": "robot-1"}
            return client.post("/act", json=body(5), headers=headers).status_code

        assert act(old) == 200
        revoke(file, "arm")
        new = new_key(file, "arm")
        assert (act(old), act(new)) == (401, 200)
    engine.close()
