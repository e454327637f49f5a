"""What is asked of a server before the first act."""

from __future__ import annotations

from collections import Counter

import pytest
from asgi_server import served
from starlette.types import Receive, Scope, Send

from vlagents_ray import Obs, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.policies.noop import Noop
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine


@pytest.mark.parametrize("transport", ["auto", "websocket", "http"])
def test_the_metadata_is_fetched_once(transport: TransportName) -> None:
    engine = Engine(Noop())
    engine.start()
    metadata = {"policy": "noop", "version": "0", "protocol": PROTOCOL_VERSION}
    inside = AccessMiddleware(build_http_app(engine, lambda: metadata, DEFAULT_LIMITS), None, "noop")
    asked: Counter[str] = Counter()

    async def app(scope: Scope, receive: Receive, send: Send) -> None:
        asked[scope["path"]] += 1
        await inside(scope, receive, send)

    with served(app) as port:
        agent = RemoteAgent(f"http://127.0.0.1:{port}", transport=transport)
        agent.reset(Obs(), "stack")
        agent.act(Obs())
        agent.close()
    engine.close()
    assert asked["/v1/metadata"] == 1, asked
