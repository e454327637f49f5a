"""A connection that its server closes as RFC 6455 requires, with a last message before the close;
and a connection whose server does not read.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from certificates import authority
from deaf_server import deaf_server
from websockets.exceptions import ConnectionClosed, ConnectionClosedError, ConnectionClosedOK
from websockets.http11 import Request, Response
from websockets.sync.server import ServerConnection, serve

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.websocket import ProxiedSocket, Stream, WebSocketTransport
from vlagents_ray.errors import PolicyUnavailable


@contextlib.contextmanager
def serving(handle: Callable[[ServerConnection], None], **options: Any) -> Iterator[int]:
    """Run a WebSocket server, and yield its port."""
    with serve(handle, "127.0.0.1", 0, **options) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield server.socket.getsockname()[1]
        finally:
            server.shutdown()
            thread.join()


@pytest.fixture
def port() -> Iterator[int]:
    def answer_and_close(connection: ServerConnection) -> None:
        if connection.recv() == b"answer first":
            connection.send(b"answered")
        connection.close()

    with serving(answer_and_close) as port:
        yield port


def connected(port: int, *headers: Any) -> Stream:
    return Stream(urlsplit("http://127.0.0.1"), port, "/", 5, *headers)


@pytest.fixture
def stream(port: int) -> Iterator[Stream]:
    with contextlib.closing(connected(port)) as stream:
        yield stream


def test_a_message_arrives_whole_in_pieces_of_any_length() -> None:
    received: queue.SimpleQueue[str | bytes] = queue.SimpleQueue()

    def receive(connection: ServerConnection) -> None:
        for message in connection:
            received.put(message)

    with serving(receive, max_size=None) as port, contextlib.closing(connected(port)) as stream:
        for size in (0, 1, 125, 126, 65535, 65536, 2**20, 3 * 2**20 + 1):
            message = os.urandom(size)
            stream.send(b"before", 30)
            stream.send_pieces([message[: size // 3], b"", memoryview(message)[size // 3 :]], 30)
            stream.send(b"after", 30)
            assert [received.get(timeout=30) for _ in range(3)] == [b"before", message, b"after"], (
                size
            )
        stream.send_pieces([b"a"] * 2000, 30)  # more than the kernel's buffers take
        assert received.get(timeout=30) == b"a" * 2000


def test_a_server_that_closes_in_place_of_an_answer_is_a_connection_that_is_gone(
    stream: Stream,
) -> None:
    stream.send(b"nothing", 5)
    with pytest.raises((ConnectionClosed, OSError), match="1000"):
        stream.recv(30)


def test_a_server_that_closes_after_an_answer_is_noticed_by_the_next_request(
    stream: Stream,
) -> None:
    stream.send(b"answer first", 5)
    assert stream.recv(30) == b"answered"
    with pytest.raises((ConnectionClosed, OSError)):  # noqa: PT012 - either side may raise it
        stream.send(b"answer first", 5)
        stream.recv(30)


@pytest.mark.parametrize("answered", [True, False])
def test_a_server_that_does_not_answer_is_left_by_a_reset_so_that_it_holds_nothing_any_longer(
    answered: bool,
) -> None:
    ends: queue.SimpleQueue[ConnectionClosed] = queue.SimpleQueue()

    def listen(connection: ServerConnection) -> None:
        try:
            connection.recv()
            if answered:
                connection.send(b"here")
            connection.recv()
        except ConnectionClosed as end:
            ends.put(end)

    with serving(listen) as port:
        stream = connected(port)
        stream.send(b"hello", 5)
        if answered:
            assert stream.recv(30) == b"here"
        else:
            with pytest.raises(TimeoutError):
                stream.recv(0.01)
        stream.close()
        assert isinstance(
            ends.get(timeout=30), ConnectionClosedOK if answered else ConnectionClosedError
        )


def test_the_key_is_in_no_log(port: int, caplog: pytest.LogCaptureFixture) -> None:
    credentials = Credentials("the-secret-key")
    with caplog.at_level(logging.DEBUG):
        connected(port, credentials.headers).close()
        ProxiedSocket(f"ws://127.0.0.1:{port}/", credentials, 5).close()
    client = [
        record.getMessage()
        for record in caplog.records
        if not record.name.startswith("websockets.server")
    ]
    assert "> Sec-WebSocket-Version: 13" in client  # the other headers are logged
    assert not [line for line in client if "the-secret-key" in line]


@pytest.mark.slow
@pytest.mark.parametrize("read_bytes", [0, 4096], ids=["takes nothing", "takes little"])
@pytest.mark.parametrize("has_tls", [False, True], ids=["plain", "tls"])
def test_a_proxy_that_hardly_reads_does_not_hold_up_the_sender(
    has_tls: bool, read_bytes: int, tmp_path: Path
) -> None:
    """The kernel's own time limit restarts at each read, and does not apply to TLS."""
    context, credentials = None, Credentials("")
    if has_tls:
        own = authority(tmp_path, "lab")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(*own.sign("server"))
        credentials = Credentials("", own.file)

    with deaf_server(read_bytes, context=context) as port:
        proxied = ProxiedSocket(f"{'wss' if has_tls else 'ws'}://127.0.0.1:{port}/", credentials, 5)
        begun = time.monotonic()
        with pytest.raises(ConnectionAbortedError, match=r"took no message within 0\.5 s"):
            proxied.send(bytes(32 * 1024 * 1024), 0.5)
        proxied.close()
        assert time.monotonic() - begun < 5  # without a limit, at least 400 s


@pytest.mark.slow
@pytest.mark.parametrize("read_bytes", [0, 4096], ids=["takes nothing", "takes little"])
def test_a_connection_that_cannot_send_is_closed_in_time(read_bytes: int) -> None:
    """Its close frame waits behind a message that another thread is sending."""
    with deaf_server(read_bytes) as port:
        proxied = ProxiedSocket(f"ws://127.0.0.1:{port}/", Credentials(""), 5)

        def send() -> None:
            with contextlib.suppress(ConnectionClosed, OSError):
                proxied.send(bytes(32 * 1024 * 1024), 60)

        sending = threading.Thread(target=send)
        sending.start()
        time.sleep(0.2)
        begun = time.monotonic()
        proxied.close()
        sending.join(10)
        assert not sending.is_alive()
        assert time.monotonic() - begun < 5


@pytest.mark.parametrize(("statuses", "accepted"), [([408, 404, 503], True), ([400], False)])
def test_a_proxy_that_waits_for_a_replica_is_asked_again_and_no_other_refusal_is(
    statuses: list[int], accepted: bool
) -> None:
    left = list(statuses)

    def refuse(connection: ServerConnection, request: Request) -> Response | None:
        return connection.respond(HTTPStatus(left.pop(0)), "not now\n") if left else None

    with serving(lambda connection: connection.close(), process_request=refuse) as port:
        transport = WebSocketTransport(f"ws://127.0.0.1:{port}", CodecChoice("raw"))
        if accepted:
            transport._proxied(10).close()
        else:
            with pytest.raises(PolicyUnavailable, match="400"):
                transport._proxied(10)
    assert not left
