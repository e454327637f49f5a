"""The special properties of HTTP at a replica's own port. tests/golden contains the bytes of
requests and answers, which are equal to those at the server's port.
"""

from __future__ import annotations

import contextlib
import json
import re
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from in_memory_keys import ChangingKeys
from websockets.server import ServerProtocol

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.transports import http, websocket
from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.http import HttpTransport
from vlagents_ray.client.transports.websocket import WebSocketTransport
from vlagents_ray.errors import ConnectionLost
from vlagents_ray.images import jpeg_png
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, MessageLimits, Request, StreamAddress
from vlagents_ray.serve import periodic
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints import http_connection
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings

ANSWER_S = 20.0
SLOW_S = 0.4


class Acts(list[int]):
    """The acts of all sessions together."""


class Policy(Agent):
    """A policy that counts its acts, and waits in them if the test requests it."""

    def __init__(self) -> None:
        self.acts = Acts()
        self.acting, self.may_act = threading.Event(), threading.Event()
        self.may_act.set()

    def shared_objects(self) -> list[object]:
        return [self.acts, self.acting, self.may_act]

    def act(self, obs: Obs) -> Act:
        self.acting.set()
        self.may_act.wait(ANSWER_S)
        self.acts.append(1)
        return Act(np.zeros(2, np.float32))


@dataclass
class Replica:
    engine: Engine
    policy: Policy
    own: OwnPortServer
    known: ChangingKeys

    def request(self, op: str = "act", body: bytes = b"{}", *headers: str, **more: Any) -> bytes:
        """Return a JSON request, by default for a path of the replica's own port."""
        path = more.get("path", f"{self.own.path}/{op}")
        lines = [
            f"{more.get('method', 'POST')} {path} HTTP/{more.get('version', '1.1')}",
            "Host: 127.0.0.1",
            "x-session-id: robot-1",
            "content-type: application/json",
            *headers,
        ]
        if more.get("length", True):
            lines.append(f"content-length: {len(body)}")
        return "\r\n".join([*lines, "", ""]).encode() + body

    def connect(self) -> Client:
        return Client(self.own.address.port)


