"""What a server keeps of clients' messages is bounded in bytes, however many the largest messages are."""

from __future__ import annotations

import contextlib
import gc
import queue
import socket
import struct
from collections.abc import Iterator
from dataclasses import asdict
from urllib.parse import urlsplit

import numpy as np
import psutil
import pytest
from api_key_replica import KeyedReplica, keyed_replica
from eval_fakes import wait_for
from websockets.exceptions import InvalidStatus

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.shm import ShmTransport
from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.errors import MessageTooLarge, Overloaded, PolicyUnavailable, TooManyRequests, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.frames import decode_replies, encode_request
from vlagents_ray.protocol.messages import DEFAULT_LIMITS, STREAM_BYTES, Request
from vlagents_ray.serve.access import api_keys
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.dialects import gr00t
from vlagents_ray.serve.dialects.base import GatewayContext
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.engine.sender import REFUSALS

SLACK = 48 * 2**20  # bytes of buffers in the kernel's and the interpreter's own care
SEEN = Obs({"front": np.zeros((8, 8, 3), np.uint8)})


@pytest.fixture(scope="module")
def replica(tmp_path_factory: pytest.TempPathFactory) -> Iterator[KeyedReplica]:
    with keyed_replica(tmp_path_factory.mktemp("plasma")) as one:
        yield one


def _rss() -> int:
    gc.collect()
    return int(psutil.Process().memory_info().rss)


def _stream(replica: KeyedReplica, token: str) -> Stream:
    own = replica.own
    headers = {"authorization": f"Bearer {token}"}
    return Stream(urlsplit("http://127.0.0.1"), own.address.port, own.address.path, 10, headers)


def _part(client: Stream, size: int) -> None:
    """Send all but the last byte of a message of that size, as far as the server reads it."""
    connection = client._socket
    connection.setblocking(False)
    data = memoryview(bytes([0x82, 0x80 | 127]) + struct.pack(">Q", size) + bytes(4) + bytes(size - 1))
    connection.settimeout(0.5)
    with contextlib.suppress(OSError):  # the server reads no more
        while data:
            data = data[connection.send(data) :]


def test_parts_of_messages_of_a_key_are_bounded_by_its_rate(replica: KeyedReplica) -> None:
    visitor = replica.visitor("right")
    replica.known.change(visitor.name, rate=1)
    before = _rss()
    clients = [_stream(replica, visitor.token) for _ in range(8)]
    for client in clients:
        _part(client, STREAM_BYTES)
    mine = [one for one in list(replica.own._clients) if getattr(one.caller, "name", "") == visitor.name]
    begun = [one for one in mine if one._received.size > 2**20 + 100]
    assert len(begun) <= 6  # one a second, of those that took half a second each
    assert replica.engine.admission.held <= len(begun) * STREAM_BYTES + 8 * 2**20
    assert _rss() - before < len(begun) * STREAM_BYTES + 8 * 2**20 + SLACK
    for client in clients:
        client.close()
    wait_for(lambda: replica.engine.admission.held == 0)


def test_a_connection_ends_after_some_refusals_in_a_row(replica: KeyedReplica, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_keys, "_THROTTLED_S", (0.02, 0.02))
    visitor = replica.visitor("right")
    client = _stream(replica, visitor.token)
    replica.known.change(visitor.name, rate=1e-6)
    replica.known.keys.check(visitor.token, "app").admit()
    for _ in range(REFUSALS):
        client.send(encode_request(Request("reset", SEEN)), 10)
        assert isinstance(decode_replies(client.recv(10))[0].error, TooManyRequests)
    with pytest.raises((ConnectionError, VLAgentsError)):
        client.recv(5)
    client.close()


