"""Two clients of one caller that use equal names, interleaved: each gets the actions for its own
observations, in its own session. The names are those that a client chooses: ids of messages,
sessions, trials, environments and openings, and instructions.

Over HTTP, a client has no connection, and the name of a session is the session; therefore
`/act` and `/v1/actions/generations` are not here.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from dialect_server import (
    ALL,
    LIMITS,
    call,
    image,
    libero,
    receive,
    seen,
    send,
    serving,
    xpolicylab,
    xpolicylab_observation,
)
from in_process_replicas import Replicas
from served_agents import Witness

from vlagents_ray import Act, Obs
from vlagents_ray.protocol.messages import Budget
from vlagents_ray.registry import dialect_class, names
from vlagents_ray.serve.dialects.base import RouteDialect
from vlagents_ray_dialects.messages import openpi
from vlagents_ray_dialects.messages import xpolicylab as xpolicylab_codec

# Sends a pixel as the given step of an episode, and returns the first row of the answer.
ActAt = Callable[[int, int], np.ndarray]


class OneRow(Witness):
    """`Witness` with one row, so that each observation needs an act."""

    def act(self, obs: Obs) -> Act:
        return Act(super().act(obs).action[:1])


SETTINGS = ALL | {"xpolicylab": {"mapping": {"preset": "xpolicylab", "action": {"actions": {}}}}}


def over_openpi(socket: Any) -> ActAt:
    socket.receive_bytes()
    return lambda pixel, _step: np.asarray(call(socket, libero(pixel))["actions"][0])


def over_roboarena(socket: Any) -> ActAt:
    socket.receive_bytes()

    def act(pixel: int, _step: int) -> np.ndarray:
        message = libero(pixel, endpoint="infer", session_id="one")
        answer = call(socket, message)
        return np.asarray(answer["actions"] if isinstance(answer, dict) else answer)[0]

    return act


def over_vla_eval(socket: Any) -> ActAt:
    def act(pixel: int, step: int) -> np.ndarray:
        send(socket, "observation", seen(pixel), step)
        return np.asarray(receive(socket).payload["actions"]).reshape(-1, 5)[0]

    return act


def over_xpolicylab(socket: Any) -> ActAt:
    def ask(kind: str, message_id: str, **payload: Any) -> Any:
        socket.send_bytes(xpolicylab(kind, message_id, **payload))
        answer = xpolicylab_codec.decode(socket.receive_bytes(), Budget(LIMITS))
        assert answer.kind != "error", answer.payload
        return answer.payload

    def act(pixel: int, step: int) -> np.ndarray:
        observation = xpolicylab_observation(pixel)
        ask("call", f"u{step}", func_name="update_obs", obs=observation)
        answer = ask("call", f"a{step}", func_name="get_action", obs=None)
        return np.asarray(answer["result"][0]["actions"])

    return act


def over_sglang(socket: Any, named: bool) -> ActAt:
    socket.receive_bytes()
    parameters = {"parameters": {"session_ids": ["slot-0"]}} if named else {}

    def act(pixel: int, _step: int) -> np.ndarray:
        observation = {"images": {"front": image(pixel)}, "state": np.ones(2, np.float32)}
        inputs = {"prompt": "task 1", "observation": observation}
        answer = call(socket, openpi.encode({"input": inputs, "request_id": "r-1", **parameters}))
        return np.asarray(answer["data"][0]["action"]["values"])[0]

    return act


SOCKETS: dict[str, tuple[str, str, Callable[[Any], ActAt]]] = {
    "openpi": ("openpi", "/openpi", over_openpi),
    "roboarena": ("roboarena", "/roboarena", over_roboarena),
    "vla_eval": ("vla_eval", "/vla-eval", over_vla_eval),
    "xpolicylab": ("xpolicylab", "/xpolicylab", over_xpolicylab),
    "sglang": ("sglang", "/v1/actions/realtime", lambda socket: over_sglang(socket, False)),
    "sglang with session_ids": (
        "sglang",
        "/v1/actions/realtime",
        lambda socket: over_sglang(socket, True),
    ),
}


@contextlib.contextmanager
def two_sockets(name: str) -> Iterator[list[ActAt]]:
    _, path, over = SOCKETS[name]
    with (
        serving(OneRow(), SETTINGS) as (client, _),
        client.websocket_connect(path) as red,
        client.websocket_connect(path) as blue,
    ):
        yield [over(red), over(blue)]


@contextlib.contextmanager
def two_of_gr00t(open_dialect: Any) -> Iterator[list[ActAt]]:
    pytest.importorskip("zmq")
    from gr00t_client import PolicyClient

    port = open_dialect("gr00t")
    clients = [PolicyClient(port), PolicyClient(port)]

    def act(client: PolicyClient, pixel: int) -> np.ndarray:
        observation = {
            "video": {"front": image(pixel)[None, None]},
            "state": {"arm": np.ones((1, 1, 2), np.float32)},
            "language": {"task": [["task 1"]]},
        }
        actions, _ = client.get_action(observation)
        return np.asarray(actions["action"][0, 0])

    yield [lambda pixel, _step, client=client: act(client, pixel) for client in clients]
    for client in clients:
        client.close()


@contextlib.contextmanager
def two_of_lerobot_remote(open_dialect: Any) -> Iterator[list[ActAt]]:
    pytest.importorskip("zenoh")
    from remote_robot import SETTINGS as REMOTE
    from remote_robot import RemoteRobot

    port = open_dialect("lerobot_remote", **REMOTE)

    def act(robot: Any, pixel: int) -> np.ndarray:
        return np.asarray(robot.act(pixel).body["canonical_actions"][0])

    with RemoteRobot(port) as red, RemoteRobot(port) as blue:
        robots = [robot.begin(request_id="1") for robot in (red, blue)]
        yield [lambda pixel, _step, robot=robot: act(robot, pixel) for robot in robots]


@pytest.fixture(name="replicas")
def witnesses() -> Iterator[Replicas]:
    replicas = Replicas([Witness()])
    yield replicas
    replicas.close()


@pytest.mark.parametrize("name", [*SOCKETS, "gr00t", "lerobot_remote"])
@pytest.mark.parametrize("pixels", [(10, 200), (10, 10)], ids=["other images", "equal images"])
def test_two_clients_with_equal_names_get_their_own_actions(
    name: str, pixels: tuple[int, int], open_dialect: Any
) -> None:
    if name == "gr00t":
        both = two_of_gr00t(open_dialect)
    elif name == "lerobot_remote":
        both = two_of_lerobot_remote(open_dialect)
    else:
        both = two_sockets(name)
    with both as clients:
        for step in range(4):
            for act, pixel in zip(clients, pixels, strict=True):
                row = act(pixel + step, step)
                assert (row[0], row[4]) == (pixel + step, step + 1), (name, step)


def test_each_dialect_with_a_connection_is_here() -> None:
    with_sockets = set()
    for name in names("dialects"):
        cls = dialect_class(name)
        if issubclass(cls, RouteDialect) and any(path.startswith("WS ") for path in cls.paths):
            with_sockets.add(name)
    assert {dialect for dialect, _, _ in SOCKETS.values()} == with_sockets