class Client:
    """A connection that reads one answer after the other."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=ANSWER_S)
        self._file = self.socket.makefile("rb")

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self.socket.close()

    def ask(self, *parts: bytes) -> tuple[int, dict[str, str], bytes]:
        for part in parts:
            self.socket.sendall(part)
        return self.answer()

    def answer(self, *, has_body: bool = True) -> tuple[int, dict[str, str], bytes]:
        """Return the status, the headers and the body of the next answer."""
        status = int(self._file.readline().split()[1])
        lines = iter(self._file.readline, b"\r\n")
        pairs = [line.decode().strip().split(": ", 1) for line in lines]
        headers = {name.lower(): value for name, value in pairs}
        body = self._file.read(int(headers["content-length"])) if has_body else b""
        return status, headers, body

    def is_ended(self) -> bool:
        """Return whether the server ends the connection within some seconds."""
        with contextlib.suppress(ConnectionError):
            return self._file.read(1) == b""
        return True


def code_of(body: bytes) -> str:
    code: str = json.loads(body)["code"]
    return code


@contextlib.contextmanager
def replica(*, keyed: bool = False, slow_s: float = 60.0, **limits: int) -> Iterator[Replica]:
    policy, known = Policy(), ChangingKeys()
    engine = Engine(policy, EngineSettings(session_limit=4))
    check_key = (lambda token: known.keys.check(token, "app")) if keyed else NoKey.OPEN
    own = OwnPortServer(
        engine, MessageLimits(**limits), "127.0.0.1", None, check_key, slow_s=slow_s, idle_s=60.0
    )
    own.open()
    engine.start()
    try:
        yield Replica(engine, policy, own, known)
    finally:
        policy.may_act.set()
        engine.close()
        own.close()


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    monkeypatch.setattr(periodic.each_half_second, "_period_s", 0.02)


@pytest.fixture
def served_replica() -> Iterator[Replica]:
    with replica() as served:
        yield served


def test_a_connection_serves_one_request_after_the_other(served_replica: Replica) -> None:
    with served_replica.connect() as client:
        for op in ("reset", "act", "act", "close"):
            status, headers, body = client.ask(served_replica.request(op))
            assert (status, headers["content-type"]) == (200, "application/json"), body
            assert headers["x-request-id"]
            assert "connection" not in headers
        assert len(served_replica.own._clients) == 1
    wait_for(lambda: not served_replica.own._clients)


def test_requests_that_are_sent_ahead_are_answered_in_order(served_replica: Replica) -> None:
    ids = [f"x-request-id: ahead-{number}" for number in range(40)]
    requests = [served_replica.request("reset")]
    requests += [served_replica.request("act", b"{}", name) for name in ids]
    with served_replica.connect() as client:
        client.socket.sendall(b"".join(requests))
        answers = [client.answer() for _ in requests]
    assert [headers["x-request-id"] for _, headers, _ in answers[1:]] == [
        name.partition(": ")[2] for name in ids
    ]
    assert {status for status, _, _ in answers} == {200}


@pytest.mark.parametrize(
    "chunks", [[b"{}"], [b"{", b"}"], [b'{"info": {"a": "', b"b" * 99, b'"}}']]
)
def test_a_body_may_have_chunks(served_replica: Replica, chunks: list[bytes]) -> None:
    framed = [f"{len(chunk):x}\r\n".encode() + chunk + b"\r\n" for chunk in chunks]
    head = served_replica.request("reset", b"", "transfer-encoding: chunked", length=False)
    with served_replica.connect() as client:
        for _ in range(2):
            status, _, body = client.ask(head, *framed, b"0\r\n\r\n")
            assert status == 200, body


@pytest.mark.parametrize(
    "content",
    [b"1\r\nx\r\n" * 5000, b"1;a=" + b"b" * 20_000, b"0\r\n" + b"a: b\r\n" * 5000],
    ids=["small chunks", "an extension", "trailers"],
)
def test_much_around_the_chunks_ends_their_connection(
    served_replica: Replica, content: bytes
) -> None:
    head = served_replica.request("reset", b"", "transfer-encoding: chunked", length=False)
    with served_replica.connect() as client:
        status, headers, body = client.ask(head + content)
        assert (status, code_of(body), headers["connection"]) == (400, "malformed", "close")
        assert client.is_ended()


def test_a_body_is_sent_after_100_continue(served_replica: Replica) -> None:
    head = served_replica.request("reset", b"{}", "Expect: 100-continue")[:-2]
    with served_replica.connect() as client:
        client.socket.sendall(head)
        assert client.answer(has_body=False)[0] == 100
        assert client.ask(b"{}")[0] == 200


def test_a_large_form_is_read_on_another_thread(served_replica: Replica) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (700, 700, 3), np.uint8)
    head = '--edge\r\nContent-Disposition: form-data; name="{}"{}\r\n\r\n'
    form = b"".join(
        [
            head.format("obs", "").encode() + b"{}\r\n",
            head.format("cameras.front", '; filename="x"').encode(),
            jpeg_png.encode_png(pixels) + b"\r\n--edge--\r\n",
        ]
    )
    assert len(form) > 2**20
    request = served_replica.request("reset", form).replace(
        b"application/json", b"multipart/form-data; boundary=edge"
    )
    with served_replica.connect() as client:
        status, _, body = client.ask(request)
        assert status == 200, body
        assert client.ask(served_replica.request("close"))[0] == 200


@pytest.mark.parametrize(
    ("changes", "status", "code", "is_kept"),
    [
        ({"method": "GET"}, 405, "malformed", True),
        ({"method": "PUT"}, 405, "malformed", True),
        ({"path": "/v1/act"}, 404, "unknown_app", False),
        ({"path": "/"}, 404, "unknown_app", False),
        ({"path": "{own}"}, 404, "unknown_app", False),
        ({"path": "{own}/observe"}, 404, "unknown_app", False),
        ({"path": "{own}/act?a=b"}, 404, "unknown_session", True),
        ({"path": "http://127.0.0.1{own}/act"}, 404, "unknown_session", True),
        ({"version": "1.0"}, 404, "unknown_session", False),
        ({"header": "connection: close"}, 404, "unknown_session", False),
        ({"header": "upgrade: h2c\r\nconnection: upgrade"}, 404, "unknown_session", True),
        ({"header": "content-length: 2"}, 400, "malformed", False),
        ({"header": "transfer-encoding: chunked"}, 400, "malformed", False),
        ({"header": "a: " + "b" * 20_000}, 431, "malformed", False),
        ({"header": "\r\n".join(["a: b"] * 101)}, 431, "malformed", False),
        ({"header": "\n".join(["a: b"] * 101)}, 431, "malformed", False),
        ({"header": "a: b" + "\r\n b" * 101}, 431, "malformed", False),
        ({"header": "\r\n".join(["a: b"] * 90)}, 404, "unknown_session", True),
        ({"header": "host: evil.example"}, 403, "forbidden", False),
        ({"header": "origin: http://evil.example"}, 403, "forbidden", False),
        ({"body": b"x" * 2_000_000}, 413, "too_large", False),
    ],
    ids=lambda value: str(value)[:40],
)
def test_other_requests_have_the_answers_of_the_servers_port(
    changes: dict[str, Any], status: int, code: str, is_kept: bool
) -> None:
    with replica(body_bytes=1_000_000) as one, one.connect() as client:
        more = {**changes}
        header, body = more.pop("header", "a: b"), more.pop("body", b"{}")
        if "path" in more:
            more["path"] = more["path"].replace("{own}", one.own.path)
        got, headers, content = client.ask(one.request("act", body, header, **more))
        assert (got, headers["content-type"]) == (status, "application/problem+json"), content
        assert code_of(content) == code
        assert (headers.get("connection") != "close") == is_kept
        if status == 405:
            assert headers["allow"] == "POST"
        if is_kept:
            assert client.ask(one.request("reset"))[0] == 200
        else:
            assert client.is_ended()


def test_the_answer_to_head_has_no_body(served_replica: Replica) -> None:
    with served_replica.connect() as client:
        client.socket.sendall(served_replica.request("act", b"", method="HEAD"))
        assert client.answer(has_body=False)[0] == 405
        assert client.ask(served_replica.request("reset"))[0] == 200


def test_http_1_0_may_keep_its_connection(served_replica: Replica) -> None:
    request = served_replica.request("reset", b"{}", "connection: keep-alive", version="1.0")
    with served_replica.connect() as client:
        for _ in range(2):
            status, headers, _ = client.ask(request)
            assert (status, headers["connection"]) == (200, "keep-alive")


@pytest.mark.parametrize("upgrade", ["", "connection: upgrade\r\nupgrade: websocket\r\n"])
def test_a_head_with_too_many_fields_is_refused_before_it_is_parsed(
    served_replica: Replica, monkeypatch: pytest.MonkeyPatch, upgrade: str
) -> None:
    """3,200 fields took the policy's thread 190 times as long as the head of a request."""
    parsed: list[bytes] = []
    read_head = http_connection.read_head
    monkeypatch.setattr(
        http_connection, "read_head", lambda data: parsed.append(data) or read_head(data)
    )
    monkeypatch.setattr(ServerProtocol, "receive_data", lambda _self, data: parsed.append(data))
    with served_replica.connect() as client:
        fields = "a: b\r\n" * 101
        client.socket.sendall(
            f"GET / HTTP/1.1\r\nhost: localhost\r\n{upgrade}{fields}\r\n".encode()
        )
        assert client.answer()[0] == 431
        assert client.is_ended()
    assert not parsed


