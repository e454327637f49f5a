"""An ASGI application on a port of this machine."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Iterator

import uvicorn
from eval_fakes import wait_for
from starlette.types import ASGIApp

from vlagents_ray.serve.ports import free_port


@contextlib.contextmanager
def served(app: ASGIApp) -> Iterator[int]:
    """Its port."""
    port = free_port()
    server = uvicorn.Server(
        uvicorn.Config(app, port=port, log_level="critical", lifespan="off", ws="websockets-sansio")
    )
    thread = threading.Thread(target=lambda: asyncio.run(server.serve()))
    thread.start()
    wait_for(lambda: server.started)
    try:
        yield port
    finally:
        server.should_exit = server.force_exit = True
        thread.join()
