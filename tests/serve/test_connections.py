"""Connections at a replica's own ports: which clients are accepted, that nothing is read before,
and when a connection must end.
"""

from __future__ import annotations

import base64
import contextlib
import gc
import logging
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from types import ModuleType
from urllib.parse import urlsplit

import numpy as np
import pytest
from asgi_server import served
from eval_fakes import wait_for
from in_flight import opened
from in_memory_keys import ChangingKeys
from probes import bytes_probe, is_probe_answer
from starlette.testclient import TestClient
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.errors import PolicyUnavailable, TooManyRequests, Unauthorized, VLAgentsError
from vlagents_ray.images import jpeg_png
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol import frame_layout
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_replies, encode_requests
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, MessageLimits, Request
from vlagents_ray.protocol.websocket_frames import ReceiveBuffer, frame_head
from vlagents_ray.serve import periodic
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import Caller, NoKey
from vlagents_ray.serve.access.charges import Account, Charge
from vlagents_ray.serve.endpoints import (
    answers,
    http_connection,
    http_messages,
    message_connection,
    own_port,
)
from vlagents_ray.serve.endpoints import shm as local
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.http_connection import HttpConnection
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.request_stream import RequestStream
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.endpoints.websocket_connection import WebSocketConnection
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.intake import Intake
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.engine.settings import EngineSettings
from vlagents_ray.serve.requests import IncomingMessage

BASE = urlsplit("http://127.0.0.1")
# Short limits for tests about these limits; other tests use long ones, so that they pass even if
# this process is paused.
SLOW_S, IDLE_S = 0.4, 3.0


class Seen(list[str | None]):
    """The instructions and marks that reached the policy, in all sessions."""


class Witness(Agent):
    """A policy that records the requests that reach it, and can be blocked."""

    def __init__(self) -> None:
        self.seen, self.hold, self.acting = Seen(), threading.Event(), threading.Event()
        self.hold.set()

    def shared_objects(self) -> list[object]:
        return [self.seen, self.hold, self.acting]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, object]:
        self.seen.append(instruction)
        return {}

    def act(self, obs: Obs) -> Act:
        self.acting.set()
        self.hold.wait(60)
        return Act(np.zeros(2, np.float32))


@dataclass
class Replica:
    engine: Engine
    policy: Witness
    known: ChangingKeys
    own: OwnPortServer
    local: ShmServer
    clients: contextlib.ExitStack

    def stream(self, token: str | None = None) -> Stream:
        client = Stream(BASE, self.own.address.port, self.own.address.path, 5, shown(token))
        self.clients.callback(client.close)
        return client

    def shm(self, token: str) -> ShmTransport:
        client = ShmTransport(self.local.address, Credentials(token))
        client.connect(5)
        self.clients.callback(client.close)
        return client


def shown(token: str | None) -> dict[str, str]:
    return {} if token is None else {"Authorization": f"Bearer {token}"}


@contextlib.contextmanager
def replica(*, keyed: bool = True, slow_s: float = 60.0, idle_s: float = 60.0) -> Iterator[Replica]:
    known, policy = ChangingKeys(), Witness()
    engine = Engine(policy, EngineSettings(session_limit=8))
    check_key = (lambda token: known.keys.check(token, "app")) if keyed else NoKey.OPEN
    own = OwnPortServer(
        engine, MessageLimits(), "127.0.0.1", None, check_key, slow_s=slow_s, idle_s=idle_s
    )
    near = ShmServer(engine, MessageLimits(), check_key)
    own.open()
    near.open()
    engine.start()
    clients = contextlib.ExitStack()
    try:
        yield Replica(engine, policy, known, own, near, clients)
    finally:
        clients.close()
        policy.hold.set()
        engine.close()
        own.close()
        near.close()


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "_CHECK_S", 0.0)
    monkeypatch.setattr(periodic.each_half_second, "_period_s", 0.02)
    # Time for a client to read the reason why its connection ends; many here never read it.
    monkeypatch.setattr(message_connection, "_CLOSING_S", 0.5)


@pytest.fixture
def keyed() -> Iterator[Replica]:
    with replica() as one:
        yield one


