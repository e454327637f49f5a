"""A program with several clients of a dialect, which acts once for each and then waits to be killed.

    python killed_clients.py DIALECT PORT NUMBER

It prints a line when all clients have their answers.
"""

from __future__ import annotations

import socket
import sys
import threading
from typing import Any

import numpy as np
from dialect_server import libero, seen, xpolicylab, xpolicylab_observation
from endpoint_situations import handshake, websocket_frame

from vlagents_ray_dialects.messages import openpi, vla_eval

# Each message of a client of a WebSocket is answered with one message.
PATHS = {
    "openpi": "/openpi",
    "roboarena": "/roboarena",
    "vla_eval": "/vla-eval",
    "xpolicylab": "/xpolicylab",
    "sglang": "/v1/actions/realtime",
}
PIXELS = np.full((8, 8, 3), 7, np.uint8)
GREETS = ("openpi", "roboarena", "sglang")  # the server sends the first message


def _messages(dialect: str) -> list[bytes]:
    """Return the messages of a client of a WebSocket up to its first act."""
    if dialect == "openpi":
        return [libero(7)]
    if dialect == "roboarena":
        return [libero(7, endpoint="infer", session_id="one")]
    if dialect == "vla_eval":
        message = vla_eval.VlaEvalMessage("observation", seen(7), 0)
        return [vla_eval.encode(message)]
    if dialect == "xpolicylab":
        observed = xpolicylab_observation(7)
        return [
            xpolicylab("call", "u", func_name="update_obs", obs=observed),
            xpolicylab("call", "a", func_name="get_action", obs=None),
        ]
    inputs = {"prompt": "go", "observation": {"images": {"front": PIXELS}, "state": np.ones(2)}}
    return [openpi.encode({"input": inputs, "request_id": "r"})]


def _over_websocket(dialect: str, port: int) -> Any:
    connection = socket.create_connection(("127.0.0.1", port), timeout=60)
    connection.sendall(handshake(PATHS[dialect]))
    answer = b""
    while b"\r\n\r\n" not in answer:
        answer += connection.recv(65536)
    assert answer.startswith(b"HTTP/1.1 101"), answer
    if dialect in GREETS and answer.endswith(b"\r\n\r\n"):
        connection.recv(65536)
    for message in _messages(dialect):
        connection.sendall(websocket_frame(message))
        assert connection.recv(65536)
    return connection


def _over_own_port(dialect: str, port: int) -> Any:
    if dialect == "gr00t":
        from gr00t_client import PolicyClient

        client = PolicyClient(port)
        client.get_action(
            {
                "video": {"front": PIXELS[None, None]},
                "state": {"arm": np.ones((1, 1, 2), np.float32)},
                "language": {"task": [["go"]]},
            }
        )
        return client
    if dialect == "lerobot":
        from lerobot_messages import AsyncClient, robot_saw

        robot = AsyncClient(port).begin()
        robot.act(robot_saw(0, pixel=7))
        return robot
    if dialect == "lerobot_remote":
        from remote_robot import RemoteRobot

        remote = RemoteRobot(port).begin(request_id="1")
        remote.act(7)
        return remote
    from rpyc_client import Client, document

    client = Client(port)
    client.act(document(7, "go"))
    return client


def main() -> None:
    """Connect, act, and wait."""
    dialect, port, number = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    connect = _over_websocket if dialect in PATHS else _over_own_port
    clients = [connect(dialect, port) for _ in range(number)]
    print(f"{len(clients)} clients have acted", flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main()
