"""The server of an engine in this process, without Ray."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator
from dataclasses import asdict

from benchmarks.gpu.lab import LATE_S
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.engine.engine import Engine


@contextlib.contextmanager
def http_server(engine: Engine) -> Iterator[str]:
    """Yield the URL of an engine's server; robots use a WebSocket to the policy's thread."""
    import uvicorn

    from vlagents_ray.serve.access.api_keys import NoKey
    from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
    from vlagents_ray.serve.endpoints.http import build_http_app
    from vlagents_ray.serve.endpoints.own_port import OwnPortServer
    from vlagents_ray.serve.ports import free_port

    own_port = OwnPortServer(engine, DEFAULT_LIMITS, "127.0.0.1", None, NoKey.OPEN)
    own_port.open()
    about = {
        "policy": "pi0",
        "version": "0",
        "protocol": PROTOCOL_VERSION,
        "contract": engine.contract and engine.contract.to_json(),
        "stream": asdict(own_port.address),
    }
    app = AccessMiddleware(build_http_app(engine, lambda: about, DEFAULT_LIMITS), None, "app")
    port = free_port()
    server = uvicorn.Server(uvicorn.Config(app, port=port, log_level="warning", lifespan="off"))
    thread = threading.Thread(target=lambda: asyncio.run(server.serve()), daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{port}"
    finally:
        server.should_exit = server.force_exit = True
        thread.join(LATE_S)
        own_port.close()
