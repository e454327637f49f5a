"""Doors for other systems' clients, over an engine without Ray: what they answer, and what they never tell."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from served_agents import Mirror
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.auth import Keys
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.dialects.config import DialectArgs
from vlagents_ray.serve.dialects.door import House
from vlagents_ray.serve.dialects.routes import describe, dialect_routes, require_fit
from vlagents_ray.serve.docs import docs_page
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.files import deployment
from vlagents_ray.serve.guard import Guard
from vlagents_ray.serve.ingress import build_ingress
from vlagents_ray.serve.keyfile import new_key
from vlagents_ray.wire import openpi, openvla, vla_eval
from vlagents_ray.wire.messages import Limits

LIMITS = Limits(body_bytes=300_000, pixels=64 * 64)
METADATA = {"policy": "mirror", "version": "0", "protocol": 1, "checkpoint": None}
ALL: dict[str, Any] = {
    "openpi": {"mapping": "openpi-libero", "metadata": {"reset_pose": [0.5]}},
    "roboarena": {"mapping": "openpi-libero"},
    "openvla": {},
    "vla_eval": {"observation_params": {"send_state": True}},
}


@contextmanager
def serving(agent: Agent, dialects: dict[str, Any], **options: Any) -> Iterator[tuple[TestClient, Engine]]:
    engine = Engine(agent, **options)
    engine.start()
    routes = dialect_routes(DialectArgs(**dialects), House(engine, lambda: METADATA, LIMITS))
    with TestClient(build_ingress(engine, lambda: METADATA, LIMITS, dialects=routes)) as client:
        yield client, engine
    engine.close()


@pytest.fixture(scope="module", name="house")
def everything() -> Iterator[tuple[TestClient, Engine]]:
    with serving(Mirror(chunk=2), ALL) as house:
        yield house


def image(pixel: int) -> np.ndarray:
    return np.full((8, 8, 3), pixel, np.uint8)


def libero(pixel: int, prompt: str | None = "task 1", **more: Any) -> bytes:
    state = np.array([0, 0, 0, 0, 0, 1, 0.04, -0.04])
    both = {"observation/image": image(pixel), "observation/wrist_image": image(0)}
    return openpi.encode({**both, "observation/state": state, "prompt": prompt, **more})


def call(socket: Any, data: bytes) -> Any:
    socket.send_bytes(data)
    return openpi.decode(socket.receive_bytes())


def test_openpi_gets_metadata_then_actions_with_its_timing(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/openpi") as socket:
        assert openpi.decode(socket.receive_bytes()) == METADATA_TOLD
        first = call(socket, libero(7))
        # Its state's first part sums to 1; open is 1 in the policy and -1 in LIBERO.
        assert first["actions"].tolist() == [[7, 1, 1, 1, 0, 0, -1], [7, 1, 1, 1, 1, 0, -1]]
        assert first["policy_timing"].keys() == {"infer_ms"}
        assert first["server_timing"].keys() == {"infer_ms"}
        assert call(socket, libero(8))["server_timing"].keys() == {"infer_ms", "prev_total_ms"}


METADATA_TOLD = {"policy": "mirror", "checkpoint": None, "version": "0", "reset_pose": [0.5]}


def test_an_episode_begins_with_the_connection_and_with_each_new_prompt(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/openpi") as one, house[0].websocket_connect("/openpi") as two:
        for socket in (one, two):
            socket.receive_bytes()
        acts = [call(one, libero(1, f"task {number}"))["actions"][0, 2:4].tolist() for number in (3, 3, 4, 4, 3)]
        assert acts == [[1, 3], [2, 3], [1, 4], [2, 4], [1, 3]]
        assert call(two, libero(1, "task 9"))["actions"][0, 2:4].tolist() == [1, 9]


def test_without_a_prompt_the_one_before_holds(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/roboarena") as socket:
        socket.receive_bytes()
        call(socket, libero(1, "task 5", endpoint="infer"))
        assert call(socket, libero(1, None, endpoint="infer"))["actions"][0, 2:4].tolist() == [2, 5]
        socket.send_bytes(openpi.encode({"endpoint": "reset"}))
        socket.receive_text()
        assert call(socket, libero(1, None, endpoint="infer"))["actions"][0, 2:4].tolist() == [1, 5]


def test_a_sessions_end_is_its_connections(house: tuple[TestClient, Engine]) -> None:
    client, engine = house
    before = len(engine.sessions)
    with client.websocket_connect("/openpi") as one:
        one.receive_bytes()
        with client.websocket_connect("/openpi") as two:
            two.receive_bytes()
            for socket in (one, two):
                call(socket, libero(1))
            assert len(engine.sessions) == before + 2
        assert call(one, libero(1))["actions"][0, 2] == 2
    assert len(engine.sessions) == before


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


def test_openpi_and_roboarena_share_the_root(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/") as socket:
        config = openpi.decode(socket.receive_bytes())
        assert config.keys() == {
            *("image_resolution", "needs_wrist_camera", "n_external_cameras", "needs_stereo_camera"),
            *("needs_session_id", "action_space"),
        }
        counts = [call(socket, libero(1, **more))["actions"][0, 2] for more in ({}, {}, *[{"endpoint": "infer"}] * 2)]
        assert counts == [1, 2, 1, 2]
        socket.send_bytes(openpi.encode({"endpoint": "reset"}))
        assert socket.receive_text() == "reset successful"
        assert call(socket, libero(1, endpoint="infer"))["actions"][0, 2] == 1
        assert call(socket, libero(1, endpoint="infer", session_id="a"))["actions"][0, 2] == 2
        assert call(socket, libero(1, endpoint="infer", session_id="b"))["actions"][0, 2] == 1


def test_an_old_roboarena_client_gets_the_array_itself() -> None:
    with serving(Mirror(), {"roboarena": {"mapping": "openpi-libero", "bare": True}}) as (client, _):
        with client.websocket_connect("/") as socket:
            socket.receive_bytes()
            socket.send_bytes(libero(3, endpoint="infer"))
            data = socket.receive_bytes()
        assert openpi.decode(openpi.encode({"": 0})[:-1] + data)[""].shape == (1, 7)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\xc1", "msgpack"),
        (b"", "msgpack"),
        (openpi.encode([1]), "map"),
        (openpi.encode({"prompt": "task 1"}), "observation/image"),
        (libero(1, prompt=None), "instruction"),
        (openpi.encode({"endpoint": "kill"}), "endpoint"),
        (bytes(400_000), "300000"),
        ("text", "binary"),
        (libero(1, prompt="no number"), "request id"),
    ],
)
def test_openpis_error_is_a_text_without_traceback_then_1011(
    house: tuple[TestClient, Engine], data: bytes | str, said: str
) -> None:
    with house[0].websocket_connect("/") as socket:
        socket.receive_bytes()
        socket.send_text(data) if isinstance(data, str) else socket.send_bytes(data)
        text = socket.receive_text()
        assert said in text
        assert "request" in text
        assert "Traceback" not in text
        assert ".py" not in text
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_bytes()
        assert closed.value.code == 1011


def body(pixel: int, instruction: str = "task 1", **more: Any) -> dict[str, Any]:
    return {"image": json.loads(openvla.encode(image(pixel), twice=False)), "instruction": instruction, **more}


def test_openvla_answers_an_action_plain_and_encoded_twice(house: tuple[TestClient, Engine]) -> None:
    client, engine = house
    before = len(engine.sessions)
    plain = client.post("/act", json=body(5))
    assert plain.status_code == 200
    action, _ = openvla.decode(b'{"action": %s}' % plain.content)
    assert action["action"].tolist() == [5, 0, 1, 1, 0, 0, 0]
    twice = client.post("/act", json={"encoded": json.dumps(body(6))})
    action, _ = openvla.decode(b'{"action": %s}' % twice.json().encode())
    assert action["action"].tolist() == [6, 0, 1, 1, 0, 0, 0]
    assert len(engine.sessions) == before


def test_openvla_keeps_a_session_that_has_a_name(house: tuple[TestClient, Engine]) -> None:
    def count(instruction: str, session: str) -> float:
        answer = house[0].post("/act", json=body(5, instruction), headers={"x-session-id": session})
        return openvla.decode(b'{"action": %s}' % answer.content)[0]["action"][2]

    assert [count("task 1", "robot-a") for _ in range(3)] == [1, 2, 3]
    assert [count("task 1", "robot-b"), count("task 2", "robot-a"), count("task 1", "robot-b")] == [1, 1, 2]
    assert house[0].post("/v1/close", headers={"x-session-id": "robot-a"}).status_code == 200
    assert count("task 2", "robot-a") == 1


def test_each_key_has_openvla_sessions_of_its_own_and_pays_once_a_request(tmp_path: Path) -> None:
    keys = {name: new_key(tmp_path / "keys", name, rate=rate) for name, rate in (("a", None), ("b", None), ("slow", 1))}
    engine = Engine(Mirror())
    engine.start()
    routes = dialect_routes(DialectArgs(openvla={}), House(engine, lambda: METADATA, LIMITS))
    inside = build_ingress(engine, lambda: METADATA, LIMITS, dialects=routes)
    with TestClient(Guard(inside, Keys.from_file(tmp_path / "keys"), "app")) as client:

        def act(key: str, pixel: int, **headers: str) -> Any:
            headers["authorization"] = f"Bearer {keys[key]}"
            answer = client.post("/act", json=body(pixel), headers=headers)
            assert answer.status_code == 200, answer.text
            return openvla.decode(b'{"action": %s}' % answer.content)[0]["action"][:3].tolist()

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
        state = json.loads(openvla.encode(np.array([0, 0, 0, 0, 0, 1, 0.0, 0.0]), twice=False))
        full = {"full_image": body(9)["image"], "state": state, "instruction": "task 4"}
        rows = openvla.decode(b'{"rows": %s}' % client.post("/act", json=full).content)[0]["rows"]
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
    house: tuple[TestClient, Engine], content: bytes, status: int, said: str
) -> None:
    answer = house[0].post("/act", content=content)
    assert (answer.status_code, answer.headers["content-type"]) == (status, "application/problem+json")
    assert said in answer.json()["detail"]
    assert answer.json()["request_id"]
    assert "/no/path" not in answer.text
    assert "Traceback" not in answer.text


def say(socket: Any, kind: Any, payload: dict[str, Any], seq: int) -> None:
    socket.send_bytes(vla_eval.encode(vla_eval.Message(kind, payload, seq)))


def hear(socket: Any) -> vla_eval.Message:
    return vla_eval.decode(socket.receive_bytes())


def seen(pixel: int, task: str = "task 1") -> dict[str, Any]:
    return {"images": {"front": image(pixel)}, "task_description": task, "state": np.ones(3)}


def test_vla_eval_gets_one_row_a_step_and_a_new_chunk_after_the_last(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/vla-eval") as socket:
        assert house[0].get("/health").json() == {"status": "ok"}
        say(socket, "hello", {"protocol_version": 1}, 1)
        hello = hear(socket)
        assert (hello.kind, hello.seq, hello.payload["protocol_version"]) == ("hello", 1, 1)
        assert hello.payload["observation_params"] == {"send_state": True}
        say(socket, "episode_start", {"task": {}}, 2)
        got = []
        for seq in range(3, 7):
            say(socket, "observation", seen(seq), seq)
            answer = hear(socket)
            assert (answer.kind, answer.seq) == ("action", seq)
            got.append(answer.payload["actions"][[0, 2, 4]].tolist())
        # Two rows of a chunk each: the pixel and the count are those of the observation that was acted on.
        assert got == [[3, 1, 0], [3, 1, 1], [5, 2, 0], [5, 2, 1]]
        say(socket, "episode_start", {"task": {}}, 7)
        say(socket, "observation", seen(9), 8)
        assert hear(socket).payload["actions"][[0, 2, 4]].tolist() == [9, 1, 0]


def test_vla_evals_errors_leave_the_connection(house: tuple[TestClient, Engine]) -> None:
    with house[0].websocket_connect("/vla-eval") as socket:
        for version in (2, None, np.zeros(2)):
            say(socket, "hello", {"protocol_version": version}, 1)
            assert hear(socket).kind == "error"
        socket.send_bytes(b"junk")
        assert hear(socket).kind == "error"
        say(socket, "observation", {"images": {"front": np.zeros(3)}}, 3)
        error = hear(socket)
        assert (error.kind, error.seq) == ("error", 3)
        assert "images/front" in error.payload["error"]
        say(socket, "observation", seen(4), 4)
        assert hear(socket).kind == "action"


def test_of_observations_that_nobody_waits_for_the_newest_is_acted_on() -> None:
    begun, gate = threading.Event(), threading.Event()

    class Slow(Mirror):
        def act(self, obs: Obs) -> Act:
            begun.set()
            gate.wait(10)
            return super().act(obs)

    with serving(Slow(), {"vla_eval": {}}) as (client, _), client.websocket_connect("/") as socket:
        say(socket, "observation", seen(1), 1)
        assert begun.wait(10)
        for seq in range(2, 50):
            say(socket, "observation", seen(seq), seq)
        say(socket, "hello", {"protocol_version": 1}, 50)  # its answer says that all before it are there
        gate.set()
        assert [hear(socket).seq for _ in range(3)] == [1, 49, 50]


def test_a_client_that_sends_far_more_than_it_waits_for_is_cut_off(house: tuple[TestClient, Engine]) -> None:
    with serving(Mirror(slow_s=0.1), {"vla_eval": {}}) as (client, _), client.websocket_connect("/") as socket:
        for seq in range(100):
            say(socket, "observation", seen(1), seq)
            say(socket, "hello", {"protocol_version": 1}, seq)
        heard = [hear(socket)]
        while heard[-1].kind != "error":
            heard.append(hear(socket))
        assert "wait" in heard[-1].payload["error"]
        assert len(heard) < 100
        with pytest.raises(WebSocketDisconnect) as closed:
            hear(socket)
        assert closed.value.code == 1008


def test_a_connection_that_the_replica_has_no_room_for_is_told_to_come_later() -> None:
    with serving(Mirror(), ALL, session_limit=1) as (client, _), client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        call(socket, libero(1))
        for path in ("/openpi", "/vla-eval"):
            with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(path):
                pass
            assert (refused.value.status_code, refused.value.json()["code"]) == (503, "unavailable")


def test_a_session_that_was_forgotten_begins_again(house: tuple[TestClient, Engine]) -> None:
    client, engine = house
    with client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        call(socket, libero(1))
        for session in engine.sessions.ids():
            engine.sessions.close(session)
        assert call(socket, libero(1))["actions"][0, 2] == 1


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
        handled = [one[:4] for one in engine.stats.collect()[0]]
    assert handled == [
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
