"""vla-eval: its model server around a policy that does nothing, and its `Connection`.

Images take its default codec, PNG, unless `mode` names another ("jpeg", "raw").
"""

from __future__ import annotations

import asyncio
import sys
from typing import Any, TextIO

import numpy as np
import peer
from vla_eval.connection import Connection
from vla_eval.model_servers.predict import PredictModelServer
from vla_eval.model_servers.serve import serve as serve_forever
from vla_eval.protocol.numpy_codec import set_image_format


class Noop(PredictModelServer):
    """Seven zeros."""

    def predict(self, obs: dict[str, Any], ctx: Any) -> dict[str, Any]:
        return {"actions": np.zeros(7, np.float32)}


def serve(host: str, port: int) -> None:
    """As its `run_server` does."""
    serve_forever(Noop(), host, port)


def drive(host: str, port: int, path: str, mode: str, out: TextIO) -> None:
    """Its own client, on an event loop of its own."""
    if mode != "png":
        set_image_format(mode)
    arrays = peer.observation(path)
    obs = {
        "images": {name: image for name, image in arrays.items() if name.startswith("camera_")},
        "task_description": "measure",
        "state": np.append(arrays["joints"], np.float32(arrays["gripper"])),
    }
    loop = asyncio.new_event_loop()
    connection = Connection(f"ws://{host}:{port}")
    loop.run_until_complete(connection.connect())
    loop.run_until_complete(connection.start_episode({"task": {"name": "measure"}}))

    async def measure(calls: int) -> list[float]:
        taken = []
        for _ in range(calls):
            begun = loop.time()
            await connection.act(obs)
            taken.append((loop.time() - begun) * 1e3)
        return taken

    peer.obey(sys.stdin, out, lambda calls: loop.run_until_complete(measure(calls)), {})


if __name__ == "__main__":
    peer.run(serve, drive)