@pytest.mark.slow
@pytest.mark.parametrize("sent", [b"", b"POST ", "half a body"], ids=str)
def test_a_request_that_does_not_arrive_is_answered_408(
    sent: bytes | str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with replica(slow_s=SLOW_S) as one, one.connect() as client:
        assert client.ask(one.request("reset"))[0] == 200
        part = one.request("act", b"{}")[:-1] if isinstance(sent, str) else sent
        begun = time.monotonic()
        client.socket.sendall(part)
        if not part:  # an idle connection is not a request
            time.sleep(2 * SLOW_S)
            assert client.ask(one.request("act"))[0] == 200
            return
        status, headers, body = client.answer()
        assert time.monotonic() - begun >= SLOW_S
        assert (status, code_of(body), headers["connection"]) == (408, "malformed", "close")
        assert client.is_ended()


def test_connections_count_for_the_limit_of_sessions(served_replica: Replica) -> None:
    with contextlib.ExitStack() as stack:
        clients = [stack.enter_context(served_replica.connect()) for _ in range(5)]
        answers = [client.ask(served_replica.request("reset")) for client in clients]
        assert [status for status, _, _ in answers] == [200] * 4 + [503]
        assert clients[-1].is_ended()


def test_a_key_is_checked_with_each_request() -> None:
    with replica(keyed=True) as one, one.connect() as client:
        one.known.add("arm")
        shown = "authorization: Bearer vlr_arm"
        assert client.ask(one.request("reset", b"{}", shown))[0] == 200
        status, headers, body = client.ask(one.request("act"))
        assert (status, code_of(body)) == (401, "unauthorized")
        assert headers["www-authenticate"].startswith("Bearer")
        assert client.is_ended()
    wait_for(lambda: not one.own._clients)


def test_a_connection_ends_with_its_key() -> None:
    with replica(keyed=True) as one, one.connect() as client:
        one.known.add("arm")
        assert client.ask(one.request("reset", b"{}", "authorization: Bearer vlr_arm"))[0] == 200
        one.known.add("arm", revoked=True)
        assert client.is_ended()


def test_a_key_over_its_rate_is_answered_429_and_keeps_its_connection() -> None:
    with replica(keyed=True) as one, one.connect() as client:
        one.known.add("arm", rate=2)
        request = one.request("reset", b"{}", "authorization: Bearer vlr_arm")
        statuses = []
        while 429 not in statuses:
            status, headers, _ = client.ask(request)
            statuses.append(status)
            assert len(statuses) < 50
        assert headers["retry-after"]
        assert set(statuses[:-1]) == {200}
        wait_for(lambda: client.ask(request)[0] == 200)


def test_a_replica_that_drains_ends_the_connection_after_the_answer(
    served_replica: Replica,
) -> None:
    with served_replica.connect() as client:
        assert client.ask(served_replica.request("reset"))[0] == 200
        served_replica.engine.drain_list.drain()
        status, headers, _ = client.ask(served_replica.request("act"))
        assert (status, headers["connection"]) == (200, "close")
        assert client.is_ended()


@contextlib.contextmanager
def at_both_ports(
    one: Replica, address: StreamAddress | None, linked: StreamAddress | None = None
) -> Iterator[str]:
    """Yield the URL of the server's port of a replica. Its metadata contain `address` as the
    replica's own port, and its answers the same address, or `linked`.
    """
    metadata = {
        "protocol": PROTOCOL_VERSION,
        "contract": None,
        "local": None,
        "stream": address and {"port": address.port, "path": address.path},
    }
    inside = build_http_app(one.engine, lambda: metadata, one.own.limits, direct=linked or address)
    with served(AccessMiddleware(inside, None, "app")) as port:
        yield f"http://127.0.0.1:{port}"


def test_answers_at_the_servers_port_name_the_own_port(served_replica: Replica) -> None:
    with at_both_ports(served_replica, served_replica.own.address) as url:
        port = int(url.rpartition(":")[2])
        with Client(port) as client:
            _, headers, _ = client.ask(served_replica.request("reset", path="/v1/reset"))
            link = re.fullmatch(
                r'<//127\.0\.0\.1:(\d+)(/.*)/reset>; rel="alternate"', headers["link"]
            )
            assert link is not None
            assert (int(link[1]), link[2]) == (
                served_replica.own.address.port,
                served_replica.own.path,
            )
            _, headers, _ = client.ask(served_replica.request("close", path="/v1/close"))
            assert "link" not in headers
        # The session is the same at both ports.
        with Client(port) as client:
            assert client.ask(served_replica.request("reset", path="/v1/reset"))[0] == 200
        with served_replica.connect() as client:
            assert client.ask(served_replica.request("act"))[0] == 200


@pytest.mark.slow
def test_the_client_uses_the_own_port_and_the_servers_port_if_that_is_gone(
    served_replica: Replica,
) -> None:
    with at_both_ports(served_replica, served_replica.own.address) as url:
        with RemoteAgent(url, transport="http") as agent:
            agent.reset(Obs(), "push")
            agent.act(Obs())
            assert len(served_replica.own._clients) == 1
            served_replica.own._listener.close()
            served_replica.own.close_overdue()
            for client in list(served_replica.own._clients):
                client.end("the test ends it")
            wait_for(lambda: not served_replica.own._clients)
            agent.act(Obs())
        assert len(served_replica.policy.acts) == 2


def test_the_client_uses_the_own_port_of_the_replica_that_answers_in_place_of_an_ended_one(
    served_replica: Replica,
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ended = StreamAddress(listener.getsockname()[1], served_replica.own.path)
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(at_both_ports(served_replica, ended, served_replica.own.address))
        agent = stack.enter_context(RemoteAgent(url, transport="http"))
        agent.reset(Obs(), "push")
        assert not served_replica.own._clients
        agent.act(Obs())
        assert len(served_replica.own._clients) == 1


def test_an_own_port_that_does_not_serve_is_tried_once(
    served_replica: Replica, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[int | None] = []
    open_link = http._Link.open

    def note(link: http._Link, timeout_s: float) -> Any:
        opened.append(link.url.port)
        return open_link(link, timeout_s)

    monkeypatch.setattr(http._Link, "open", note)
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ended = StreamAddress(listener.getsockname()[1], served_replica.own.path)
    with at_both_ports(served_replica, ended) as url, RemoteAgent(url, transport="http") as agent:
        agent.reset(Obs(), "push")
        for _ in range(3):
            agent.act(Obs())
    assert opened.count(ended.port) == 1


def test_the_client_uses_the_servers_port_if_another_server_has_the_own_one(
    served_replica: Replica,
) -> None:
    wrong = StreamAddress(served_replica.own.address.port, "/v1/stream/of-another-server")
    with at_both_ports(served_replica, wrong) as url:
        transport = HttpTransport(url, CodecChoice("raw"))
        transport.connect(ANSWER_S)
        [reply] = transport.call([Request("reset", Obs())], ANSWER_S)
        assert reply.error is None
        transport.close()


class OwnPortWithFailures:
    """A port in front of a replica's own port. It closes each connection without an answer to its
    request until `fails` is cleared.
    """

    def __init__(self, behind: StreamAddress) -> None:
        self._behind = behind
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = StreamAddress(self._listener.getsockname()[1], behind.path)
        self.fails = threading.Event()
        self.fails.set()
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                client = self._listener.accept()[0]
                if self.fails.is_set():
                    with client:
                        client.recv(1 << 20)
                    continue
                server = socket.create_connection(("127.0.0.1", self._behind.port))
                for source, sink in ((client, server), (server, client)):
                    threading.Thread(target=self._copy, args=(source, sink), daemon=True).start()

    @staticmethod
    def _copy(source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError), sink:
            while data := source.recv(1 << 16):
                sink.sendall(data)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()


@pytest.mark.slow
@pytest.mark.parametrize("failure", ["lost call", "firewall", "full"])
def test_an_own_port_that_could_not_be_used_is_used_again_later_and_no_call_is_lost_for_it(
    served_replica: Replica, failure: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(http, "AVOIDED_S", 0.2)
    own_port = OwnPortWithFailures(served_replica.own.address)
    with contextlib.ExitStack() as stack:
        stack.callback(own_port.close)
        url = stack.enter_context(at_both_ports(served_replica, own_port.address))
        transport = HttpTransport(url, CodecChoice("raw"))
        stack.callback(transport.close)
        transport.connect(ANSWER_S)
        if failure == "lost call":
            with pytest.raises(ConnectionLost):
                transport.call([Request("reset", Obs())], ANSWER_S)
        elif failure == "firewall":
            transport._own_ports.avoid_all()
        else:
            transport._leave_direct()
        transport.connect(ANSWER_S)

        calls = []

        def call() -> bool:
            """Return whether the call used the replica's own port."""
            [reply] = transport.call([Request("reset", Obs())], ANSWER_S)
            calls.append(reply.error)
            return transport._direct is not None

        begun = time.monotonic()
        while time.monotonic() < begun + 0.6:  # time for at least one ping without an answer
            assert not call()
        own_port.fails.clear()
        wait_for(call)
        with monkeypatch.context() as without_the_servers_port:
            without_the_servers_port.setattr(transport, "_link", None)
            assert call()
        assert set(calls) == {None}


def test_a_websocket_tries_an_own_port_behind_a_firewall_again_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried = []

    def dropped(*_: Any) -> None:
        tried.append(1)
        raise TimeoutError

    monkeypatch.setattr(websocket, "Stream", dropped)
    transport = WebSocketTransport("http://127.0.0.1:1", CodecChoice("raw"))
    transport._address = StreamAddress(1, "/v1/stream/x")
    for _ in range(2):
        assert transport._direct(1.0) is None
    assert len(tried) == 1
    transport._try_own_port_at -= websocket.AVOIDED_S
    assert transport._direct(1.0) is None
    assert len(tried) == 2


def test_a_session_at_the_own_port_continues_without_the_servers_port(
    served_replica: Replica,
) -> None:
    with contextlib.ExitStack() as stack:
        url = stack.enter_context(at_both_ports(served_replica, served_replica.own.address))
        with RemoteAgent(url, transport="http") as agent:
            agent.reset(Obs(), "push")
            stack.close()
            agent.act(Obs())


@pytest.mark.parametrize(
    "answer", [b"220 mail\r\n", b"HTTP/1.1 501 No\r\ncontent-length: 0\r\n\r\n"]
)
def test_the_client_uses_the_servers_port_if_a_strange_server_has_the_own_one(
    served_replica: Replica, answer: bytes
) -> None:
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))

        def serve() -> None:
            """Answer each connection in the same way until the listener is closed."""
            with contextlib.suppress(OSError):
                while True:
                    with listener.accept()[0] as connection:
                        connection.recv(65536)
                        connection.sendall(answer)

        threading.Thread(target=serve, daemon=True).start()
        strange = StreamAddress(listener.getsockname()[1], served_replica.own.path)
        url = stack.enter_context(at_both_ports(served_replica, strange))
        with RemoteAgent(url, transport="http", timeout_s=10) as agent:
            agent.reset(Obs(), "push")
            agent.act(Obs())
        listener.shutdown(socket.SHUT_RDWR)
