"""openpi: its client from PyPI (`openpi-client`), with images as raw bytes. openpi's server is not
on PyPI.

The server here works like openpi's `WebsocketPolicyServer`: it uses the asyncio server of
`websockets` without compression or size limit, sends the metadata first, uses openpi's own
`msgpack_numpy` for messages, computes on the event loop, and replies with both timings.
"""

from __future__ import annotations

import asyncio
import functools
import time
from typing import Any

import peer
import websockets
import websockets.asyncio.server
from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy


async def handler(
    policy: peer.Policy, websocket: websockets.asyncio.server.ServerConnection
) -> None:
    """Serve one connection."""
    packer = msgpack_numpy.Packer()
    await websocket.send(packer.pack({}))
    previous = None
    while True:
        try:
            begun = time.monotonic()
            msgpack_numpy.unpackb(await websocket.recv())
            inference = time.monotonic()
            # (1, 7), or (chunk, 7)
            actions = policy().reshape(-1, 7)
            action: dict[str, Any] = {"actions": actions, "policy_timing": {"infer_ms": 0.0}}
            action["server_timing"] = {"infer_ms": (time.monotonic() - inference) * 1000}
            if previous is not None:
                action["server_timing"]["prev_total_ms"] = previous * 1000
            await websocket.send(packer.pack(action))
            previous = time.monotonic() - begun
        except websockets.ConnectionClosed:
            return


def serve(host: str, port: int, policy: peer.Policy) -> None:
    """Run the server until the process ends."""

    async def forever() -> None:
        handle = functools.partial(handler, policy)
        async with websockets.asyncio.server.serve(
            handle, host, port, compression=None, max_size=None
        ) as server:
            await server.serve_forever()

    asyncio.run(forever())


def connect(target: peer.Target) -> peer.Client:
    """Connect openpi's own client."""
    obs = {
        "observation/image": target.arrays["camera_0"],
        "observation/wrist_image": target.arrays["camera_1"],
        "observation/state": target.state,
        "prompt": "measure",
    }
    client = WebsocketClientPolicy(target.host, target.port)
    return peer.Client(lambda: obs, lambda obs: client.infer(obs)["actions"])


if __name__ == "__main__":
    peer.run(serve, connect)
