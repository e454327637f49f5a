"""A connection to an HTTP server: what it sends, and when it is open."""

from __future__ import annotations

import contextlib
import http.client
import socket
import ssl
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from certificates import authority
from eval_fakes import wait_for

from vlagents_ray.client.http_connection import ServerConnection, request_head

LIMIT_S = 0.3
ANSWER = b"HTTP/1.1 200 OK\r\ncontent-length: 2\r\n\r\nok"


@contextlib.contextmanager
def connection(folder: Path | None = None) -> Iterator[tuple[ServerConnection, socket.socket]]:
    """Yield both ends of a connection, the client's and the server's; with TLS if there is a folder
    for certificates.
    """
    server_context = client_context = None
    if folder is not None:
        ours = authority(folder, "ours")
        server_context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        server_context.load_cert_chain(*ours.sign("server"))
        client_context = ssl.create_default_context(cafile=str(ours.file))

    def accepted() -> socket.socket:
        end, _ = listener.accept()
        if server_context is None:
            return end
        return server_context.wrap_socket(end, server_side=True)

    scheme = "http" if folder is None else "https"
    with socket.create_server(("127.0.0.1", 0)) as listener, ThreadPoolExecutor(1) as thread:
        accepting = thread.submit(accepted)
        url = urlsplit(f"{scheme}://127.0.0.1:{listener.getsockname()[1]}")
        client = ServerConnection(url, client_context, 10)
        server = accepting.result()
        with contextlib.closing(client), contextlib.closing(server):
            yield client, server


@pytest.fixture(params=["http", "https"])
def ends(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[tuple[ServerConnection, socket.socket]]:
    with connection(tmp_path if request.param == "https" else None) as both:
        yield both


def exchanged(client: ServerConnection, server: socket.socket) -> bytes:
    """Exchange a request and its answer; return the request."""
    client.send("GET", "/", {}, (), 10)
    received = server.recv(65536)
    server.sendall(ANSWER)
    assert client.receive("GET").read() == b"ok"
    return received


@pytest.mark.parametrize(
    ("method", "body", "want"),
    [
        ("GET", (), b"\r\n\r\n"),
        ("POST", (), b"content-length: 0\r\n"),
        ("POST", [b"ab", memoryview(b"cd")], b"content-length: 4\r\n"),
        ("POST", [np.zeros((2, 3), np.float32)], b"content-length: 24\r\n"),
    ],
)
def test_a_request_is_sent_at_once(method: str, body: Any, want: bytes) -> None:
    with connection() as (client, server):
        client.send(method, "/act?a=1", {"x-name": "1"}, body, 10)
        head, _, content = server.recv(65536).partition(b"\r\n\r\n")
    assert want in head + b"\r\n\r\n"
    assert (b"content-length" in head) == (method == "POST")
    assert head.startswith(f"{method} /act?a=1 HTTP/1.1\r\nhost: 127.0.0.1:".encode())
    assert head.endswith(b"\r\nx-name: 1")
    assert content == b"".join(body)


def test_an_idle_connection_is_open_until_the_server_closes_it(
    ends: tuple[ServerConnection, socket.socket],
) -> None:
    """A TLS server sends session tickets, which make the connection readable."""
    client, server = ends
    assert client.is_open
    for _ in range(2):
        exchanged(client, server)
        assert client.is_open
    server.close()
    wait_for(lambda: not client.is_open)


def test_an_answer_without_a_request_closes_the_connection(
    ends: tuple[ServerConnection, socket.socket],
) -> None:
    """It would be read as the answer to the next request."""
    client, server = ends
    exchanged(client, server)
    server.sendall(ANSWER)
    wait_for(lambda: not client.is_open)


@pytest.mark.parametrize("pause_s", [0.0, LIMIT_S / 10])
def test_the_time_of_a_whole_exchange_is_limited(
    ends: tuple[ServerConnection, socket.socket], pause_s: float
) -> None:
    """The server sends nothing, or a byte from time to time."""
    client, server = ends

    def drips() -> None:
        with contextlib.suppress(OSError):
            for byte in ANSWER.replace(b"200 OK", b"200 " + b"O" * 1000):
                server.sendall(bytes([byte]))
                time.sleep(pause_s)

    client.send("GET", "/", {}, (), LIMIT_S)
    with ThreadPoolExecutor(1) as thread:
        if pause_s:
            thread.submit(drips)
        begun = time.monotonic()
        with pytest.raises(TimeoutError):
            client.receive("GET")
        took_s = time.monotonic() - begun
        client.close()
    assert took_s < 30 * LIMIT_S  # the server would drip for 100 times as long


def test_a_request_that_is_not_read_is_given_up_in_time() -> None:
    with connection() as (client, _), pytest.raises(TimeoutError):
        client.send("POST", "/", {}, [bytes(64 * 2**20)], LIMIT_S)


@pytest.mark.parametrize("value", ["a\r\nx-evil: 1", "a\nb", "a\0", "\x7f"])
def test_a_header_cannot_contain_another_one(value: str) -> None:
    with pytest.raises(ValueError, match="header x-name: expected no control characters"):
        request_head("GET", "/", {"x-name": value})


@pytest.mark.parametrize("target", ["/a b", "/a\r\nx-evil: 1", "/ä", "/a\0"])
def test_a_target_cannot_contain_a_header(target: str) -> None:
    with pytest.raises(http.client.InvalidURL, match="visible ASCII"):
        request_head("GET", target, {})


@pytest.mark.parametrize(
    ("url", "address", "host"),
    [
        ("http://127.0.0.1:8000/path", ("127.0.0.1", 8000), "127.0.0.1:8000"),
        ("http://gpu-box", ("gpu-box", 80), "gpu-box"),
        ("http://[::1]:8000", ("::1", 8000), "[::1]:8000"),
        ("http://büro:8000", ("büro", 8000), "xn--bro-hoa:8000"),
    ],
)
def test_the_host_is_that_of_the_url(
    monkeypatch: pytest.MonkeyPatch, url: str, address: tuple[str, int], host: str
) -> None:
    called: list[tuple[str, int]] = []
    connect = socket.create_connection

    def connected(where: tuple[str, int], timeout_s: float) -> socket.socket:
        called.append(where)
        return connect(listener.getsockname(), timeout_s)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        monkeypatch.setattr(socket, "create_connection", connected)
        client = ServerConnection(urlsplit(url), None, 10)
        server, _ = listener.accept()
        with contextlib.closing(client), contextlib.closing(server):
            head = exchanged(client, server)
    assert called == [address]
    assert f"\r\nhost: {host}\r\n".encode() in head
