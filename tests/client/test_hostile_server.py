"""Servers that send values of wrong types, or answer byte by byte: a client raises the package's
errors in time.
"""

from __future__ import annotations

import contextlib
import copy
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import InvalidHandshake

from vlagents_ray import Act, Obs, RemoteAgent, VLAgentsError
from vlagents_ray.chunking.choice import choose_for
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.websocket import ProxiedSocket
from vlagents_ray.errors import BY_CODE
from vlagents_ray.protocol.frame_layout import pack, unpack
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_replies, encode_replies
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, PROTOCOL_VERSION, Reply
from vlagents_ray_dialects.upstream.client import ClientOptions
from vlagents_ray_dialects.upstream.http import OpenVLAClient

METADATA: dict[str, Any] = {
    "protocol": PROTOCOL_VERSION,
    "policy": "p",
    "version": "0",
    "contract": None,
    "continues_plans": False,
    "longest_prefix": 0,
    "local": None,
    "stream": None,
    "weights": {
        "digest": "d",
        "statistics": {"state": {"min": [0.0], "max": [1.0]}},
        "success": [
            {
                "env": "tabletop",
                "hz": 20.0,
                "mode": "async",
                "settings": {"execute": 4},
                "weights": "d",
                "delays": [{"rows": 0, "solved": 9, "episodes": 10, "ticks": 25.0}],
            }
        ],
    },
    "policy_version": {"newest": {"version": 0, "fingerprint": "f"}},
}
ADDRESSES = {
    "local": {"socket": "vlagents-ray-none", "boot_id": "another machine", "keyed": False},
    "stream": {"port": 1, "path": "/v1/stream/x"},
}
# A value of each JSON type, references to blobs, and numbers beyond the range of C's types.
VALUES: list[Any] = [
    None,
    True,
    0,
    -1,
    1.5,
    1e308,
    10**30,
    "",
    "x",
    "\r\nx: y",
    [],
    [1],
    {},
    {"a": 1},
    [[[[[[[[[[1]]]]]]]]]],
    {"$": ["nd", 0, "<f4", [7]]},
    {"$": ["nd", 0, "|O", [1]]},
    {"$": ["nd", 0, "<U1", [7]]},
    {"$": ["bin", 0]},
    {"$": ["img", 0]},
    {"$": ["float", "nan"]},
    {"$": []},
]
TIME_LIMIT_S = 1.0
DRIP_S = 0.2  # time between two bytes


