"""The HTTP and WebSocket endpoints of a `noop` policy, without Ray.

`python noop_http_server.py HOST` prints the port and serves.
"""

from __future__ import annotations

import socket
import sys
from dataclasses import asdict

import uvicorn

from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION, LocalAddress, boot_id
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine


def main(host: str) -> None:
    engine = Engine(Noop())
    engine.start()
    local = asdict(LocalAddress(socket="", boot_id=boot_id()))  # no process listens there
    metadata = {"policy": "noop", "version": "0", "protocol": PROTOCOL_VERSION, "local": local}
    inside = build_http_app(engine, lambda: metadata, DEFAULT_LIMITS)
    app = AccessMiddleware(inside, None, "noop")
    with socket.socket() as listening:
        listening.bind((host, 0))
        print(listening.getsockname()[1], flush=True)
        uvicorn.Server(uvicorn.Config(app, log_level="warning", ws_max_size=16 * 2**20)).run(
            sockets=[listening]
        )
    engine.close()


if __name__ == "__main__":
    main(sys.argv[1])
