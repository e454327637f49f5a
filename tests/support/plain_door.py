"""The robots' door over a `noop` policy, without Ray: `python plain_door.py HOST` prints its port and serves."""

from __future__ import annotations

import socket
import sys

import uvicorn

from vlagents_ray.policies.noop import Noop
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.ingress import build_ingress
from vlagents_ray.wire.messages import DEFAULT_LIMITS, PROTOCOL_VERSION


def main(host: str) -> None:
    engine = Engine(Noop())
    engine.start()
    app = build_ingress(
        engine, lambda: {"policy": "noop", "version": "0", "protocol": PROTOCOL_VERSION}, DEFAULT_LIMITS
    )
    with socket.socket() as listening:
        listening.bind((host, 0))
        print(listening.getsockname()[1], flush=True)
        uvicorn.Server(uvicorn.Config(app, log_level="warning", ws_max_size=16 * 2**20)).run(sockets=[listening])
    engine.close()


if __name__ == "__main__":
    main(sys.argv[1])
