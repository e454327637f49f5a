"""openpi: its client from PyPI (`openpi-client`), images as raw bytes.

Its server is not on PyPI. This one equals openpi's `WebsocketPolicyServer`: the asyncio server of `websockets` without
compression or size limit, the metadata first, then msgpack in and out by openpi's own `msgpack_numpy`, inference on the
event loop, and both timings in the reply.
"""

from __future__ import annotations

import asyncio
import sys
import time
from typing import Any, TextIO

import numpy as np
import peer
import websockets
import websockets.asyncio.server
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy


def infer(_obs: dict[str, Any]) -> dict[str, Any]:
    """Return a chunk of one action, as a policy that does nothing."""
    return {"actions": np.zeros((1, 7), np.float32), "policy_timing": {"infer_ms": 0.0}}


async def handler(websocket: websockets.asyncio.server.ServerConnection) -> None:
    """Serve one connection."""
    packer = msgpack_numpy.Packer()
    await websocket.send(packer.pack({}))
    previous = None
    while True:
        try:
            begun = time.monotonic()
            obs = msgpack_numpy.unpackb(await websocket.recv())
            inference = time.monotonic()
            action = infer(obs)
            action["server_timing"] = {"infer_ms": (time.monotonic() - inference) * 1000}
            if previous is not None:
                action["server_timing"]["prev_total_ms"] = previous * 1000
            await websocket.send(packer.pack(action))
            previous = time.monotonic() - begun
        except websockets.ConnectionClosed:
            return


def serve(host: str, port: int) -> None:
    """Run the server until the process ends."""

    async def forever() -> None:
        async with websockets.asyncio.server.serve(handler, host, port, compression=None, max_size=None) as server:
            await server.serve_forever()

    asyncio.run(forever())


def drive(host: str, port: int, path: str, _mode: str, out: TextIO) -> None:
    """Drive the server with openpi's own client."""
    arrays = peer.observation(path)
    obs = {
        "observation/image": arrays["camera_0"],
        "observation/wrist_image": arrays["camera_1"],
        "observation/state": np.append(arrays["joints"], np.float32(arrays["gripper"])),
        "prompt": "measure",
    }
    client = WebsocketClientPolicy(host, port)
    peer.obey(sys.stdin, out, lambda calls: peer.timed(lambda: obs, client.infer, calls), {})


if __name__ == "__main__":
    peer.run(serve, drive)