def places(node: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path of each node of a JSON document."""
    yield at
    children = (
        node.items()
        if isinstance(node, dict)
        else enumerate(node)
        if isinstance(node, list)
        else ()
    )
    for name, child in children:
        yield from places(child, (*at, name))


def replaced(document: Any, at: tuple[Any, ...], value: Any) -> Any:
    if not at:
        return value
    changed = copy.deepcopy(document)
    node = changed
    for name in at[:-1]:
        node = node[name]
    node[at[-1]] = value
    return changed


def frame(header: dict[str, Any], blobs: list[Any]) -> bytes:
    return b"".join(pack(header, blobs))


GOOD_REPLY = encode_replies(
    [
        Reply(
            "r",
            act=Act(np.zeros(7, np.float32), False, {"a": 1, "b": np.zeros(3)}),
            step=3,
            timing={"total_ms": 1.0},
        )
    ]
)
ERROR_REPLY = encode_replies([Reply("r", error=VLAgentsError("x"))])


@pytest.mark.parametrize("reply", [GOOD_REPLY, ERROR_REPLY], ids=["act", "error"])
def test_a_reply_with_a_value_of_any_type_at_any_place_is_read_or_malformed(reply: bytes) -> None:
    header, blobs = unpack(reply, DEFAULT_LIMITS)
    header.pop("blobs", None)
    tried = 0
    for at in places(header):
        for value in VALUES:
            changed = replaced(header, at, value)
            if not isinstance(changed, dict):
                continue
            tried += 1
            with contextlib.suppress(VLAgentsError):
                [read] = decode_replies(frame(changed, [bytes(blob) for blob in blobs]))
                assert read.act is None or (
                    type(read.act.action) is np.ndarray and type(read.act.info) is dict
                )
                assert read.info is None or type(read.info) is dict
                assert all(type(number) in (int, float) for number in read.timing.values())
    assert tried > 50


@contextlib.contextmanager
def tcp_server(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """Run `answer` in a thread for each connection, and yield the port."""
    connections: list[socket.socket] = []

    def run(connection: socket.socket) -> None:
        with contextlib.suppress(OSError), connection:
            answer(connection)

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = listener.accept()
                connections.append(connection)
                threading.Thread(target=run, args=(connection,), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        threading.Thread(target=accept, daemon=True).start()
        try:
            yield listener.getsockname()[1]
        finally:
            listener.shutdown(socket.SHUT_RDWR)
            for connection in connections:
                connection.close()


def read_request(connection: socket.socket) -> str:
    """Read one request, and return its path."""
    data = b""
    while b"\r\n\r\n" not in data:
        data += received(connection)
    head, _, body = data.partition(b"\r\n\r\n")
    lengths = [
        line.split(b":")[1]
        for line in head.split(b"\r\n")
        if line.lower().startswith(b"content-length:")
    ]
    while lengths and len(body) < int(lengths[0]):
        body += received(connection)
    return head.split()[1].decode()


def received(connection: socket.socket) -> bytes:
    data = connection.recv(65536)
    if not data:
        raise OSError("the client has closed the connection")
    return data


def response(body: bytes, media_type: str, status: str = "200 OK") -> bytes:
    head = f"HTTP/1.1 {status}\r\ncontent-type: {media_type}\r\ncontent-length: {len(body)}\r\n\r\n"
    return head.encode() + body


@pytest.mark.parametrize(
    "status", ["301 Moved", "302 Found", "303 See", "307 Temporary", "308 Permanent"]
)
def test_a_websocket_follows_no_redirect(status: str) -> None:
    """A server behind TLS could send its robot to an address without TLS."""
    reached = threading.Event()
    with tcp_server(lambda _: reached.set()) as other:

        def answer(connection: socket.socket) -> None:
            read_request(connection)
            target = f"ws://127.0.0.1:{other}/"
            connection.sendall(
                f"HTTP/1.1 {status}\r\nlocation: {target}\r\ncontent-length: 0\r\n\r\n".encode()
            )

        with (
            tcp_server(answer) as port,
            pytest.raises(InvalidHandshake, match="redirects to 'ws://127"),
        ):
            ProxiedSocket(f"ws://127.0.0.1:{port}/v1/stream", Credentials(), 5)
    assert not reached.is_set()


def test_metadata_of_megabytes_are_not_parsed() -> None:
    """Parsing takes longer than the time limit of the call."""
    large = json.dumps({**METADATA, "weights": {"digest": "x" * 5 * 2**20}}).encode()
    with (
        http_policy(large, GOOD_REPLY) as url,
        pytest.raises(VLAgentsError),
        RemoteAgent(url, timeout_s=2, transport="http") as agent,
    ):
        agent.reset(Obs(), "x")


@contextlib.contextmanager
def http_policy(metadata: Any, act: bytes, status: str = "200 OK") -> Iterator[str]:
    """Serve metadata, answer resets, and answer one act with `act` and `status`; yield the URL."""
    document = metadata if isinstance(metadata, bytes) else json.dumps(metadata).encode()
    answers = {
        "/v1/metadata": response(document, "application/json"),
        "/v1/reset": response(frame({"request_id": "r", "info": {}}, []), CONTENT_TYPE),
        "/v1/act": response(
            act, CONTENT_TYPE if status == "200 OK" else "application/problem+json", status
        ),
    }

    def answer(connection: socket.socket) -> None:
        while True:
            connection.sendall(
                answers.get(read_request(connection), response(b"", "text/plain", "403 Forbidden"))
            )

    with tcp_server(answer) as port:
        yield f"http://127.0.0.1:{port}"


def act_once(url: str, transport: str = "http") -> Act:
    with RemoteAgent(
        url, transport=transport, timeout_s=TIME_LIMIT_S, connect_timeout_s=TIME_LIMIT_S
    ) as agent:
        agent.initialize()
        choose_for(agent, hz=20.0, delay_s=0.0)
        agent.reset(Obs(), "x")
        return agent.act(Obs())


def test_the_honest_server_of_these_tests_is_understood() -> None:
    with http_policy(METADATA, GOOD_REPLY) as url:
        assert act_once(url).action.shape == (7,)
        with RemoteAgent(url, transport="http") as agent:
            [curve] = agent.success_curves
    assert curve.to_json() == METADATA["weights"]["success"][0]


@pytest.mark.parametrize("version", ["newest", "pinned"])
def test_a_checkpoint_whose_weights_were_replaced_has_no_measured_success(version: str) -> None:
    replaced_version = {version: {"version": 1, "fingerprint": "g"}}
    versions = METADATA["policy_version"] | replaced_version
    with (
        http_policy(METADATA | {"policy_version": versions}, GOOD_REPLY) as url,
        RemoteAgent(url, transport="http") as agent,
    ):
        assert not agent.success_curves


@pytest.mark.slow
@pytest.mark.parametrize("entry", sorted(METADATA))
def test_metadata_with_a_value_of_any_type_is_read_or_an_error_of_the_package(entry: str) -> None:
    document = METADATA | ADDRESSES
    for at in places(document[entry]):
        for value in VALUES:
            metadata = replaced(document, (entry, *at), value)
            for transport in ("http", "auto", "websocket") if entry in ADDRESSES else ("http",):
                with http_policy(metadata, GOOD_REPLY) as url, contextlib.suppress(VLAgentsError):
                    act_once(url, transport)


@pytest.mark.slow
@pytest.mark.parametrize("error", [VLAgentsError, *sorted(BY_CODE.values(), key=repr)])
def test_text_of_a_server_neither_commands_a_terminal_nor_forges_a_line(
    error: type[VLAgentsError],
) -> None:
    detail = (
        "\x1b[2J\x1b]52;c;ZXZpbA==\x07 \x9b31m \u202e\r\n2026-11-28 INFO robot: restarted by anna"
    )
    problem = {"code": error.code, "detail": detail}
    with http_policy(METADATA, json.dumps(problem).encode(), "403 Forbidden") as url:
        with pytest.raises(VLAgentsError) as raised:
            act_once(url)
        first, *further = str(raised.value).split("\n")
    assert all(character.isprintable() for line in [first, *further] for character in line)
    assert all(line.startswith("  ") for line in further)


@pytest.mark.parametrize("status", ["200 OK", "500 Internal Server Error"])
def test_deeply_nested_json_is_an_error_of_the_package(status: str) -> None:
    nested = b"[" * 100_000
    with http_policy(METADATA, nested, status) as url, pytest.raises(VLAgentsError):
        act_once(url)
    with http_policy(nested, GOOD_REPLY) as url, pytest.raises(VLAgentsError):
        act_once(url)


def drip(connection: socket.socket, data: bytes) -> None:
    """Send one byte after the other, for longer than any client's time limit."""
    for byte in data * 100:
        connection.sendall(bytes([byte]))
        time.sleep(DRIP_S)


def drip_at(state: str, metadata: bytes) -> Callable[[socket.socket], None]:
    """Return a server that answers byte by byte from the given `state` of the answer to a reset."""
    complete = {
        "status line": b"",
        "headers": b"HTTP/1.1 200 OK\r\n",
        "body": b"HTTP/1.1 200 OK\r\ncontent-length: 1000000\r\n\r\n",
        "chunks": b"HTTP/1.1 200 OK\r\ntransfer-encoding: chunked\r\n\r\n",
        "informational": b"",
    }[state]
    rest = {
        "status line": b"HTTP/1.1 200 OK",
        "headers": b"x: yyyyyyyyyy\r\n",
        "body": b" ",
        "chunks": b"1\r\nx\r\n",
        "informational": b"HTTP/1.1 100 Continue\r\n\r\n",
    }[state]

    def answer(connection: socket.socket) -> None:
        while read_request(connection) == "/v1/metadata":
            connection.sendall(metadata)
        connection.sendall(complete)
        drip(connection, rest)

    return answer


def act_upstream(url: str) -> None:
    client = OpenVLAClient(ClientOptions(url, TIME_LIMIT_S))
    client.connect(TIME_LIMIT_S)
    client.ask([{"image": np.zeros((8, 8, 3), np.uint8), "instruction": "x"}])


STATES = ["status line", "headers", "body", "chunks", "informational"]


@pytest.mark.slow
@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("client", ["remote agent", "upstream"])
def test_a_server_that_answers_byte_by_byte_keeps_no_client_beyond_its_time(
    client: str, state: str
) -> None:
    metadata = response(json.dumps(METADATA).encode(), "application/json")
    with tcp_server(drip_at(state, metadata)) as port:
        url = f"http://127.0.0.1:{port}"
        begun = time.monotonic()
        with pytest.raises(VLAgentsError, match="no answer within 1 s"):
            act_once(url) if client == "remote agent" else act_upstream(url)
        # Without the limit, the answer would take 100 times as long as its first bytes.
        assert time.monotonic() - begun < 20 * TIME_LIMIT_S


@pytest.mark.slow
@pytest.mark.parametrize("transport", ["websocket", "auto"])
def test_a_websocket_whose_handshake_arrives_byte_by_byte_keeps_no_client_beyond_its_time(
    transport: str,
) -> None:
    metadata = response(json.dumps(METADATA).encode(), "application/json")

    def answer(connection: socket.socket) -> None:
        while read_request(connection) == "/v1/metadata":
            connection.sendall(metadata)
        drip(connection, b"HTTP/1.1 101 Switching Protocols\r\n")

    with tcp_server(answer) as port, pytest.raises(VLAgentsError):
        act_once(f"http://127.0.0.1:{port}", transport)
