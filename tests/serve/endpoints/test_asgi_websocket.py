"""WebSockets at the server's port, whose sockets are taken over from uvicorn."""

from __future__ import annotations

import asyncio
import socket
import struct
import threading
from collections.abc import Iterator

import pytest
from asgi_server import served
from eval_fakes import wait_for
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.testclient import TestClient
from starlette.websockets import WebSocket, WebSocketDisconnect
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from vlagents_ray.serve.endpoints import websocket_connection
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.front import FrontMiddleware
from vlagents_ray.serve.endpoints.shutdown import Shutdown

ANSWER = bytes(2**16)
HANDSHAKE = (
    b"GET / HTTP/1.1\r\nhost: localhost\r\nconnection: upgrade\r\nupgrade: websocket\r\n"
    b"sec-websocket-version: 13\r\nsec-websocket-key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


class SlowEcho:
    """An application that takes 10 ms for each message, and answers with 64 KiB."""

    def __init__(self) -> None:
        self.received = 0
        self.serving = 0  # number of tasks that serve a WebSocket
        self.ended = threading.Event()

    async def serve(self, socket: WebSocket) -> None:
        self.serving += 1
        try:
            await socket.accept()
            while True:
                await socket.receive_bytes()
                self.received += 1
                await asyncio.sleep(0.01)
                await socket.send_bytes(ANSWER)
        except WebSocketDisconnect:
            return
        finally:
            self.serving -= 1
            self.ended.set()


@pytest.fixture
def echo() -> SlowEcho:
    return SlowEcho()


@pytest.fixture
def shutdown() -> Shutdown:
    return Shutdown()


@pytest.fixture(params=[False, True], ids=["alone", "behind Serve"])
def port(echo: SlowEcho, shutdown: Shutdown, request: pytest.FixtureRequest) -> Iterator[int]:
    app = Starlette(routes=[WebSocketRoute("/", echo.serve)])
    guarded = AccessMiddleware(app, None, "app", shutdown=shutdown)
    with served(FrontMiddleware(guarded) if request.param else guarded) as port:
        yield port


def connected(port: int) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{port}/", max_size=None, ping_interval=None, close_timeout=1)


def test_messages_are_answered_in_order(port: int, echo: SlowEcho) -> None:
    with connected(port) as client:
        for _ in range(40):
            client.send(b"x")
        assert [client.recv(10) for _ in range(40)] == [ANSWER] * 40
    assert echo.ended.wait(10)
    assert echo.received == 40


def test_messages_of_a_client_that_has_left_are_not_served(port: int, echo: SlowEcho) -> None:
    """The kernel's buffers may still contain thousands of its messages."""
    with connected(port) as client:
        for _ in range(5000):
            client.send(b"x")
        client.socket.shutdown(socket.SHUT_RDWR)
    assert echo.ended.wait(10)
    assert echo.received < 1000


def test_the_end_of_a_replica_waits_for_the_answer_to_a_message(
    port: int, echo: SlowEcho, shutdown: Shutdown
) -> None:
    with connected(port) as client:
        client.send(b"x")
        wait_for(lambda: echo.received)
        shutdown.begin()
        assert client.recv(10) == ANSWER
        with pytest.raises(ConnectionClosed) as closed:
            client.recv(10)
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1012


@pytest.mark.slow
def test_a_client_that_answers_no_ping_is_cut_off(
    port: int, echo: SlowEcho, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(websocket_connection, "_PING_S", 0.1)
    with connected(port) as present:
        with socket.create_connection(("127.0.0.1", port), 10) as absent:
            absent.sendall(HANDSHAKE)
            assert absent.recv(4096).startswith(b"HTTP/1.1 101")
            absent.recv(4096)  # a ping, which this client does not answer
            wait_for(echo.ended.is_set)
        present.send(b"x")
        assert present.recv(10) == ANSWER


def test_a_websocket_without_a_socket_is_served_by_its_messages(echo: SlowEcho) -> None:
    """Serve's own proxy passes messages to another process, so the application has no socket."""
    guarded = AccessMiddleware(Starlette(routes=[WebSocketRoute("/", echo.serve)]), None, "app")
    with TestClient(guarded).websocket_connect("/") as client:
        client.send_bytes(b"x")
        assert client.receive_bytes() == ANSWER
    assert echo.ended.wait(10)


def test_a_client_that_leaves_before_it_is_accepted_leaves_no_task(
    port: int, echo: SlowEcho
) -> None:
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", port), 10) as leaving:
            leaving.sendall(HANDSHAKE)
            leaving.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    with connected(port) as client:
        client.send(b"x")
        assert client.recv(10) == ANSWER
    assert echo.ended.wait(10)
    # Each task ends with its WebSocket. All handshakes above were received.
    wait_for(lambda: echo.serving == 0)
