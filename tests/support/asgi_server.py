"""ASGI applications served at a local port."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections import Counter
from collections.abc import Iterator
from typing import Any

import uvicorn
from eval_fakes import wait_for
from starlette.types import ASGIApp, Receive, Scope, Send

from vlagents_ray import Agent
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.ports import free_port


@contextlib.contextmanager
def served(app: ASGIApp) -> Iterator[int]:
    """Serve `app`, and yield the port."""
    port = free_port()
    server = uvicorn.Server(
        uvicorn.Config(app, port=port, log_level="critical", lifespan="off", ws="websockets-sansio")
    )
    thread = threading.Thread(target=lambda: asyncio.run(_serve(server)))
    thread.start()
    wait_for(lambda: server.started)
    try:
        yield port
    finally:
        server.should_exit = server.force_exit = True
        thread.join()


async def _serve(server: uvicorn.Server) -> None:
    """Run a server, and end the applications whose connections are still open.

    `asyncio.run` would cancel each task once and wait for it. Before Python 3.12,
    `asyncio.wait_for` drops a cancellation that coincides with the awaited event, such as the next
    message of a page in a browser; the task would then run for ever.
    """
    await server.serve()
    while tasks := asyncio.all_tasks() - {asyncio.current_task()}:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks, timeout=0.1)


@contextlib.contextmanager
def policy_server(
    agent: Agent,
    asked: Counter[str] | None = None,
    keys: Keys | None = None,
    **metadata: Any,
) -> Iterator[int]:
    """Serve a policy without Ray, and yield the port; `asked` counts the requests by path, and
    `keys` are the API keys, if any is needed.
    """
    engine = Engine(agent)
    engine.start()
    about = {"policy": "p", "version": "0", "protocol": PROTOCOL_VERSION, **metadata}
    inside = AccessMiddleware(build_http_app(engine, lambda: about, DEFAULT_LIMITS), keys, "app")

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        if asked is not None:
            asked[scope["path"]] += 1
        await inside(scope, receive, send)

    try:
        with served(app) as port:
            yield port
    finally:
        engine.close()