def handshake(path: str, *headers: str) -> bytes:
    lines = [f"GET {path} HTTP/1.1", "Host: 127.0.0.1", "Upgrade: websocket", "Connection: Upgrade"]
    lines += [
        f"Sec-WebSocket-Key: {base64.b64encode(os.urandom(16)).decode()}",
        "Sec-WebSocket-Version: 13",
        *headers,
    ]
    return "\r\n".join([*lines, "", ""]).encode()


def frame(payload: bytes) -> bytes:
    mask = os.urandom(4)
    head = bytes([0x82, 0x80 | 126]) + struct.pack(">H", len(payload))
    return head + mask + bytes(byte ^ mask[i % 4] for i, byte in enumerate(payload))


RESET = frame(
    encode_requests([Request("reset", Obs(), "move to the human", session="arm/robot-1")])
)


def answer(port: int, *segments: bytes) -> bytes:
    """Return all bytes that the server sends before it closes the connection."""
    said = b""
    with socket.create_connection(("127.0.0.1", port)) as attacker, contextlib.suppress(OSError):
        attacker.settimeout(60)
        for segment in segments:
            attacker.sendall(segment)
        while more := attacker.recv(65536):
            said += more
    return said


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize(
    ("path", "headers", "status"),
    [
        ("/no/such/path", [], 404),
        ("", [], 401),
        ("", ["Authorization: Bearer wrong"], 401),
        ("", ["Authorization: Bearer vlr_elsewhere"], 403),
        ("", ["Authorization: Bearer vlr_leaver"], 401),
    ],
)
def test_what_comes_with_a_refused_handshake_is_not_read(
    keyed: Replica, path: str, headers: list[str], status: int, apart: bool
) -> None:
    keyed.known.add("arm")
    keyed.known.add("elsewhere", apps=["other"])
    keyed.known.add("leaver", revoked=True)
    hello = handshake(path or keyed.own.path, *headers)
    said = answer(keyed.own.address.port, *((hello, RESET) if apart else (hello + RESET + RESET,)))
    assert said.startswith(f"HTTP/1.1 {status}".encode())
    wait_for(lambda: not keyed.own._clients)
    assert keyed.policy.seen == []
    assert len(keyed.engine.sessions) == 0


def test_a_page_of_another_site_has_nothing_read_either() -> None:
    with replica(keyed=False) as opened:
        said = answer(
            opened.own.address.port,
            handshake(opened.own.path, "Origin: https://evil.example") + RESET,
        )
        assert said.startswith(b"HTTP/1.1 403")
        assert opened.policy.seen == []


@pytest.mark.parametrize("cut", [0, 1, 20, -1])
def test_what_comes_with_a_right_handshake_is_read(keyed: Replica, cut: int) -> None:
    token = keyed.known.add("arm")
    whole = handshake(keyed.own.path, f"Authorization: Bearer {token}") + RESET
    with socket.create_connection(("127.0.0.1", keyed.own.address.port)) as client:
        for part in (whole[:cut], whole[cut:]):
            client.sendall(part)
            time.sleep(0.02)
        wait_for(lambda: keyed.policy.seen == ["move to the human"])


def test_who_forgets_to_say_whose_requests_they_are_fails(keyed: Replica) -> None:
    with pytest.raises(TypeError, match="caller"):
        Sender(keyed.engine, "http", has_left=None)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="expected a Caller"):
        Sender(keyed.engine, "http", caller=None, has_left=None)  # type: ignore[arg-type]
    unguarded = TestClient(
        build_http_app(keyed.engine, dict, MessageLimits()), raise_server_exceptions=False
    )
    assert (
        unguarded.post("/v1/reset", json={"obs": {}}, headers={"x-session-id": "a"}).status_code
        == 500
    )
    assert keyed.policy.seen == []


def listen_to_the_end(client: Stream) -> None:
    while True:
        client.recv(5)


