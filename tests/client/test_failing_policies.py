"""A policy that hangs in an act, or ends its own process there: the error at the robot names the
likely causes.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
from asgi_server import served

from vlagents_ray import Act, Agent, DeadlineExceeded, Obs, PolicyUnavailable, RemoteAgent
from vlagents_ray.client.transports.select import TransportName
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.engine.engine import Engine

TRANSPORTS: list[TransportName] = ["shm", "websocket", "http"]


class Failing(Agent):
    def __init__(self, how: str) -> None:
        self.how = how

    def act(self, obs: Obs) -> Act:
        if self.how == "ends its process":
            os._exit(0)
        threading.Event().wait()
        raise AssertionError


def serve(how: str) -> None:
    """Serve a policy, print the port, and stop when the standard input ends."""
    engine = Engine(Failing(how))
    local = ShmServer(engine, DEFAULT_LIMITS, NoKey.OPEN)
    stream = OwnPortServer(engine, DEFAULT_LIMITS, "127.0.0.1", None, NoKey.OPEN)
    local.open()
    stream.open()
    engine.start()
    metadata = {
        "policy": "failing",
        "version": "0",
        "protocol": PROTOCOL_VERSION,
        "local": asdict(local.address),
        "stream": asdict(stream.address),
    }
    app = build_http_app(engine, lambda: metadata, DEFAULT_LIMITS)
    with served(AccessMiddleware(app, None, "failing")) as port:
        print(port, flush=True)
        sys.stdin.read()
        os._exit(0)  # a normal exit would wait for the policy's thread


@contextlib.contextmanager
def failing_server(how: str) -> Iterator[str]:
    """Serve in another process, and yield the URL."""
    folders = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1] / "support")]
    path = os.pathsep.join([*folders, os.environ.get("PYTHONPATH", "")])
    process = subprocess.Popen(
        [sys.executable, __file__, how],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": path},
        text=True,
    )
    with process:
        assert process.stdin is not None
        assert process.stdout is not None
        yield f"http://127.0.0.1:{int(process.stdout.readline())}"
        process.stdin.close()


@pytest.mark.slow
@pytest.mark.parametrize("transport", TRANSPORTS)
@pytest.mark.parametrize(
    ("how", "kind", "parts"),
    [
        ("hangs", DeadlineExceeded, ["within", "hang in a call", "server's log"]),
        ("ends its process", PolicyUnavailable, ["ended its process (os._exit", "server's log"]),
    ],
)
def test_the_error_at_the_robot_names_the_causes_in_the_policy(
    transport: TransportName, how: str, kind: type[Exception], parts: list[str]
) -> None:
    with failing_server(how) as url, RemoteAgent(url, transport=transport) as agent:
        agent.reset(Obs(), "x")
        with pytest.raises(kind) as error:
            agent.act(Obs(info={"deadline_ms": 3000}))
        assert [part for part in parts if part not in str(error.value)] == [], str(error.value)


def test_the_page_for_users_names_the_order_of_colours_and_how_to_check_it() -> None:
    """A server cannot detect swapped colours."""
    from vlagents_ray.serve.endpoints.docs_page import docs_page

    document: dict[str, Any] = {"policy": "p", "version": "0", "protocol": PROTOCOL_VERSION}
    page = docs_page(document)
    assert "upright RGB" in page
    assert "image[..., ::-1]" in page
    assert "vlagents-ray robot check" in page


if __name__ == "__main__":
    serve(sys.argv[1])
