"""WebSockets at a replica's own port, over an engine without Ray."""

from __future__ import annotations

import contextlib
import os
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from eval_fakes import wait_for
from probes import bytes_probe, is_probe_answer
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import connect

from vlagents_ray.client.transports.websocket import Stream
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.protocol.frames import Decoded, decode_replies, decode_requests, encode_requests
from vlagents_ray.protocol.messages import STREAM_BYTES, Budget, MessageLimits, Reply, Request
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints import message_connection
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.settings import EngineSettings

BASE = urlsplit("http://127.0.0.1")


class Echo(Agent):
    """A policy that returns a pixel of the camera, and as many bytes as requested."""

    def act(self, obs: Obs) -> Act:
        return Act(
            np.array([obs.cameras["front"][0, 0, 0]]),
            info={"bytes": bytes(obs.info.get("bytes", 0))},
        )


@pytest.fixture
def endpoint() -> Iterator[OwnPortServer]:
    engine = Engine(Echo(), EngineSettings(session_limit=3))
    endpoint = OwnPortServer(engine, MessageLimits(), "127.0.0.1", None, NoKey.OPEN)
    endpoint.open()
    engine.start()
    yield endpoint
    engine.close()
    endpoint.close()


def stream(endpoint: OwnPortServer) -> Stream:
    return Stream(BASE, endpoint.address.port, endpoint.address.path, 5)


def ask(client: Stream, op: Any, pixel: int = 0, **info: Any) -> Reply:
    obs = Obs({"front": np.full((16, 16, 3), pixel, np.uint8)}, info=info)
    client.send(encode_requests([Request(op, obs, request_id=os.urandom(4).hex())]), 5)
    return decode_replies(client.recv(5))[0]


def test_each_connection_is_a_session_that_ends_with_it(endpoint: OwnPortServer) -> None:
    clients = [stream(endpoint) for _ in range(3)]
    for client in clients:
        assert ask(client, "reset").error is None
    for step in range(20):
        for number, client in enumerate(clients):
            act = ask(client, "act", 3 * step + number).act
            assert act.action.tolist() == [3 * step + number]
    assert len(endpoint.engine.sessions) == 3
    clients[0].close()
    clients[1]._socket.close()  # without a close frame
    wait_for(lambda: len(endpoint.engine.sessions) == 1)
    assert ask(clients[2], "act", 9).act is not None
    clients[2].close()
    wait_for(lambda: len(endpoint.engine.sessions) == 0)


def test_who_does_not_know_the_path_is_not_let_in(endpoint: OwnPortServer) -> None:
    for path in ("/", "/v1/stream", endpoint.address.path[:-1], endpoint.address.path + "x"):
        with pytest.raises(InvalidStatus) as refused:
            Stream(BASE, endpoint.address.port, path, 5)
        assert refused.value.response.status_code == 404
    wait_for(lambda: not endpoint._clients)


@pytest.mark.parametrize("compression", [None, "deflate"])
def test_an_ordinary_websocket_client_is_served_too(
    endpoint: OwnPortServer, compression: str | None
) -> None:
    url = f"ws://127.0.0.1:{endpoint.address.port}{endpoint.address.path}"
    with connect(url, compression=compression) as socket_:
        assert not socket_.protocol.extensions  # the server declined compression
        socket_.ping().wait(5)
        probe = bytes_probe(300_000)
        socket_.send(probe)
        assert is_probe_answer(socket_.recv(5), probe)
        socket_.send(encode_requests([Request("reset", Obs())]))
        assert decode_replies(socket_.recv(5))[0].error is None


def test_a_message_that_is_too_long_ends_its_connection_alone(endpoint: OwnPortServer) -> None:
    other = stream(endpoint)
    ask(other, "reset")
    # The client reads nothing before it has sent the whole message.
    with contextlib.closing(stream(endpoint)) as late:
        late.send(bytes(STREAM_BYTES + 9 * 2**20), 5)
        with pytest.raises((ConnectionClosed, ConnectionResetError), match="1009"):
            late.recv(5)
    wait_for(lambda: len(endpoint._clients) == 1)
    act = ask(other, "act", 7).act
    assert act.action.tolist() == [7]
    other.close()


