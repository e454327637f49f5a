"""Rate and session limit of a key with two replicas: each replica counts separately, as
docs/access.md explains.
"""

from __future__ import annotations

import contextlib
import http.client
import json
from collections import Counter
from collections.abc import Iterator
from hashlib import sha256

import numpy as np
import pytest
from asgi_server import served

from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine

RATE, SESSIONS = 5, 2


class Policy(Agent):
    def act(self, obs: Obs) -> Act:
        return Act(np.zeros(8, np.float32))


@pytest.fixture
def replicas() -> Iterator[list[int]]:
    """Yield the ports of two replicas that read the same file of keys."""
    key = {"name": "x", "sha256": sha256(b"x").hexdigest(), "rate": RATE, "sessions": SESSIONS}
    metadata = {"policy": "p", "version": "0", "protocol": PROTOCOL_VERSION}
    with contextlib.ExitStack() as stack:
        ports = []
        for _ in range(2):
            engine = Engine(Policy())
            engine.start()
            stack.callback(engine.close)
            app = build_http_app(engine, lambda: metadata, DEFAULT_LIMITS)
            keys = Keys.from_text(json.dumps({"keys": [key]}))
            ports.append(stack.enter_context(served(AccessMiddleware(app, keys, "p"))))
        yield ports


def statuses(port: int, paths: list[str], sessions: list[str]) -> Counter[int]:
    """Return the number of requests at a replica by HTTP status."""
    counted: Counter[int] = Counter()
    for path, session in zip(paths, sessions, strict=True):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
        with contextlib.closing(connection):
            headers = {
                "authorization": "Bearer x",
                "content-type": "application/json",
                "x-session-id": session,
            }
            connection.request("POST", path, b"{}", headers)
            counted[connection.getresponse().status] += 1
    return counted


@pytest.mark.slow
def test_a_key_has_its_rate_at_each_replica(replicas: list[int]) -> None:
    """A burst may contain the requests of one second. Requests at one replica do not count at the
    other.
    """
    paths = ["/v1/reset", *["/v1/act"] * (RATE - 1)]
    first, second = (statuses(port, paths, ["s"] * RATE) for port in replicas)
    assert first == second == {200: RATE}
    over = statuses(replicas[0], ["/v1/act"] * (3 * RATE), ["s"] * (3 * RATE))
    assert over[429] > RATE


def test_a_key_has_its_sessions_at_each_replica(replicas: list[int]) -> None:
    for port in replicas:
        names = [f"s{number}" for number in range(SESSIONS + 1)]
        counted = statuses(port, ["/v1/reset"] * len(names), names)
        assert counted == {200: SESSIONS, 429: 1}
