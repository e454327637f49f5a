"""GR00T's protocol, written for this benchmark from GR00T's documentation, as the package is not on
PyPI.

It uses ZMQ REQ and REP, and msgpack with arrays as the bytes of `.npy` files. Like GR00T's server,
this server answers one request at a time.
"""

from __future__ import annotations

import io
from typing import Any

import msgpack
import numpy as np
import peer
import zmq


def _encode(value: Any) -> Any:
    if not isinstance(value, np.ndarray):
        raise TypeError(f"expected an array, got {type(value).__name__}")
    file = io.BytesIO()
    np.save(file, value, allow_pickle=False)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def _decode(value: dict[str, Any]) -> Any:
    return (
        np.load(io.BytesIO(value["as_npy"]), allow_pickle=False)
        if "__ndarray_class__" in value
        else value
    )


def to_bytes(message: Any) -> bytes:
    """Pack a message."""
    return msgpack.packb(message, default=_encode)


def from_bytes(message: bytes) -> Any:
    """Unpack a message."""
    return msgpack.unpackb(message, object_hook=_decode)


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run the server until the process ends."""
    socket = zmq.Context().socket(zmq.REP)
    socket.bind(f"tcp://{host}:{port}")
    while True:
        request = from_bytes(socket.recv())
        if request["endpoint"] != "get_action":
            raise ValueError(f"endpoint: expected 'get_action', got {request['endpoint']!r}")
        socket.send(to_bytes([{"arm": policy()[None]}, {}]))


def connect(target: peer.Target) -> peer.Client:
    """Connect a client; arrays begin with a batch and a time axis, as in N1.6."""
    observation = {
        "video": {name: image[None, None] for name, image in target.cameras.items()},
        "state": {"arm": target.state[None, None]},
        "language": {"task": [["measure"]]},
    }
    request = {"endpoint": "get_action", "data": {"observation": observation, "options": None}}
    socket = zmq.Context().socket(zmq.REQ)
    socket.connect(f"tcp://{target.host}:{target.port}")

    def act(request: dict[str, Any]) -> np.ndarray:
        socket.send(to_bytes(request))
        action, _info = from_bytes(socket.recv())
        return action["arm"]

    return peer.Client(lambda: request, act)


if __name__ == "__main__":
    peer.run(serve, connect)