@pytest.mark.parametrize("fragments", [1, 2, 8])
def test_a_message_in_fragments_is_answered_as_a_whole_one(
    endpoint: OwnPortServer, fragments: int
) -> None:
    """Browsers split large messages into fragments."""
    frame = encode_requests([Request("reset", Obs({"front": np.zeros((64, 64, 3), np.uint8)}))])
    size = -(-len(frame) // fragments)
    url = f"ws://127.0.0.1:{endpoint.address.port}{endpoint.address.path}"
    with connect(url, compression=None) as client:
        client.send([frame[at : at + size] for at in range(0, len(frame), size)])
        assert decode_replies(client.recv(5))[0].error is None
        client.send([frame[:100], frame[100:]])
        assert decode_replies(client.recv(5))[0].error is None


def test_many_small_fragments_end_their_connection(endpoint: OwnPortServer) -> None:
    url = f"ws://127.0.0.1:{endpoint.address.port}{endpoint.address.path}"
    with connect(url, compression=None) as client:
        # The server may close the connection before the last fragment is sent.
        with suppress(ConnectionClosed):
            client.send([b"a"] * 50)
        with pytest.raises(ConnectionClosed, match="small fragments"):
            client.recv(5)


@pytest.mark.slow
@pytest.mark.parametrize("floods", [True, False])
def test_who_stays_after_a_wrong_message_is_cut_off(
    endpoint: OwnPortServer, floods: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(message_connection, "_CLOSING_S", 1e9 if floods else 0.2)
    endpoint.limits = MessageLimits(body_bytes=1_000_000)
    client = stream(endpoint)
    ask(client, "reset")
    # The beginning of a message of one terabyte.
    client._socket.sendall(b"\x82\xff" + (2**40).to_bytes(8, "big") + bytes(4))
    if floods:
        client._socket.settimeout(5)
        with pytest.raises(OSError, match=r"reset|pipe"):
            client._socket.sendall(bytes(1_000_000_000))
    wait_for(lambda: not endpoint._clients and not len(endpoint.engine.sessions))
    client._socket.close()


def test_a_client_that_takes_no_replies_holds_up_nobody(
    endpoint: OwnPortServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vlagents_ray.serve.endpoints.send_buffer._SLOW_S", 0.5)
    slow, other = stream(endpoint), stream(endpoint)
    for client in (slow, other):
        ask(client, "reset")
    frame = encode_requests(
        [Request("act", Obs({"front": np.zeros((2, 2, 3), np.uint8)}, info={"bytes": 3_000_000}))]
    )
    # On a busy machine the server may close the connection before the last byte is sent.
    with suppress(ConnectionClosed, OSError):
        for _ in range(4):
            slow.send(frame, 5)
    for pixel in range(50):
        act = ask(other, "act", pixel).act
        assert act.action.tolist() == [pixel]
    wait_for(lambda: len(endpoint.engine.sessions) == 1)  # the server closed the other connection
    wait_for(
        lambda: not [thread for thread in threading.enumerate() if thread.name == "send-slowly"]
    )
    slow.close()
    other.close()


def test_a_reply_longer_than_the_connection_holds_arrives_whole(endpoint: OwnPortServer) -> None:
    client = stream(endpoint)
    ask(client, "reset")
    for _ in range(3):
        act = ask(client, "act", 1, bytes=9_000_000).act
        assert len(act.info["bytes"]) == 9_000_000
    client.close()


def test_connections_that_say_nothing_make_way(endpoint: OwnPortServer) -> None:
    silent = [socket.create_connection(("127.0.0.1", endpoint.address.port)) for _ in range(70)]
    client = stream(endpoint)
    assert ask(client, "reset").error is None
    assert len(endpoint._clients) <= 65
    for each in silent:
        each.close()
    client.close()
    wait_for(lambda: not endpoint._clients)


def test_what_nobody_foresaw_ends_the_connection_that_it_came_by_alone(
    endpoint: OwnPortServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(frame: bytes, budget: Budget) -> Decoded:
        if frame == b"surprise":
            raise RuntimeError
        return decode_requests(frame, budget)

    monkeypatch.setattr("vlagents_ray.serve.endpoints.request_stream.decode_requests", decode)
    other, client = stream(endpoint), stream(endpoint)
    for each in (other, client):
        ask(each, "reset")
    client.send(b"surprise", 5)
    with pytest.raises(ConnectionClosed):
        client.recv(5)
    client.close()
    wait_for(lambda: len(endpoint.engine.sessions) == len(endpoint._clients) == 1)
    assert ask(other, "act", 7).act is not None
    other.close()


def test_who_does_not_wait_for_answers_fills_no_memory_and_gets_them_all(
    endpoint: OwnPortServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    hurry = threading.Event()

    def act(_self: Echo, obs: Obs) -> Act:
        if not hurry.is_set():
            time.sleep(0.005)
        return Act(obs.cameras["front"][0, :1, 0])

    monkeypatch.setattr(Echo, "act", act)
    frames = [
        encode_requests(
            [
                Request(
                    "act",
                    Obs({"front": np.full((96, 96, 3), i % 256, np.uint8)}),
                    request_id=str(i),
                )
            ]
        )
        for i in range(1000)
    ]
    with connect(
        f"ws://127.0.0.1:{endpoint.address.port}{endpoint.address.path}", compression=None
    ) as client:
        client.send(encode_requests([Request("reset", Obs())]))
        assert decode_replies(client.recv(5))[0].error is None
        sending = threading.Thread(target=lambda: [client.send(frame) for frame in frames])
        sending.start()
        (one,) = endpoint._clients
        wait_for(lambda: one._paused or not sending.is_alive())
        assert sending.is_alive()
        assert endpoint.engine.queue.depth() <= 256
        hurry.set()
        replies = [decode_replies(client.recv(10))[0] for _ in frames]
        sending.join(10)
    assert [reply.request_id for reply in replies] == [str(i) for i in range(1000)]
    assert all(reply.act is not None for reply in replies)
    wait_for(lambda: not endpoint._clients)


def test_an_endpoint_takes_a_free_port_of_those_it_may() -> None:
    engine = Engine(Echo())
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(ConfigError, match=str(port)):
            OwnPortServer(engine, MessageLimits(), "127.0.0.1", (port, port), NoKey.OPEN)
        endpoint = OwnPortServer(
            engine, MessageLimits(), "127.0.0.1", (port, port + 20), NoKey.OPEN
        )
        assert port < endpoint.address.port <= port + 20
        endpoint.close()
    engine.close()


def test_a_replica_that_stops_closes_its_connections_with_a_code_and_a_reason() -> None:
    engine = Engine(Echo())
    endpoint = OwnPortServer(engine, MessageLimits(), "127.0.0.1", None, NoKey.OPEN)
    endpoint.open()
    engine.start()
    url = f"ws://127.0.0.1:{endpoint.address.port}{endpoint.address.path}"
    with connect(url) as idle, connect(url) as waiting:
        waiting.send(encode_requests([Request("reset", Obs())]))
        assert decode_replies(waiting.recv(5))[0].error is None
        engine.close()
        # The server does not read this message.
        waiting.send(encode_requests([Request("act", Obs())]))
        endpoint.close()
        for client in (idle, waiting):
            with pytest.raises(ConnectionClosed) as closed:
                client.recv(5)
            assert closed.value.rcvd is not None
            assert closed.value.rcvd.code == 1012
            assert "stopping" in closed.value.rcvd.reason
