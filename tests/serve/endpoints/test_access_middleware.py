"""The access middleware in front of the robots' endpoint, with API keys and slow clients, on a real
HTTP server without Ray.
"""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from starlette.responses import PlainTextResponse
from starlette.testclient import TestClient
from starlette.types import Receive, Scope, Send
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from vlagents_ray import Forbidden, Obs, RemoteAgent, TooManyRequests, Unauthorized
from vlagents_ray.interface import Act, Agent
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, MessageLimits
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray.serve.access.key_store import new_key, revoke
from vlagents_ray.serve.endpoints import http_messages
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.engine.engine import Engine

SLOW_S = 1.0
TOKENS = {
    "arm": {"sessions": 2},
    "lab": {},
    "other": {"apps": ("pi0",)},
    "slow": {"rate": 3},
    "leaver": {},
    "goer": {},
    "ending": {},
}


class Big(Agent):
    """A policy whose answers are larger than the buffers of any socket."""

    def act(self, obs: Obs) -> Act:
        return Act(
            np.zeros(2, np.float32),
            info={"much": np.zeros(int(obs.info.get("bytes", 1)), np.uint8)},
        )


@dataclass
class Endpoint:
    url: str
    port: int
    engine: Engine
    file: Path
    tokens: dict[str, str]

    def agent(self, name: str, transport: str = "http", **options: object) -> RemoteAgent:
        return RemoteAgent(self.url, transport=transport, api_key=self.tokens[name], **options)  # type: ignore[arg-type]

    def get(
        self, path: str, headers: dict[str, str] | None = None
    ) -> tuple[int, dict[str, str], bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=10)
        with contextlib.closing(connection):
            connection.request("GET", path, headers=headers or {})
            answer = connection.getresponse()
            return answer.status, {k.lower(): v for k, v in answer.getheaders()}, answer.read()

    def stream(self, headers: dict[str, str]):
        url = self.url.replace("http", "ws") + "/v1/stream"
        return connect(url, additional_headers=headers, ping_interval=None, close_timeout=1)


@pytest.fixture(scope="module")
def endpoint(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Endpoint]:
    before, api_keys._CHECK_S = api_keys._CHECK_S, 0.0
    file = tmp_path_factory.mktemp("keys") / "keys.json"
    tokens = {name: new_key(file, name, **allowed) for name, allowed in TOKENS.items()}  # type: ignore[arg-type]
    engine = Engine(Big())
    engine.start()
    inside = build_http_app(
        engine,
        lambda: {"policy": "p", "version": "0", "protocol": PROTOCOL_VERSION},
        MessageLimits(body_bytes=2**24),
    )
    guard = AccessMiddleware(inside, Keys.from_file(file), "noop", slow_s=SLOW_S, idle_s=3600)
    with served(guard) as port:
        yield Endpoint(f"http://127.0.0.1:{port}", port, engine, file, tokens)
    engine.close()
    api_keys._CHECK_S = before


def bearer(token: str) -> dict[str, str]:
    return {"authorization": f"Bearer {token}"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [
        "/docs",
        "/v1/metadata",
        "/v1/act",
        "/",
        "/nope",
        "/healthz/",
        "//healthz",
        "/live/",
        "/v1/live",
    ],
)
def test_no_path_answers_without_a_key(endpoint: Endpoint, path: str) -> None:
    for headers in ({}, bearer("wrong"), {"x-api-key": "wrong"}):
        status, said, body = endpoint.get(path, headers)
        assert status == 401
        assert said["www-authenticate"].startswith("Bearer")
        document = json.loads(body)
        assert document["code"] == "unauthorized"
        assert document["request_id"]
    status, said, body = endpoint.get(path, bearer(endpoint.tokens["other"]))
    assert (status, json.loads(body)["code"]) == (403, "forbidden")


@pytest.mark.parametrize(
    ("method", "path", "is_served"),
    [
        ("GET", "/page", True),
        ("HEAD", "/page", True),
        ("POST", "/page", False),
        ("GET", "/page/", False),
        ("GET", "/page/data", False),
        ("GET", "//page", False),
        ("GET", "/pag", False),
        ("GET", "/healthz", True),
    ],
)
def test_only_the_page_itself_is_read_without_a_key(
    endpoint: Endpoint, method: str, path: str, is_served: bool
) -> None:
    reached: list[str] = []

    async def inside(scope: Scope, receive: Receive, send: Send) -> None:
        reached.append(scope["path"])
        await PlainTextResponse("a page without data")(scope, receive, send)

    guard = AccessMiddleware(inside, Keys.from_file(endpoint.file), "noop", public=["/page"])
    answer = TestClient(guard).request(method, path)
    assert (answer.status_code, reached) == ((200, [path]) if is_served else (401, []))


