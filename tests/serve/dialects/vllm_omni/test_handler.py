"""vLLM-Omni's clients: the protocol of its `/v1/realtime/robot/openpi`, as its own tests' clients speak it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
from dialect_server import image, libero, serving
from served_agents import Mirror
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.launch.deployment_file import deployment
from vlagents_ray.wire import openpi

PATH = "/v1/realtime/robot/openpi"


class Resets(list[dict[str, object]]):
    """The arguments of the resets of all sessions."""


class Seeded(Mirror):
    """Notes the arguments of its resets."""

    def __init__(self) -> None:
        super().__init__()
        self.resets = Resets()

    def shared_objects(self) -> list[object]:
        return [self.resets]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict:
        self.resets.append(kwargs)
        return super().reset(obs, instruction, **kwargs)


def settings(**more: Any) -> dict[str, Any]:
    return {"vllm_omni": {"mapping": "openpi-libero", **more}}


@pytest.fixture(scope="module", name="robots")
def robots_server() -> Iterator[tuple[TestClient, Engine, list[dict[str, object]]]]:
    agent = Seeded()
    with serving(agent, settings(image_resolution=[180, 320], metadata={"action_horizon": 24})) as (client, engine):
        yield client, engine, agent.resets


def ask(socket: Any, data: bytes) -> Any:
    """What is answered, as openpi-client's `unpackb` reads it."""
    socket.send_bytes(data)
    return unpack(socket.receive_bytes())


def unpack(data: bytes) -> Any:
    def array(node: dict[Any, Any]) -> Any:
        if b"__ndarray__" not in node:
            return node
        return np.ndarray(buffer=node[b"data"], dtype=np.dtype(node[b"dtype"]), shape=node[b"shape"])

    return msgpack.unpackb(data, object_hook=array)


def test_the_first_message_is_the_configuration_and_an_action_the_array_itself(robots: Any) -> None:
    with robots[0].websocket_connect(PATH) as socket:
        assert unpack(socket.receive_bytes()) == {
            "image_resolution": [180, 320],
            "needs_wrist_camera": True,
            "n_external_cameras": 1,
            "needs_stereo_camera": False,
            "needs_session_id": False,
            "action_space": "joint_position",
            "action_horizon": 24,
        }
        rows = ask(socket, libero(7, endpoint="infer", session_id="a"))
        assert (rows.dtype, rows.tolist()) == (np.float32, [[7, 1, 1, 1, 0, 0, -1]])
        assert ask(socket, libero(7))[0, 2] == 2  # without an endpoint or a session, it is the same


def test_a_reset_and_another_session_id_begin_an_episode(robots: Any) -> None:
    with robots[0].websocket_connect(PATH) as socket:
        socket.receive_bytes()
        acts = [ask(socket, libero(1, session_id=name))[0, 2] for name in ("a", "a", "b", "b", "a")]
        assert acts == [1, 2, 1, 2, 1]
        assert ask(socket, openpi.encode({"endpoint": "reset"})) == {"status": "reset successful"}
        assert ask(socket, libero(1, session_id="a"))[0, 2] == 1


def test_a_seed_is_that_of_the_episode_which_its_observation_begins(robots: Any) -> None:
    client, _, resets = robots
    with client.websocket_connect(PATH) as socket:
        socket.receive_bytes()
        resets.clear()
        for name, seed in (("a", 3), ("a", 4), ("b", None), ("c", np.int64(5))):
            ask(socket, libero(1, session_id=name, seed=seed))
        assert resets == [{"seed": 3}, {}, {"seed": 5}]


def test_an_error_is_a_map_and_the_connection_stays_open(robots: Any) -> None:
    with robots[0].websocket_connect(PATH) as socket:
        socket.receive_bytes()
        for data, said in (
            (b"\xc1", "msgpack"),
            (openpi.encode([1]), "map"),
            (openpi.encode({"prompt": "task 1"}), "observation/image"),
            (openpi.encode({"endpoint": "kill"}), "endpoint"),
            (libero(1, prompt=None), "instruction"),
            (libero(1, seed="x"), "seed"),
            (libero(1, seed=-1), "seed"),
            (bytes(400_000), "300000"),
        ):
            answer = ask(socket, data)
            assert (answer["type"], answer.keys()) == ("error", {"type", "message"})
            assert said in answer["message"]
            assert "Traceback" not in answer["message"]
        socket.send_text("text")
        assert "binary" in unpack(socket.receive_bytes())["message"]
        assert ask(socket, libero(1))[0, 2] == 1


def test_of_a_stack_of_frames_the_policy_gets_the_newest(robots: Any) -> None:
    with robots[0].websocket_connect(PATH) as socket:
        socket.receive_bytes()
        stack = np.stack([image(pixel) for pixel in (1, 2, 3, 4)])
        assert ask(socket, libero(9, **{"observation/image": stack}))[0, 0] == 4


def test_a_client_that_sends_nothing_is_disconnected_and_its_session_ends() -> None:
    with serving(Mirror(), settings(idle_s=0.05)) as (client, engine), client.websocket_connect(PATH) as socket:
        socket.receive_bytes()
        ask(socket, libero(1))
        assert len(engine.sessions) == 1
        with pytest.raises(WebSocketDisconnect) as closed:
            socket.receive_bytes()
        assert closed.value.code == 1000
    assert len(engine.sessions) == 0


def test_it_shares_no_root_with_openpis_clients() -> None:
    both = settings() | {"openpi": {"mapping": "openpi-libero"}}
    with serving(Mirror(), both) as (client, _), client.websocket_connect("/") as socket:
        assert unpack(socket.receive_bytes()).keys() == {"policy", "checkpoint", "version"}
    with serving(Mirror(), settings()) as (client, _), pytest.raises(WebSocketDisconnect):
        client.websocket_connect("/").__enter__()


def test_a_negative_time_out_is_refused() -> None:
    with pytest.raises(ConfigError, match="idle_s"):
        deployment("noop", dialects=settings(idle_s=-1))