def half(payload: int) -> bytes:
    """Return a frame's header and part of the announced payload."""
    return (
        bytes([0x82, 0x80 | 127])
        + struct.pack(">Q", payload)
        + b"\0\0\0\0"
        + b"\0" * (payload // 2)
    )


def test_half_a_message_is_not_waited_for() -> None:
    with replica(slow_s=SLOW_S) as keyed:
        token = keyed.known.add("arm")
        good, bad = keyed.stream(token), keyed.stream(token)
        bad._socket.sendall(half(2**20))
        wait_for(lambda: len(keyed.own._clients) == 1)
        assert sum(client._received.size for client in keyed.own._clients) == 0
        good.send(bytes_probe(100), 5)
        assert good.recv(5)


NO_HANDSHAKE = [RESET, b"GET / HTTP/1.1\r\n" + RESET, b"\r\n\r\n" + RESET, b"\0" * 40_000]


@pytest.mark.slow
@pytest.mark.parametrize(
    "first", [b"", b"GET / HTTP/1.1\r\nHost: x\r\n", *NO_HANDSHAKE], ids=range(6)
)
def test_what_comes_without_a_handshake_is_cut_off_and_not_read(
    keyed: Replica, first: bytes, monkeypatch
) -> None:
    monkeypatch.setattr(own_port, "_HANDSHAKE_S", 0.2)
    silent = [socket.create_connection(("127.0.0.1", keyed.own.address.port)) for _ in range(20)]
    for each in silent:
        with contextlib.suppress(OSError):  # the server may close the connection in the meantime
            each.sendall(first)
    assert not answer(keyed.own.address.port, first).startswith(b"HTTP/1.1 101")
    wait_for(lambda: not keyed.own._clients)
    assert keyed.policy.seen == []
    for each in silent:
        each.close()


@pytest.mark.slow
def test_a_silent_connection_ends_and_none_that_is_used_or_that_the_policy_keeps_waiting() -> None:
    """While the policy is busy, the missing reads are the server's, so the connection does not
    count as silent.
    """
    with (
        replica(slow_s=SLOW_S, idle_s=IDLE_S) as quiet,
        replica(slow_s=SLOW_S, idle_s=IDLE_S) as busy,
    ):
        token = busy.known.add("arm")
        other, waiting = busy.stream(token), busy.stream(token)
        for client in (other, waiting):
            client.send(encode_requests([Request("reset", Obs())]), 5)
            client.recv(5)
        busy.policy.hold.clear()
        other.send(encode_requests([Request("act", Obs())]), 5)
        assert busy.policy.acting.wait(5)
        waiting._socket.sendall(
            frame(encode_requests([Request("act", Obs(info={"much": bytes(20_000)}))]))
        )
        token = quiet.known.add("arm")
        silent, used = quiet.stream(token), quiet.stream(token)
        begun = time.monotonic()
        while len(quiet.own._clients) > 1 or time.monotonic() - begun < 1.5 * IDLE_S:
            used.send(bytes_probe(100), 5)
            assert used.recv(5)
            time.sleep(0.02)
            assert time.monotonic() - begun < 60
        with pytest.raises((ConnectionClosed, OSError), match="silent"):
            listen_to_the_end(silent)
        busy.policy.hold.set()
        for client in (other, waiting):
            assert decode_replies(client.recv(5))[0].error is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "said"),
    [({"revoked": True}, "revoked"), ({"expires": 1.0}, "expired"), ({"apps": ["x"]}, "not for")],
)
def test_connections_end_with_their_key_and_no_others(
    keyed: Replica, change: dict[str, object], said: str
) -> None:
    token, other = keyed.known.add("arm"), keyed.known.add("lab")
    own, near = keyed.stream(token), keyed.shm(token)
    bystander, beside = keyed.stream(other), keyed.shm(other)
    for transport in (near, beside):
        assert transport.call([Request("reset", Obs())], 5)[0].error is None
    keyed.known.change("arm", **change)
    wait_for(lambda: len(keyed.own._clients) == len(keyed.local._clients) == 1)
    assert [name.partition("/")[0] for name in keyed.engine.sessions.ids()] == ["lab"]
    with pytest.raises((ConnectionClosed, OSError), match=said):
        listen_to_the_end(own)
    bystander.send(bytes_probe(10), 5)
    assert bystander.recv(5)
    assert beside.call([Request("act", Obs())], 5)[0].error is None


def test_a_revoked_key_is_cut_off_while_the_policy_takes_long(keyed: Replica) -> None:
    token, other = keyed.known.add("arm"), keyed.known.add("lab")
    busy, leaver = keyed.stream(other), keyed.stream(token)
    busy.send(encode_requests([Request("reset", Obs())]), 5)
    busy.recv(5)
    keyed.policy.hold.clear()
    busy.send(encode_requests([Request("act", Obs())]), 5)
    assert keyed.policy.acting.wait(5)
    keyed.known.change("arm", revoked=True)
    with pytest.raises((ConnectionClosed, OSError)):
        listen_to_the_end(leaver)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["own", "shm"])