def test_a_key_over_its_rate_is_read_on_none_of_its_connections(replica: KeyedReplica) -> None:
    visitor = replica.visitor("right")
    first, second = _stream(replica, visitor.token), _stream(replica, visitor.token)
    frame = encode_request(Request("reset", SEEN))
    for client in (first, second):
        client.send(frame, 10)
        assert decode_replies(client.recv(10))[0].error is None
    replica.known.change(visitor.name, rate=1e-6)
    replica.known.keys.check(visitor.token, "app").admit()

    first.send(frame, 10)
    assert isinstance(decode_replies(first.recv(10))[0].error, TooManyRequests)
    second.send(frame, 10)
    with pytest.raises(TimeoutError):  # it is not read for a second
        second.recv(0.1)
    with pytest.raises(InvalidStatus, match="429"):
        _stream(replica, visitor.token)
    first.close(), second.close()


def test_an_act_in_compact_form_is_read_again_after_a_refusal(replica: KeyedReplica) -> None:
    """The layout of its arrays came with the first message, which was refused before it was parsed."""
    visitor = replica.visitor("right")
    transport = ShmTransport(asdict(replica.local.address), Credentials(visitor.token))
    transport.connect(10)
    assert transport.call([Request("reset", SEEN)], 10)[0].error is None
    replica.known.change(visitor.name, rate=1e-6)
    replica.known.keys.check(visitor.token, "app").admit()
    assert isinstance(transport.call([Request("act", SEEN, request_id="a")], 10)[0].error, TooManyRequests)
    replica.known.change(visitor.name, rate=None)
    [reply] = transport.call([Request("act", SEEN, request_id="b")], 10)
    assert reply.error is None, reply.error
    transport.close()


@pytest.mark.parametrize("connections", [2, 12])
def test_parts_of_messages_before_a_key_are_bounded_at_groots_gateway(
    connections: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """12 connections with 24 MiB of a message each take no more than the 64 MiB of one message, and a part more."""
    monkeypatch.setattr(gr00t, "_STRANGER_S", 3.0)
    context = GatewayContext("app", _connect, DEFAULT_LIMITS, 8, 30.0, None, lambda _: NoKey.OPEN)
    dialect = gr00t.GR00TDialect("gr00t", gr00t.GR00TDialectConfig(), context)
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    dialect.serve(listener)
    greeting = b"\xff" + bytes(8) + b"\x7f" + b"\x03\x01" + b"NULL".ljust(20, b"\0") + b"\0" + bytes(31)
    body = b"\x05READY" + b"\x0bSocket-Type" + struct.pack(">I", 6) + b"DEALER"
    before, held, part = _rss(), [], bytes(24 * 2**20)
    for _ in range(connections):
        connection = socket.create_connection(("127.0.0.1", port), timeout=5)
        held.append(connection)
        connection.sendall(greeting)
        got = 0
        while got < 64:
            got += len(connection.recv(64 - got))
        connection.sendall(b"\x04" + bytes([len(body)]) + body + b"\x02" + struct.pack(">Q", 2 * len(part)))
        with contextlib.suppress(OSError):  # it is cut off meanwhile
            connection.sendall(part)
    assert _rss() - before < DEFAULT_LIMITS.body_bytes + len(part) + SLACK
    wait_for(lambda: all(_ended(one) for one in held))
    wait_for(lambda: _rss() - before < SLACK)
    for connection in held:
        connection.close()
    dialect.close()


def test_requests_that_wait_at_groots_gateway_count_as_in_flight() -> None:
    admission = Admission(3 * 10**6)
    context = GatewayContext("app", _connect, DEFAULT_LIMITS, 8, 30.0, None, NoKey.OPEN, admission)
    answers: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    dialect = gr00t.GR00TDialect("gr00t", gr00t.GR00TDialectConfig(), context)
    client = gr00t.GR00TConnection(context, dialect.mapping, answers.put)
    with pytest.raises((Overloaded, MessageTooLarge)):
        client.put(bytes(4 * 10**6))
    assert client.put(bytes(10**6))
    answers.get(timeout=10)
    assert admission.held == 0
    client.end()
    client.join(10)
    dialect.close()


def _connect(*_: object) -> RemoteAgent:
    raise PolicyUnavailable("there is no replica")


def _ended(connection: socket.socket) -> bool:
    connection.setblocking(False)
    try:
        while connection.recv(65536):
            pass
    except BlockingIOError:
        return False
    except OSError:
        return True
    return True
