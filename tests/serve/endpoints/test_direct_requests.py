"""HTTP requests that bypass Serve's own code."""

from __future__ import annotations

import http.client
import json
import threading
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
from asgi_server import served
from eval_fakes import wait_for
from starlette.types import Receive, Scope, Send

from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.direct_requests import DirectRequests, set_for_this_replica
from vlagents_ray.serve.endpoints.front import FrontMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.requests import PendingRequest

HEADERS = {"x-session-id": "robot", "content-type": "application/json"}


class Log:
    """The numbers in the observations on which the policy acted."""

    def __init__(self) -> None:
        self.acts: list[Any] = []


class Gated(Agent):
    """A policy whose acts wait until its gate is open."""

    def __init__(self) -> None:
        self.gate = threading.Event()
        self.gate.set()
        self.acting = threading.Event()
        self.log = Log()

    shared = ("gate", "acting", "log")

    def act(self, obs: Obs) -> Act:
        self.acting.set()
        self.gate.wait(30)
        self.log.acts.append(obs.info.get("number"))
        return Act(obs.state.get("x", [0.0]))  # type: ignore[arg-type]


class Server:
    """A replica with a prefix, behind a stand-in for Serve that counts the requests that it
    receives.
    """

    def __init__(self, prefix: str) -> None:
        self.prefix = prefix
        self.policy = Gated()
        self.engine = Engine(self.policy)
        self.engine.start()
        inside = build_http_app(self.engine, lambda: {"policy": "p"}, MessageLimits())
        self.direct = DirectRequests(AccessMiddleware(inside, None, "app"))
        self.through_serve: Counter[str] = Counter()
        self.port = 0

    async def serve(self, scope: Scope, receive: Receive, send: Send) -> None:
        self.through_serve[scope["path"]] += 1
        await self.direct({**scope, "root_path": self.prefix}, receive, send)

    def connect(self) -> http.client.HTTPConnection:
        return http.client.HTTPConnection("127.0.0.1", self.port, timeout=30)

    def request(
        self,
        method: str,
        path: str,
        body: dict[str, Any] | None = None,
        headers: dict[str, str] | None = None,
    ) -> tuple[int, dict[str, str], Any]:
        connection = self.connect()
        content = None if body is None else json.dumps(body)
        connection.request(method, self.prefix + path, content, {**HEADERS, **(headers or {})})
        answer = connection.getresponse()
        document = json.loads(answer.read())
        connection.close()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, document


@pytest.fixture(params=["", "/pi"], ids=["at the root", "with a prefix"])
def server(request: pytest.FixtureRequest) -> Iterator[Server]:
    server = Server(request.param)
    set_for_this_replica(server.direct)
    try:
        with served(FrontMiddleware(server.serve)) as server.port:
            yield server
    finally:
        set_for_this_replica(None)
        server.policy.gate.set()
        server.engine.close()


def test_requests_of_robots_pass_by_serve_once_it_has_shown_the_prefix(server: Server) -> None:
    assert server.request("POST", "/v1/reset", {})[0] == 200
    assert server.through_serve == {f"{server.prefix}/v1/reset": 1}
    for _ in range(3):
        assert server.request("POST", "/v1/act", {})[0] == 200
    assert server.request("POST", "/v1/close", {})[0] == 200
    assert server.through_serve == {f"{server.prefix}/v1/reset": 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "path"),
    [("GET", "/v1/metadata"), ("GET", "/v1/act"), ("POST", "/v1/other"), ("POST", "/v1/act/")],
)
def test_all_other_requests_are_serves(server: Server, method: str, path: str) -> None:
    server.request("GET", "/v1/metadata")
    server.through_serve.clear()
    server.request(method, path)
    assert server.through_serve == {server.prefix + path: 1}


def test_a_request_has_the_same_id_in_its_answer_and_in_the_header(server: Server) -> None:
    server.request("GET", "/v1/metadata")
    _, headers, document = server.request("POST", "/v1/act", {}, {"x-request-id": "mine"})
    assert headers["x-request-id"] == document["request_id"] == "mine"
    _, headers, document = server.request("POST", "/v1/act", {})
    assert headers["x-request-id"] == document["request_id"]
    assert len(document["request_id"]) == 32


def test_a_request_whose_client_has_left_is_not_acted_on(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    withdrawn = threading.Event()
    withdraw = server.engine.intake.withdraw

    def withdraw_and_tell(*requests: PendingRequest) -> None:
        withdraw(*requests)
        withdrawn.set()

    monkeypatch.setattr(server.engine.intake, "withdraw", withdraw_and_tell)
    server.request("GET", "/v1/metadata")
    for name in ("busy", "robot"):
        server.request("POST", "/v1/reset", {}, {"x-session-id": name})
    server.policy.gate.clear()
    server.policy.acting.clear()
    busy = threading.Thread(
        target=server.request,
        args=("POST", "/v1/act", {"info": {"number": 1}}, {"x-session-id": "busy"}),
    )
    busy.start()
    assert server.policy.acting.wait(10)

    leaving = server.connect()
    content = json.dumps({"info": {"number": 2}})
    leaving.request("POST", f"{server.prefix}/v1/act", content, HEADERS)
    wait_for(lambda: server.engine.queue.depth() == 1)
    leaving.close()
    assert withdrawn.wait(10)
    server.policy.gate.set()
    busy.join()
    assert server.request("POST", "/v1/act", {"info": {"number": 3}})[0] == 200
    assert server.policy.log.acts == [1, 3]


def test_a_client_that_keeps_its_connection_gets_all_answers(server: Server) -> None:
    server.request("GET", "/v1/metadata")
    server.request("POST", "/v1/reset", {})
    connection = server.connect()
    for number in range(50):
        content = json.dumps({"info": {"number": number}})
        connection.request("POST", f"{server.prefix}/v1/act", content, HEADERS)
        answer = connection.getresponse()
        answer.read()
        assert answer.status == 200
    connection.close()
    assert server.policy.log.acts == list(range(50))
