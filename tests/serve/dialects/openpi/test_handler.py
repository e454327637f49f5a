"""openpi's and RoboArena's clients: what they are answered, and what they are never told."""

from __future__ import annotations

import contextlib

import pytest
from asgi_server import served
from dialect_server import METADATA, call, libero, serving
from served_agents import Mirror
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from vlagents_ray.protocol.messages import STREAM_BYTES, Limits
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import ReplicaContext
from vlagents_ray.serve.dialects.routes import dialect_routes
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.wire import openpi as openpi_codec


def test_an_episode_begins_with_the_connection_and_with_each_new_prompt(context: tuple[TestClient, Engine]) -> None:
    with context[0].websocket_connect("/openpi") as one, context[0].websocket_connect("/openpi") as two:
        for socket in (one, two):
            socket.receive_bytes()
        acts = [call(one, libero(1, f"task {number}"))["actions"][0, 2:4].tolist() for number in (3, 3, 4, 4, 3)]
        assert acts == [[1, 3], [2, 3], [1, 4], [2, 4], [1, 3]]
        assert call(two, libero(1, "task 9"))["actions"][0, 2:4].tolist() == [1, 9]


def test_without_a_prompt_the_one_before_holds(context: tuple[TestClient, Engine]) -> None:
    with context[0].websocket_connect("/roboarena") as socket:
        socket.receive_bytes()
        call(socket, libero(1, "task 5", endpoint="infer"))
        assert call(socket, libero(1, None, endpoint="infer"))["actions"][0, 2:4].tolist() == [2, 5]
        socket.send_bytes(openpi_codec.encode({"endpoint": "reset"}))
        socket.receive_text()
        assert call(socket, libero(1, None, endpoint="infer"))["actions"][0, 2:4].tolist() == [1, 5]


def test_a_sessions_end_is_its_connections(context: tuple[TestClient, Engine]) -> None:
    client, engine = context
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


def test_openpi_and_roboarena_share_the_root(context: tuple[TestClient, Engine]) -> None:
    with context[0].websocket_connect("/") as socket:
        config = openpi_codec.decode(socket.receive_bytes())
        assert config.keys() == {
            *("image_resolution", "needs_wrist_camera", "n_external_cameras", "needs_stereo_camera"),
            *("needs_session_id", "action_space"),
        }
        counts = [call(socket, libero(1, **more))["actions"][0, 2] for more in ({}, {}, *[{"endpoint": "infer"}] * 2)]
        assert counts == [1, 2, 1, 2]
        socket.send_bytes(openpi_codec.encode({"endpoint": "reset"}))
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
        assert openpi_codec.decode(openpi_codec.encode({"": 0})[:-1] + data)[""].shape == (1, 7)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"\xc1", "msgpack"),
        (b"", "msgpack"),
        (openpi_codec.encode([1]), "map"),
        (openpi_codec.encode({"prompt": "task 1"}), "observation/image"),
        (libero(1, prompt=None), "instruction"),
        (openpi_codec.encode({"endpoint": "kill"}), "endpoint"),
        (bytes(400_000), "300000"),
        ("text", "binary"),
        (libero(1, prompt="no number"), "request id"),
    ],
)
def test_openpis_error_is_a_text_without_traceback_then_1011(
    context: tuple[TestClient, Engine], data: bytes | str, said: str
) -> None:
    with context[0].websocket_connect("/") as socket:
        socket.receive_bytes()
        socket.send_text(data) if isinstance(data, str) else socket.send_bytes(data)
        text = socket.receive_text()
        assert said in text
        assert "request" in text
        assert "Traceback" not in text
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_bytes()
        assert closed.value.code == 1011


def test_a_session_that_was_forgotten_begins_again(context: tuple[TestClient, Engine]) -> None:
    client, engine = context
    with client.websocket_connect("/openpi") as socket:
        socket.receive_bytes()
        call(socket, libero(1))
        for session in engine.sessions.ids():
            engine.sessions.close(session)
        assert call(socket, libero(1))["actions"][0, 2] == 1


def test_the_largest_message_is_what_uvicorn_takes() -> None:
    """Ray Serve leaves no setting for it; docs/other_clients.md says so."""
    engine = Engine(Mirror())
    engine.start()
    limits = Limits()
    assert limits.body_bytes > STREAM_BYTES
    args = DialectArgs(openpi={"mapping": "openpi-libero"})  # type: ignore[arg-type]
    routes = dialect_routes(args, ReplicaContext(engine, lambda: METADATA, limits))
    app = AccessMiddleware(build_http_app(engine, lambda: METADATA, limits, dialects=routes), None, "app")
    with served(app) as port, connect(f"ws://127.0.0.1:{port}/openpi", max_size=None) as socket:
        socket.recv()
        socket.send(libero(4, more=bytes(STREAM_BYTES - 2000)))
        assert openpi_codec.decode(socket.recv())["actions"].shape == (1, 7)
        with contextlib.suppress(ConnectionClosed):  # it need not take all of it
            socket.send(libero(4, more=bytes(STREAM_BYTES)))
        with pytest.raises(ConnectionClosed) as closed:
            socket.recv()
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1009
    engine.close()