def test_a_key_has_no_more_connections_than_sessions(keyed: Replica, way: str) -> None:
    token, other = keyed.known.add("arm", sessions=2), keyed.known.add("lab")
    first, second = keyed.stream(token), keyed.shm(token)
    for _ in range(3):
        if way == "own":
            with pytest.raises(InvalidStatus) as refused:
                keyed.stream(token)
            assert refused.value.response.status_code == 429
        else:
            third = keyed.shm(token)
            for _ in range(3):
                assert isinstance(
                    third.call([Request("reset", Obs(), request_id="r")], 5)[0].error,
                    TooManyRequests,
                )
            keyed.known.change("arm", sessions=3)
            wait_for(
                lambda: third.call([Request("reset", Obs(), request_id="s")], 5)[0].error is None  # noqa: B023
            )
            keyed.known.change("arm", sessions=2)
            third.close()
            wait_for(lambda: len(keyed.local._clients) == 1)
    keyed.stream(other).close()
    second.close()
    wait_for(lambda: not keyed.local._clients)
    again = keyed.stream(token) if way == "own" else keyed.shm(token)
    again.close()
    first.close()
    wait_for(lambda: not keyed.own._clients and not keyed.local._clients)
    wait_for(lambda: not keyed.known.keys._connections)


@pytest.mark.slow
def test_a_local_client_shows_its_key_soon(keyed: Replica, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(local, "_KEY_S", 0.3)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as silent:
        silent.connect(f"\0{keyed.local.address.socket}")
        silent.settimeout(60)
        assert silent.recv(100) == b""
    monkeypatch.setattr(local, "_KEY_S", 3.0)
    wrong = keyed.shm("wrong")
    assert isinstance(wrong.call([Request("reset", Obs())], 5)[0].error, Unauthorized)
    wait_for(lambda: not keyed.local._clients)
    assert keyed.policy.seen == []


def test_the_proxied_port_counts_a_keys_connections_too(
    keyed: Replica, serving: Callable[..., str]
) -> None:
    token = keyed.known.add("arm", sessions=1)
    url = serving(keyed.engine, keyed.known.keys)
    with (
        connect(url, additional_headers=shown(token)),
        pytest.raises(InvalidStatus) as refused,
        connect(url, additional_headers=shown(token)),
    ):
        pytest.fail("the client was accepted")
    assert refused.value.response.status_code == 429
    wait_for(lambda: not keyed.known.keys._connections)
    with connect(url, additional_headers=shown(token)) as again:
        again.ping().wait(5)


@pytest.fixture
def serving() -> Iterator[Callable[..., str]]:
    with contextlib.ExitStack() as stack:

        def start(engine: Engine, keys: api_keys.Keys) -> str:
            port = stack.enter_context(
                served(AccessMiddleware(build_http_app(engine, dict, MessageLimits()), keys, "app"))
            )
            return f"ws://127.0.0.1:{port}/v1/stream"

        yield start


def test_a_full_replica_turns_away_before_it_accepts_and_says_why(keyed: Replica) -> None:
    token = keyed.known.add("arm")
    held = [keyed.stream(token) for _ in range(8)]
    with pytest.raises(InvalidStatus) as refused:
        keyed.stream(token)
    assert refused.value.response.status_code == 503
    assert b"limit of sessions" in (refused.value.response.body or b"")
    assert len(held) == 8


def test_a_client_goes_through_the_proxy_where_the_replicas_own_port_is_full(
    keyed: Replica,
) -> None:
    token = keyed.known.add("arm")
    about = {
        "policy": "p",
        "version": "0",
        "protocol": PROTOCOL_VERSION,
        "stream": asdict(keyed.own.address),
    }
    inside = build_http_app(keyed.engine, lambda: about, MessageLimits())
    with served(AccessMiddleware(inside, keyed.known.keys, "app")) as port:

        def agent() -> RemoteAgent:
            return RemoteAgent(f"http://127.0.0.1:{port}", transport="websocket", api_key=token)

        with agent() as direct:
            direct.reset(Obs(), "x")
            assert len(keyed.own._clients) == 1
        wait_for(lambda: not keyed.own._clients)
        for _ in range(8):
            keyed.stream(token)
        with agent() as proxied:
            proxied.reset(Obs(), "x")
            proxied.act(Obs())
            assert len(keyed.own._clients) == 8


def test_a_full_replica_closes_a_proxied_websocket_with_its_reason(
    keyed: Replica, serving: Callable[..., str]
) -> None:
    token = keyed.known.add("arm")
    for number in range(8):
        opened(keyed.engine.sessions, f"lab/{number}")
    with connect(serving(keyed.engine, keyed.known.keys), additional_headers=shown(token)) as late:
        assert isinstance(decode_replies(late.recv(5))[0].error, PolicyUnavailable)
        with pytest.raises(ConnectionClosed) as closed:
            late.recv(5)
    assert closed.value.rcvd.code == 1013
    assert "its limit; close one, or raise sessions.limit" in closed.value.rcvd.reason


@pytest.mark.parametrize("size", [8, 5_000, 100_000])
def test_a_probe_is_answered_without_a_session_and_a_broken_one_leaves_the_stream_as_it_was(
    keyed: Replica, size: int
) -> None:
    probe = bytes_probe(size)
    app = build_http_app(keyed.engine, dict, MessageLimits(body_bytes=100_000))
    with (
        served(AccessMiddleware(app, None, "app")) as port,
        connect(f"ws://127.0.0.1:{port}/v1/stream", max_size=None) as stream,
    ):
        stream.send(probe)
        assert is_probe_answer(stream.recv(10), probe)
        assert len(keyed.engine.sessions) == 0
        stream.send(b"VLA?\0\0")
        error = decode_replies(stream.recv(10))[0].error
        assert error.code == "malformed"
        stream.send(encode_requests([Request("reset", Obs())]))
        assert decode_replies(stream.recv(10))[0].error is None
    assert not keyed.policy.acting.is_set()


FAULTS = [
    (Intake, "reserve"),
    (Account, "charge"),
    (Charge, "require"),
    (Charge, "cover"),
    (Sender, "send"),
    (Caller, "throttled_s"),
    (Sender, "release"),
    (IncomingMessage, "decoded"),
    (answers, "as_frame"),
    (answers, "as_compact"),
    (MessageAdmission, "begin_message"),
    (MessageAdmission, "begin"),
    (MessageAdmission, "hold"),
    (MessageAdmission, "decode_on_thread"),
    (ReceiveBuffer, "parse"),
    (WebSocketConnection, "_read"),
    (own_port.PortConnection, "_accept_handshake"),
    (WebSocketConnection, "_process_messages"),
    (RequestStream, "receive"),
    (RequestStream, "_submit"),
    (WebSocketConnection, "_count_partial"),
    (WebSocketConnection, "overdue"),
    (own_port.OwnPortServer, "identify"),
    (local.UnixConnection, "_read"),
    (local.UnixConnection, "_submit"),
    (local.UnixConnection, "_authenticate"),
    (local.UnixConnection, "overdue"),
]
# Faults of an HTTP connection at the replica's own port.
HTTP_FAULTS = [
    (Intake, "reserve"),
    (http_connection, "message_admission"),
    (Sender, "send"),
    (Caller, "throttled_s"),
    (MessageAdmission, "decode_on_thread"),
    (own_port.OwnPortServer, "identify_request"),
    (own_port.OwnPortServer, "serve_http"),
    (http_connection, "read_head"),
    (http_messages, "response_to"),
    (http_messages, "body_of"),
    (HttpConnection, "begin"),
    (HttpConnection, "_receive_body"),
    (HttpConnection, "_count_incomplete"),
    (HttpConnection, "_complete"),
    (HttpConnection, "_submit"),
    (HttpConnection, "_send_answer"),
    (HttpConnection, "overdue"),
]


@pytest.fixture
def no_records() -> Iterator[None]:
    """Disable logging, since tracebacks in log records would keep references to messages."""
    logging.disable(logging.CRITICAL)
    yield
    logging.disable(logging.NOTSET)


def open_sockets() -> int:
    """Return the number of sockets of this process."""
    folder = "/proc/self/fd"
    files = []
    for name in os.listdir(folder):
        with contextlib.suppress(FileNotFoundError):  # the descriptor of the listed folder itself
            files.append(os.readlink(f"{folder}/{name}"))
    return sum(file.startswith("socket:") for file in files)


def frame_of(data: bytes) -> bytes:
    """Return a frame of any size with a fixed mask."""
    return frame_head(len(data), bytes(4)) + data


def post(path: str, body: bytes, length: int | None = None) -> bytes:
    """Return an HTTP request with the key "arm". Its body may be shorter than `length`."""
    lines = [
        f"POST {path} HTTP/1.1",
        "host: 127.0.0.1",
        "authorization: Bearer vlr_arm",
        "x-session-id: robot-1",
        f"content-type: {CONTENT_TYPE}",
        f"content-length: {len(body) if length is None else length}",
    ]
    return "\r\n".join([*lines, "", ""]).encode() + body


def reset_over_shm(keyed: Replica) -> None:
    """Send a large reset with the key "arm", and ignore its answer."""
    client = ShmTransport(keyed.local.address, Credentials("vlr_arm"))
    with contextlib.suppress(VLAgentsError, OSError):
        client.connect(1)
        client.call([Request("reset", Obs({"front": np.zeros((1100, 1100, 3), np.uint8)}))], 0.3)
    client.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("owner", "name", "over_http"),
    [
        *((owner, name, False) for owner, name in FAULTS),
        *((owner, name, True) for owner, name in HTTP_FAULTS),
    ],
    ids=lambda value: getattr(value, "__name__", str(value)),
)
def test_an_unexpected_error_anywhere_ends_that_connection_and_nothing_else(
    keyed: Replica,
    owner: type | ModuleType,
    name: str,
    over_http: bool,
    monkeypatch: pytest.MonkeyPatch,
    no_records: None,
) -> None:
    """The error is raised in callbacks of sockets and timers, and in the threads that decode and
    answer.
    """
    keyed.known.add("arm", rate=4)
    bystander = keyed.shm(keyed.known.add("lab"))
    assert bystander.call([Request("reset", Obs())], 5)[0].error is None
    port = keyed.own.address.port
    large = jpeg_png.encode_jpeg(np.zeros((1100, 1100, 3), np.uint8))
    seen = {"cameras": {"front": {"$": ["img", 0]}}}
    decoded_on_a_thread = b"".join(frame_layout.pack({"op": "reset", "obs": seen}, [large]))
    over_the_rate = [frame_of(encode_requests([Request("act", Obs())]))] * 6
    part = frame_head(2**22, bytes(4)) + bytes(100_000)
    messages = b"".join([RESET, frame_of(decoded_on_a_thread), *over_the_rate, part])
    data = handshake(keyed.own.path, "Authorization: Bearer vlr_arm") + messages
    if over_http:
        reset, act = f"{keyed.own.path}/reset", f"{keyed.own.path}/act"
        requests = [post(reset, decoded_on_a_thread)]
        requests += [post(act, encode_requests([Request("act", Obs())]))] * 6
        data = b"".join([*requests, post(act, bytes(100_000), 2**22)])
    sockets = open_sockets()
    raised = threading.Event()

    def fail(*_: object, **__: object) -> None:
        raised.set()
        raise RuntimeError("injected")

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, fail)
        for _attempt in range(3):
            near = threading.Thread(target=reset_over_shm, args=(keyed,))
            near.start()
            with (
                socket.create_connection(("127.0.0.1", port)) as client,
                contextlib.suppress(OSError),
            ):
                client.sendall(data)
                client.settimeout(0.3)
                while client.recv(65536):
                    pass
            near.join()
        assert raised.wait(10)
    assert bystander.call([Request("reset", Obs())], 5)[0].error is None or name in (
        "release",
        "overdue",
    )
    wait_for(lambda: not keyed.own._clients and len(keyed.local._clients) <= 1, 20)
    gc.collect()
    wait_for(lambda: keyed.engine.admission.held == 0, 20)
    wait_for(lambda: open_sockets() <= sockets, 20)
    wait_for(lambda: "arm" not in keyed.known.keys._connections, 20)


def test_a_look_that_fails_is_followed_by_the_next(caplog: pytest.LogCaptureFixture) -> None:
    looks = periodic.Periodic(0.01)
    done: list[int] = []

    def fail() -> None:
        done.append(1)
        raise RuntimeError("once more")

    looks.add(fail)
    wait_for(lambda: len(done) > 2)
    looks.remove(fail)
    assert looks._thread is None
    assert "once more" in caplog.text