@pytest.mark.slow
def test_who_asks_often_without_a_key_is_answered_as_late_as_with_a_wrong_one(
    endpoint: Endpoint,
) -> None:
    """Each answer takes time of the event loop and holds the GIL, which delays robots."""
    guard = AccessMiddleware(
        PlainTextResponse("a page without data"), Keys.from_file(endpoint.file), "noop"
    )
    client = TestClient(guard)
    begun = time.monotonic()
    for _ in range(81):
        assert client.get("/healthz").status_code == 200
    assert time.monotonic() - begun > 1.0  # 20 answers at once, then at most 40 per second


def test_without_keys_pages_of_other_sites_are_refused(endpoint: Endpoint) -> None:
    """A browser on the robot's machine can reach the loopback address, but names the page that
    sends the request.
    """
    unkeyed = AccessMiddleware(
        build_http_app(
            endpoint.engine,
            lambda: {"policy": "p", "version": "0", "protocol": PROTOCOL_VERSION},
            MessageLimits(),
        ),
        None,
        "noop",
    )
    with served(unkeyed) as port:
        own = Endpoint(f"http://127.0.0.1:{port}", port, endpoint.engine, endpoint.file, {})
        assert own.get("/v1/metadata", {"origin": "https://evil.example"})[0] == 403
        assert own.get("/v1/metadata", {"origin": own.url})[0] == 200
        rebound = {"origin": "http://evil.example:8000", "host": "evil.example:8000"}
        # Another site's name that resolves to this machine.
        assert own.get("/v1/metadata", rebound)[0] == 403
        with (
            pytest.raises(InvalidStatus) as refused,
            own.stream({"origin": "https://evil.example"}),
        ):
            pass
        assert refused.value.response.status_code == 403


def test_a_request_id_of_the_callers_own_comes_back_with_the_refusal(endpoint: Endpoint) -> None:
    _, _, body = endpoint.get("/v1/metadata", {"x-request-id": "mine"})
    assert json.loads(body)["request_id"] == "mine"


def test_a_websocket_is_refused_before_it_is_accepted(endpoint: Endpoint) -> None:
    for headers, status in (
        ({}, 401),
        (bearer("wrong"), 401),
        (bearer(endpoint.tokens["other"]), 403),
    ):
        with pytest.raises(InvalidStatus) as refused, endpoint.stream(headers):
            pytest.fail("the client was accepted")
        assert refused.value.response.status_code == status
        assert json.loads(refused.value.response.body or b"")["status"] == status


@pytest.mark.slow
@pytest.mark.parametrize("key", ["no key", "a wrong key", "a key of another application"])
@pytest.mark.parametrize("way", ["a path", "an upload", "an unknown path"])
def test_a_connection_without_a_right_key_gets_few_answers(
    endpoint: Endpoint, way: str, key: str
) -> None:
    headers = {
        "no key": {},
        "a wrong key": bearer("wrong"),
        "a key of another application": bearer(endpoint.tokens["other"]),
    }[key]
    method, path, body = {
        "a path": ("GET", "/v1/metadata", None),
        "an upload": ("POST", "/v1/act", b"x" * 1000),
        "an unknown path": ("GET", "/nothing", None),
    }[way]
    connection = http.client.HTTPConnection("127.0.0.1", endpoint.port, timeout=10)
    begun = time.monotonic()
    with contextlib.closing(connection):
        for _ in range(4):
            connection.request(method, path, body, headers)
            answer = connection.getresponse()
            answer.read()
            assert answer.status in (401, 403)
    assert time.monotonic() - begun >= 4 * http_messages.REFUSAL_S


@pytest.mark.parametrize("transport", ["http", "websocket", "auto"])
def test_a_client_without_a_right_key_hears_so_at_once(endpoint: Endpoint, transport: str) -> None:
    begun = time.monotonic()
    for token, error in (
        (None, Unauthorized),
        ("wrong", Unauthorized),
        (endpoint.tokens["other"], Forbidden),
    ):
        with (
            pytest.raises(error),
            RemoteAgent(endpoint.url, transport=transport, api_key=token) as agent,
        ):  # type: ignore[arg-type]
            agent.reset(Obs(), "x")
    # The client does not retry for the 60 s that a server may take to start.
    assert time.monotonic() - begun < 20


