"""Checks before Serve's own code: headers that are not UTF-8, and messages over the
server's limit.
"""

from __future__ import annotations

import json
import socket
from typing import Any

import pytest
from asgi_server import served
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.websockets import WebSocket
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from vlagents_ray.protocol.messages import STREAM_BYTES
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.front import FrontMiddleware


async def _echo(websocket: WebSocket) -> None:
    await websocket.accept()
    async for message in websocket.iter_bytes():
        await websocket.send_bytes(message[:1])


APP = FrontMiddleware(AccessMiddleware(Starlette(routes=[WebSocketRoute("/", _echo)]), None, "app"))


def _close_of(url: str, size: int) -> tuple[int, str]:
    with connect(url, max_size=None, compression=None) as client:
        try:
            client.send(bytes(size))
            client.recv(timeout=10)
        except ConnectionClosed as closed:
            return (
                (0, "no close frame")
                if closed.rcvd is None
                else (closed.rcvd.code, closed.rcvd.reason)
            )
    raise AssertionError("the server answered a message over its limit")


@pytest.mark.slow
def test_a_message_over_the_limit_gets_1009_with_a_reason_each_time() -> None:
    with served(APP) as port:
        url = f"ws://127.0.0.1:{port}/"
        for size in (STREAM_BYTES + 1, STREAM_BYTES + 2**20, 2 * STREAM_BYTES) * 2:
            code, reason = _close_of(url, size)
            assert code == 1009
            assert str(STREAM_BYTES) in reason
        with connect(url, max_size=None, compression=None) as client:
            client.send(bytes(STREAM_BYTES))  # the limit in docs/other_clients.md
            assert client.recv(timeout=10) == b"\0"


@pytest.mark.parametrize("header", [b"x-request-id: \xff", b"x-session-id: a\xc3", b"x-\xe9: a"])
def test_headers_that_are_not_utf_8_are_malformed(header: bytes) -> None:
    upgrade = (
        b"connection: upgrade\r\nupgrade: websocket\r\nsec-websocket-version: "
        b"13\r\nsec-websocket-key: "
    )
    upgrade += b"dGhlIHNhbXBsZSBub25jZQ==\r\n"
    with served(APP) as port:
        for more in (b"", upgrade):
            with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
                client.sendall(
                    b"GET / HTTP/1.1\r\nhost: localhost\r\n" + more + header + b"\r\n\r\n"
                )
                head, _, body = client.recv(65536).partition(b"\r\n\r\n")
                assert head.split(b" ")[1] == b"400"
                if b"x-\xe9" in header:  # the HTTP server itself rejects such a header name
                    continue
                while not body.endswith(b"}"):
                    body += client.recv(65536)
            problem: dict[str, Any] = json.loads(body[body.index(b"{") :])
            assert problem["code"] == "malformed"
            assert "UTF-8" in problem["detail"]
