"""Tests of the dialects on the server's own port: all of them, then OpenVLA and vla-eval. The
recorded answers are in tests/golden.
"""

from __future__ import annotations

import contextlib
import json
import threading
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from dialect_server import (
    ALL,
    LIMITS,
    METADATA,
    body,
    call,
    client_of,
    image,
    libero,
    receive,
    seen,
    send,
    serving,
)
from in_memory_keys import ChangingKeys
from in_process_replicas import Replicas
from served_agents import Mirror
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract
from vlagents_ray.errors import ConfigError, PolicyFailed
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.access.key_store import new_key, revoke
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import ReplicaContext, dialect_routes
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.docs_page import docs_page
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray_dialects.messages import openvla as openvla_codec
from vlagents_ray_dialects.openvla import OpenVLADialect


def test_a_replica_that_stops_keeps_no_session_that_nobody_will_ask_for() -> None:
    with serving(Mirror(), ALL) as (client, engine):
        with (
            client.websocket_connect("/openpi") as pi,
            client.websocket_connect("/vla-eval") as benchmark,
        ):
            pi.receive_bytes()
            call(pi, libero(1))
            send(benchmark, "observation", seen(1), 1)
            assert receive(benchmark).kind == "action"
            engine.drain_list.drain()
            assert client.post("/act", json=body(5)).status_code == 200
            assert len(engine.sessions) == 2
        assert len(engine.sessions) == 0


def test_a_connection_that_the_replica_has_no_room_for_is_told_to_come_later() -> None:
    with (
        serving(Mirror(), ALL, session_limit=1) as (client, _),
        client.websocket_connect("/openpi") as socket,
    ):
        socket.receive_bytes()
        call(socket, libero(1))
        for path in ("/openpi", "/vla-eval", "/xpolicylab"):
            with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(path):
                pass
            assert (refused.value.status_code, refused.value.json()["code"]) == (503, "unavailable")


def test_dialects_count_in_the_statistics_by_their_names() -> None:
    with serving(Mirror(), ALL) as (client, engine):
        engine.stats.enable()
        with client.websocket_connect("/openpi") as socket:
            socket.receive_bytes()
            call(socket, libero(1))
        client.post("/act", json=body(1))
        client.post("/act", content=b"")
        with client.websocket_connect("/vla-eval") as socket:
            send(socket, "observation", seen(4), 4)
            receive(socket)
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


def test_until_the_policy_is_loaded_every_dialect_answers_503() -> None:
    context = ReplicaContext(Engine(Mirror()), lambda: METADATA, LIMITS)
    inside = build_http_app(
        context.engine, lambda: METADATA, LIMITS, more=dialect_routes(DialectArgs(**ALL), context)
    )
    with TestClient(AccessMiddleware(inside, None, "app")) as client:
        assert client.get("/health").status_code == 503
        assert client.post("/act", json=body(1)).status_code == 503
        for path in ("/", "/openpi", "/roboarena", "/vla-eval", "/xpolicylab"):
            with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(path):
                pass
            assert refused.value.status_code == 503


@pytest.mark.parametrize(
    ("settings", "want"),
    [
        ({"chunk": True, "plain": True}, [[3, 0, 1, 1, 0], [3, 0, 1, 1, 1]]),
        ({"plain": True}, [3, 0, 1, 1, 0]),
        (
            {"chunk": True, "mapping": {"preset": "openvla", "action": {"actions": {"stop": 5}}}},
            {"actions": (2, 5)},
        ),
        (
            {
                "mapping": {
                    "preset": "openvla",
                    "action": {"arm": {"stop": 6}, "hand": {"start": 6}},
                }
            },
            {"arm": (6,), "hand": (1,)},
        ),
    ],
)
def test_an_action_over_http_is_lists_or_named_columns_where_clients_read_those(
    settings: Any, want: Any
) -> None:
    with serving(Mirror(chunk=2), {"openvla": settings}) as (client, _):
        answer = client.post("/act", json=body(3))
    if isinstance(want, dict):
        value = openvla_codec.decode(answer.content)[0]
        assert {name: array.shape for name, array in value.items()} == want
    else:
        assert np.array(answer.json())[..., :5].tolist() == want


