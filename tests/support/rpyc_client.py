"""A client of RPyC's protocol without the package, for frames that the real client would never
send.
"""

from __future__ import annotations

import json
import socket
import zlib
from typing import Any

import numpy as np

from vlagents_ray.wire import json_numpy
from vlagents_ray_dialects.messages import rpyc
from vlagents_ray_dialects.messages.rpyc import Handler

ROOT = ("vlagents_ray.Policy", 1, 1)
VALUE, TUPLE, LOCAL, REMOTE = 1, 2, 3, 4


def request(sequence: int, handler: int, boxed: Any) -> bytes:
    """Return the frame of a request whose arguments are already boxed."""
    return rpyc._frame(1, (sequence, (handler, boxed)))


def call(method: str, *args: Any, sequence: int = 1) -> bytes:
    """Return the frame that calls a method of the root object by name."""
    boxed = (TUPLE, ((LOCAL, ROOT), (VALUE, method), (VALUE, args), (VALUE, ())))
    return request(sequence, Handler.CALLATTR, boxed)


def document(pixel: int = 1, instruction: str | None = "x", side: int = 16, **info: Any) -> str:
    """Return an observation of vlagents 0.3."""
    arm = {
        "cameras": {"front": np.full((side, side, 3), pixel, np.uint8)},
        "camera_data_type": "raw",
        "joints": np.full(7, 0.5, np.float32),
        "gripper": 0.25,
        "info": info,
    }
    return json_numpy.dumps({"obs": {"arm": arm}, "language_instruction": instruction})


class Client:
    """One connection."""

    def __init__(self, port: int, timeout_s: float = 20.0) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=timeout_s)
        self.file = self.socket.makefile("rb")

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def receive(self) -> tuple[int, Any, Any]:
        """Return (kind, sequence, content) of the next message; raise `EOFError` if the server
        closed the connection.
        """
        header = self.file.read(5)
        if len(header) < 5:
            raise EOFError
        length, compressed = rpyc.HEADER.unpack(header)
        body = self.file.read(length + 1)[:-1]
        message = zlib.decompress(body) if compressed else body
        sequence, content = rpyc.read_brine(memoryview(message)[1:])
        return message[0], sequence, content

    def act(self, text: str) -> list:
        """Return the first action for the only robot."""
        self.send(call("act", text))
        kind, _, content = self.receive()
        if kind != 2:
            raise RuntimeError(content[1][0])
        [one] = json.loads(content[1])["acts"][0].values()
        action = one["action"]
        return np.frombuffer(
            json_numpy.decode_base64(action["__numpy__"], "action"), action["dtype"]
        ).tolist()

    def close(self) -> None:
        self.file.close()
        self.socket.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()