def test_the_key_may_come_from_the_environment(
    endpoint: Endpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VLAGENTS_RAY_API_KEY", endpoint.tokens["lab"])
    with RemoteAgent(endpoint.url, transport="websocket") as agent:
        agent.reset(Obs(), "x")
        assert endpoint.tokens["lab"] not in repr(vars(agent._connection.transport))


def test_one_keys_session_is_out_of_reach_for_another(endpoint: Endpoint) -> None:
    def post(token: str, op: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", endpoint.port, timeout=10)
        with contextlib.closing(connection):
            headers = {
                "x-session-id": "shared",
                "content-type": "application/json",
                **bearer(token),
            }
            connection.request(
                "POST", f"/v1/{op}", b'{"obs": {}}' if op == "close" else b"{}", headers
            )
            answer = connection.getresponse()
            return answer.status, answer.read()

    assert post(endpoint.tokens["lab"], "reset")[0] == 200
    assert post(endpoint.tokens["lab"], "act")[0] == 200
    status, body = post(endpoint.tokens["arm"], "act")
    assert (status, json.loads(body)["code"]) == (404, "unknown_session")
    assert post(endpoint.tokens["arm"], "close")[0] in (200, 400)
    assert post(endpoint.tokens["lab"], "act")[0] == 200


@pytest.mark.parametrize("transport", ["http", "websocket"])
def test_a_key_holds_no_more_sessions_than_it_may(endpoint: Endpoint, transport: str) -> None:
    with endpoint.agent("arm", transport) as first, endpoint.agent("arm", transport) as second:
        first.reset(Obs(), "x")
        second.reset(Obs(), "x")
        with (
            endpoint.agent("arm", transport) as third,
            pytest.raises(TooManyRequests, match="2 sessions"),
        ):
            third.reset(Obs(), "x")
        with endpoint.agent("lab", transport) as other:
            other.reset(Obs(), "x")
        first.reset(Obs(), "again")
        second.close()
        wait_for(
            lambda: sum(name.startswith("arm/") for name in endpoint.engine.sessions.ids()) < 2
        )
        with endpoint.agent("arm", transport) as third:
            third.reset(Obs(), "x")
    wait_for(lambda: not any(name.startswith("arm/") for name in endpoint.engine.sessions.ids()))


@pytest.mark.slow
def test_too_many_requests_are_told_when_to_come_again(endpoint: Endpoint) -> None:
    found = [endpoint.get("/v1/metadata", bearer(endpoint.tokens["slow"])) for _ in range(5)]
    limited = [headers for status, headers, _ in found if status == 429]
    assert limited
    assert all(int(headers["retry-after"]) >= 1 for headers in limited)
    with endpoint.agent("slow", "websocket") as agent:
        wait_for(lambda: endpoint.get("/v1/metadata", bearer(endpoint.tokens["slow"]))[0] == 200)
        errors = []
        for _ in range(5):
            try:
                agent.reset(Obs(), "x")
            except TooManyRequests as error:
                errors.append(error)
        assert errors


def test_a_revoked_key_hangs_up_its_websockets_and_no_others(endpoint: Endpoint) -> None:
    with (
        endpoint.stream(bearer(endpoint.tokens["leaver"])) as idle,
        endpoint.agent("lab", "websocket") as other,
    ):
        other.reset(Obs(), "x")
        revoke(endpoint.file, "leaver")
        with pytest.raises(ConnectionClosed) as closed:
            idle.recv(timeout=10)
        assert closed.value.rcvd.code == 1008
        assert "revoked" in closed.value.rcvd.reason
        other.act(Obs())


def test_an_application_that_misses_its_cancellation_receives_nothing_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`asyncio.wait_for` of Python 3.11 drops a cancellation that arrives together with the awaited
    message.
    """
    file = tmp_path / "keys.json"
    token = new_key(file, "leaver")
    received: list[str] = []
    ended = threading.Event()

    async def app(_scope: Scope, receive: Receive, send: Send) -> None:
        await receive()
        await send({"type": "websocket.accept"})
        try:
            while True:
                with contextlib.suppress(asyncio.CancelledError):  # as `wait_for` does
                    received.append((await receive())["type"])
                if len(received) > 3:
                    return
                with contextlib.suppress(asyncio.CancelledError):
                    await asyncio.sleep(0.2)
                if received:
                    received.append((await receive())["type"])
        finally:
            ended.set()

    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    guard = AccessMiddleware(app, Keys.from_file(file), "noop", idle_s=3600)
    with (
        served(guard) as port,
        connect(f"ws://127.0.0.1:{port}/", additional_headers=bearer(token)) as client,
    ):
        revoke(file, "leaver")
        with pytest.raises(ConnectionClosed, match="revoked"):
            client.recv(timeout=10)
        assert ended.wait(10)
    assert received in ([], ["websocket.disconnect"])


def test_a_look_at_a_websocket_that_fails_is_not_the_last(
    endpoint: Endpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusal, failed = api_keys.Caller.refusal, threading.Event()

    def fail_once(caller: api_keys.Caller) -> str | None:
        if not failed.is_set():
            failed.set()
            raise RuntimeError("once")
        return refusal(caller)

    monkeypatch.setattr(api_keys.Caller, "refusal", fail_once)
    with endpoint.stream(bearer(endpoint.tokens["goer"])) as idle:
        assert failed.wait(10)
        revoke(endpoint.file, "goer")
        with pytest.raises(ConnectionClosed, match="revoked"):
            idle.recv(timeout=10)


def test_a_body_that_does_not_come_is_cut_off(endpoint: Endpoint) -> None:
    with (
        endpoint.agent("lab") as bystander,
        socket.create_connection(("127.0.0.1", endpoint.port), timeout=30) as slow,
    ):
        bystander.reset(Obs(), "x")
        head = (
            "POST /v1/reset HTTP/1.1\r\nhost: x\r\nauthorization: Bearer "
            f"{endpoint.tokens['lab']}\r\n"
        )
        head += (
            "x-session-id: slow\r\ncontent-type: application/json\r\ncontent-length: 100\r\n\r\n{"
        )
        slow.sendall(head.encode())
        answer = slow.recv(65536)
        assert answer.startswith(b"HTTP/1.1 408")
        assert b"problem+json" in answer
        bystander.act(Obs())
    assert "lab/slow" not in endpoint.engine.sessions.ids()


def test_a_websocket_that_never_reads_its_replies_ends_with_its_sessions_alone(
    endpoint: Endpoint,
) -> None:
    from vlagents_ray.protocol.frames import encode_requests
    from vlagents_ray.protocol.messages import Request

    with endpoint.agent("lab", "websocket") as bystander:
        bystander.reset(Obs(), "x")

        def deaf_ones() -> list[str]:
            return [name for name in endpoint.engine.sessions.ids() if name.startswith("ending/")]

        deaf = socket.create_connection(("127.0.0.1", endpoint.port), timeout=30)
        with connect(
            endpoint.url.replace("http", "ws") + "/v1/stream",
            sock=deaf,
            additional_headers=bearer(endpoint.tokens["ending"]),
            max_queue=1,
            ping_interval=None,
            close_timeout=1,
        ) as stream:
            stream.send(encode_requests([Request("reset", Obs())]))
            wait_for(deaf_ones)
            # On a busy machine the connection may close before the last message is sent.
            with contextlib.suppress(ConnectionClosed):
                for _ in range(30):
                    stream.send(encode_requests([Request("act", Obs(info={"bytes": 2**20}))]))
            wait_for(lambda: not deaf_ones())
            bystander.act(Obs())
            with contextlib.suppress(OSError):
                deaf.shutdown(socket.SHUT_RDWR)


@pytest.mark.slow
def test_a_websocket_that_stays_silent_or_sends_half_a_message_is_cut_off() -> None:
    engine = Engine(Big())
    engine.start()
    with served(
        AccessMiddleware(build_http_app(engine, dict, MessageLimits()), None, "noop", idle_s=SLOW_S)
    ) as port:
        with socket.create_connection(("127.0.0.1", port), timeout=30) as half:
            half.sendall(
                b"GET /v1/stream HTTP/1.1\r\nhost: x\r\nconnection: upgrade\r\nupgrade: "
                b"websocket\r\n"
                b"sec-websocket-version: 13\r\nsec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
            )
            accepted, _, early = half.recv(4096).partition(b"\r\n\r\n")
            assert accepted.startswith(b"HTTP/1.1 101")
            # The first 4 bytes of a masked frame of 126 bytes.
            half.sendall(b"\x82\xfe\x00\x7e" + bytes(8))
            assert (early or half.recv(4096))[0] == 0x88  # the server sends a close frame
        with (
            connect(
                f"ws://127.0.0.1:{port}/v1/stream", ping_interval=None, close_timeout=1
            ) as silent,
            pytest.raises(ConnectionClosed, match="silent"),
        ):
            silent.recv(timeout=30)
    engine.close()