@pytest.mark.parametrize("settings", [{}, {"chunk": True}, {"plain": True}])
def test_a_request_of_openvla_without_an_instruction_is_refused(settings: Any) -> None:
    request = body(3)
    del request["instruction"]
    with serving(Mirror(chunk=2), {"openvla": settings}) as (client, _):
        answer = client.post("/act", json=request)
    assert answer.status_code == 422
    assert "instruction: expected one, as the policy needs it, got none" in answer.text


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
        ({"openpi": {"mapping": "openpi-droid"}}, "expected 8 numbers a row"),
    ],
)
def test_a_wrong_setting_is_refused_before_anything_starts(
    dialects: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        deployment("served_agents:Mirror", dialects=dialects)


def test_a_mapping_that_lacks_what_the_policy_needs_is_refused_at_the_start() -> None:
    args = DialectArgs(openvla={})  # type: ignore[arg-type]

    class Two(Agent):
        contract = Contract(
            {"front": CameraSpec(), "wrist": CameraSpec()}, action=ActionSpec(dim=7)
        )

        def act(self, obs: Obs) -> Act:
            return Act(np.zeros(7))

    with pytest.raises(ConfigError, match=r"dialects.openvla: camera 'wrist'"):
        args.require_fit(Two.contract)
    engine = Engine(Two(), EngineSettings(check=args.require_fit))
    with pytest.raises(PolicyFailed, match="wrist"):
        engine.start()


def test_what_is_on_stands_in_the_metadata_and_on_the_page() -> None:
    told = DialectArgs(**ALL).describe()
    assert told["vla_eval"]["paths"] == ["WS /vla-eval"]
    assert DialectArgs(vla_eval={}).describe()["vla_eval"]["paths"] == ["WS /", "WS /vla-eval"]  # type: ignore[arg-type]
    assert told["openvla"]["mapping"]["instruction"] == "instruction"
    page = docs_page(METADATA | {"dialects": told})
    assert "WS /, WS /openpi" in page
    assert "Clients of OpenVLA. An episode is one request" in page
    assert "<code>reset</code> or a new <code>session_id</code> begins an episode" in page
    ports = {"gr00t": {"port": 5556, "host": "10.0.0.7"}, "vlagents": {}}
    told = DialectArgs(**ports).describe()  # type: ignore[arg-type]
    assert {name: one["address"] for name, one in told.items()} == {
        "gr00t": "tcp://10.0.0.7:5556",
        "vlagents": "rpyc://127.0.0.1:8080",
    }
    assert told["gr00t"]["mapping"]["instruction"]
    assert told["vlagents"]["mapping"] is None
    assert "tcp://10.0.0.7:5556" in docs_page(METADATA | {"dialects": told})
    assert ServerArgs(policy="noop").dialects.model_dump(exclude_none=True) == {}


def test_the_settings_of_dialects_survive_the_way_to_the_replicas_and_to_the_gateway() -> None:
    args = ServerArgs(
        policy="noop", dialects=ALL | {"gr00t": {}, "vlagents": {"robots": {"arm": {"stop": 6}}}}
    )
    assert list(args.dialects.gateways()) == ["gr00t", "vlagents"]
    assert ServerArgs(**args.model_dump(mode="json")) == args
    replica = ServerArgs(
        **args.model_dump(mode="json", exclude={"dialects": set(args.dialects.gateways())})
    )
    assert list(replica.dialects.on()) == list(ALL)
    assert replica.dialects.gateways() == {}


def test_cameras_that_the_mapping_does_not_read_are_logged_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The server answered openpi's simple_client in ALOHA mode without a warning, though pi0 reads
    only three of its four cameras.
    """
    keyed = {
        "cameras": {"front": "images/front"},
        "state": {"joints": "state"},
        "instruction": "task_description",
    }
    odd = json.loads(openvla_codec.encode(image(0), twice=False))
    with serving(Mirror(), ALL | {"vla_eval": {"mapping": keyed}}) as (client, _):
        for _ in range(2):
            with client.websocket_connect("/openpi") as socket:
                socket.receive_bytes()
                for pixel in range(2):
                    call(socket, libero(pixel, images={"cam_low": image(0)}))
            assert client.post("/act", json=body(1, top=odd)).status_code == 200
            assert (
                client.post(
                    "/act", json=body(1, top=odd), headers={"x-session-id": "a"}
                ).status_code
                == 200
            )
            with client.websocket_connect("/vla-eval") as socket:
                more = seen(1)
                more["images"] |= {"side": image(0)}
                send(socket, "observation", more, 1)
                assert receive(socket).kind == "action"
    said = sorted(one for one in caplog.messages if "which the policy does not receive" in one)
    assert [one.partition(", which")[0] for one in said] == [
        "openpi: a client sends the cameras ['images/cam_low']",
        "openvla: a client sends the cameras ['top']",
        "vla_eval: a client sends the cameras ['images/side']",
    ]
    assert (
        "the mapping reads only ['observation/image', 'observation/wrist_image']; if the policy "
        "needs them"
    ) in said[0]


def test_each_key_has_openvla_sessions_of_its_own_and_pays_once_a_request() -> None:
    known = ChangingKeys()
    keys = {
        name: known.add(name, **allowed)
        for name, allowed in (("a", {}), ("b", {}), ("slow", {"rate": 1}))
    }
    with serving(Mirror(), {"openvla": {}}, known.keys) as (client, engine):

        def act(key: str, pixel: int, **headers: str) -> Any:
            headers["authorization"] = f"Bearer {keys[key]}"
            answer = client.post("/act", json=body(pixel), headers=headers)
            assert answer.status_code == 200, answer.text
            return openvla_codec.decode(b'{"action": %s}' % answer.content)[0]["action"][
                :3
            ].tolist()

        named = {"x-session-id": "robot"}
        for step in (1, 2, 3):
            assert act("a", 5, **named) == [5, 0, step]
        assert act("b", 6, **named) == [6, 0, 1]
        assert act("a", 7, **named) == [7, 0, 4]
        # A reset and an act count as one request, which is all that the rate of this key allows at
        # once.
        assert act("slow", 8) == [8, 0, 1]
        assert sorted(engine.sessions.ids()) == ["a/robot", "b/robot"]


@pytest.mark.parametrize("stops", [True, False])
def test_a_session_over_http_goes_on_at_another_replica_with_its_state(stops: bool) -> None:
    with contextlib.ExitStack() as stack:
        replicas = stack.enter_context(contextlib.closing(Replicas([Mirror(), Mirror()])))
        clients = [
            stack.enter_context(client_of(engine, {"openvla": {}})) for engine in replicas.engines
        ]

        def act(replica: int, instruction: str = "task 1") -> Any:
            answer = clients[replica].post(
                "/act", json=body(5, instruction), headers={"x-session-id": "robot"}
            )
            return openvla_codec.decode(b'{"action": %s}' % answer.content)[0]["action"][2]

        assert [act(0), act(0), act(0)] == [1, 2, 3]
        if stops:
            replicas.engines[0].drain_list.drain()
            assert replicas.hand_over(0) == 1
        assert [act(1), act(1)] == [4, 5]
        assert [act(1, "task 2"), act(1, "task 2")] == [1, 2]
        if not stops:
            assert act(0, "task 2") == 3


def test_a_new_key_of_a_revoked_ones_name_goes_on_with_its_sessions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray.serve.access.api_keys._CHECK_S", 0.0)
    file = tmp_path / "keys"
    old = new_key(file, "arm")
    with serving(Mirror(), {"openvla": {}}, Keys.from_file(file)) as (client, _):

        def act(key: str) -> int:
            headers = {"authorization": f"Bearer {key}", "x-session-id": "robot-1"}
            return client.post("/act", json=body(5), headers=headers).status_code

        assert act(old) == 200
        revoke(file, "arm")
        new = new_key(file, "arm")
        assert (act(old), act(new)) == (401, 200)


def test_a_hello_of_another_version_is_refused_and_the_connection_stays(
    context: tuple[TestClient, Engine],
) -> None:
    assert context[0].get("/health").json() == {"status": "ok"}
    with context[0].websocket_connect("/vla-eval") as socket:
        for version, kind in ((None, "error"), (np.zeros(2), "error"), (1, "hello")):
            send(socket, "hello", {"protocol_version": version}, 1)
            assert receive(socket).kind == kind


def test_of_observations_that_nobody_waits_for_the_newest_is_acted_on() -> None:
    begun, gate = threading.Event(), threading.Event()

    class Slow(Mirror):
        def act(self, obs: Obs) -> Act:
            begun.set()
            gate.wait(10)
            return super().act(obs)

    with serving(Slow(), {"vla_eval": {}}) as (client, _), client.websocket_connect("/") as socket:
        send(socket, "observation", seen(1), 1)
        assert begun.wait(10)
        for seq in range(2, 50):
            send(socket, "observation", seen(seq), seq)
        # The answer to this message shows that all earlier messages have arrived.
        send(socket, "hello", {"protocol_version": 1}, 50)
        gate.set()
        assert [receive(socket).seq for _ in range(3)] == [1, 49, 50]


def test_observations_between_two_chunks_need_no_images() -> None:
    """A benchmark renders only every third observation, since it executes the other rows of a chunk
    without observing.
    """
    rendered = {name: value for name, value in seen(3).items() if name != "state"} | {
        "joint_state": np.ones(3)
    }
    bare = {"task_description": "task 1"}
    with (
        serving(Mirror(chunk=3), {"vla_eval": {}}) as (client, _),
        client.websocket_connect("/vla-eval") as socket,
    ):

        def answer(payload: dict[str, Any], seq: int) -> Any:
            send(socket, "observation", payload, seq)
            return receive(socket)

        rows = [answer(rendered if seq % 3 == 0 else bare, seq) for seq in range(6)]
        assert [message.kind for message in rows] == ["action"] * 6
        assert [float(message.payload["actions"][4]) for message in rows] == [0, 1, 2, 0, 1, 2]
        # When a chunk ends or another task begins, an observation without images is an error again.
        assert answer(bare, 6).kind == "error"
        assert answer(rendered, 7).kind == "action"
        assert answer({"task_description": "task 2"}, 8).kind == "error"


def test_a_client_that_sends_far_more_than_it_waits_for_is_cut_off() -> None:
    with (
        serving(Mirror(slow_s=0.1), {"vla_eval": {}}) as (client, _),
        client.websocket_connect("/") as socket,
    ):
        for seq in range(100):
            send(socket, "observation", seen(1), seq)
            send(socket, "hello", {"protocol_version": 1}, seq)
        received = [receive(socket)]
        while received[-1].kind != "error":
            received.append(receive(socket))
        assert "wait" in received[-1].payload["error"]
        assert len(received) < 100
        with pytest.raises(WebSocketDisconnect) as closed:
            receive(socket)
        assert closed.value.code == 1008


class WithReset(OpenVLADialect):
    """A protocol over HTTP that has a reset."""

    paths: ClassVar[Mapping[str, str]] = {**OpenVLADialect.paths, "POST /reset": "end_episode"}


def test_a_reset_over_http_begins_an_episode_of_the_session_that_it_names() -> None:
    with serving(Mirror(), {f"{__name__}:WithReset": {}}) as (client, _):

        def count(session: str) -> float:
            answer = client.post("/act", json=body(5), headers={"x-session-id": session})
            return float(openvla_codec.decode(b'{"action": %s}' % answer.content)[0]["action"][2])

        assert client.post("/reset", headers={"x-session-id": "a"}).status_code == 200
        assert [count("a"), count("a"), count("b")] == [1, 2, 1]
        answer = client.post("/reset", headers={"x-session-id": "a"})
        assert (answer.status_code, answer.json()) == (200, {})
        assert [count("a"), count("b")] == [1, 2]
        assert client.post("/reset").json()["code"] == "malformed"


# The specifications that vla-eval compares with those of its benchmark

POSE = ActionSpec(space="ee_pose", delta=True, rotation="axis_angle")
SPECS: dict[str, tuple[Contract, dict[str, Any], dict[str, str]]] = {
    "relative": (Contract(action=POSE), {}, {"position": "delta_xyz", "rotation": "axis_angle"}),
    "absolute": (
        Contract(action=replace(POSE, delta=False, rotation="quat_xyzw")),
        {},
        {"position": "absolute_xyz", "rotation": "quaternion_xyzw"},
    ),
    "not declared": (Contract(action=replace(POSE, delta=None, rotation=None)), {}, {}),
    "joints": (Contract(action=replace(POSE, space="joint")), {}, {}),
    "two arms": (Contract(action=replace(POSE, arms=("left", "right"))), {}, {}),
    "the contract's gripper": (
        Contract(action=replace(POSE, gripper_open=-1.0, gripper_closed=1.0)),
        {},
        {
            "position": "delta_xyz",
            "rotation": "axis_angle",
            "gripper": "binary_close_positive",
        },
    ),
    "the client's gripper": (
        Contract(action=replace(POSE, gripper_open=-1.0, gripper_closed=1.0)),
        {"mapping": {"preset": "vla-eval", "action_gripper": {"index": 6, "open": 1, "closed": 0}}},
        {"position": "delta_xyz", "rotation": "axis_angle", "gripper": "continuous_01"},
    ),
    "inputs": (
        Contract(cameras={"front": CameraSpec()}, instruction=True),
        {},
        {"image": "rgb_hwc_uint8", "language": "language"},
    ),
}


@pytest.mark.parametrize(("contract", "settings", "expected"), SPECS.values(), ids=SPECS)
def test_vla_eval_is_told_what_the_contract_declares(
    contract: Contract, settings: dict[str, Any], expected: dict[str, str]
) -> None:
    class Declared(Mirror):
        pass

    Declared.contract = contract
    with (
        serving(Declared(), {"vla_eval": settings}) as (client, _),
        client.websocket_connect("/vla-eval") as socket,
    ):
        send(socket, "hello", {"protocol_version": 1}, 0)
        payload = receive(socket).payload
    specs = payload.get("action_spec", {}) | payload.get("observation_spec", {})
    assert {name: spec["format"] for name, spec in specs.items()} == expected
    assert all(spec["name"] == name for name, spec in specs.items())
