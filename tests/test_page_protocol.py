"""The servers of pages, which run without HAProxy, end silent connections, and let no address use
all connections.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from vlagents_ray import page_protocol
from vlagents_ray.evaluate.robot.operator import PageOperator
from vlagents_ray.serve.access.api_keys import Keys
from vlagents_ray_live.live_page import page_server

HALF_A_HEADER = b"GET /live HTTP/1.1\r\nHost: 127.0.0.1\r\n"
KEYS = '{"keys": [{"name": "viewer", "sha256": "' + "0" * 64 + '"}]}'


@contextlib.contextmanager
def evaluation_page() -> Iterator[int]:
    fleet: Any = SimpleNamespace(viewers=0)
    with page_server(
        fleet, ("127.0.0.1", 0), Keys.from_text(KEYS), name="x", videos=lambda _: None
    ) as url:
        yield int(url.split(":")[2].split("/")[0])


@contextlib.contextmanager
def operators_page() -> Iterator[int]:
    with PageOperator(say=lambda _: None) as page:
        yield int(page.url.split(":")[2].split("/")[0])


PAGES = pytest.mark.parametrize("page", [evaluation_page, operators_page])


def is_open(client: socket.socket) -> bool:
    client.setblocking(False)
    try:
        return client.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


@pytest.mark.slow
@PAGES
@pytest.mark.parametrize("sent", [b"", HALF_A_HEADER], ids=["nothing", "half a header"])
def test_a_connection_without_a_request_is_closed(
    page: Any, sent: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page_protocol, "_HEADERS_S", 0.2)
    with page() as port, socket.create_connection(("127.0.0.1", port), 30) as client:
        client.sendall(sent)
        assert client.recv(1) == b""


@PAGES
def test_one_address_does_not_take_all_connections(page: Any) -> None:
    with page() as port, contextlib.ExitStack() as held:
        clients = []
        for _number in range(2 * page_protocol._CONNECTIONS):
            client = held.enter_context(
                socket.create_connection(("127.0.0.1", port), 30, ("127.0.0.2", 0))
            )
            clients.append(client)
        deadline = time.monotonic() + 30
        while (
            sum(map(is_open, clients)) > page_protocol._CONNECTIONS_PER_ADDRESS
            and time.monotonic() < deadline
        ):
            time.sleep(0.01)
        assert sum(map(is_open, clients)) <= page_protocol._CONNECTIONS_PER_ADDRESS
        with socket.create_connection(("127.0.0.1", port), 30) as viewer:
            viewer.sendall(HALF_A_HEADER + b"\r\n")
            assert viewer.recv(100).startswith(b"HTTP/1.1")


@PAGES
def test_connections_that_are_closed_at_once_delay_no_other(page: Any) -> None:
    """While the event loop is busy, connections wait in the kernel. The next SYN is not dropped, so
    it is not sent again after one second.
    """
    with page() as port:
        for _ in range(3):
            for _ in range(200):
                socket.create_connection(("127.0.0.1", port), 5).close()
            begun = time.monotonic()
            with socket.create_connection(("127.0.0.1", port), 5) as client:
                client.sendall(b"GET /nothing HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
                assert client.recv(100).startswith(b"HTTP/1.1 4")
            assert time.monotonic() - begun < 0.9


def test_a_listener_of_pages_queues_many_connections_and_accepts_only_those_that_are_open() -> None:
    with page_protocol.PageListener.bound("127.0.0.1", 0) as listener:
        listener.listen(page_protocol.BACKLOG)
        listener.setblocking(False)
        for _ in range(page_protocol._ENDED_AT_ONCE + 50):
            socket.create_connection(listener.getsockname(), 0.9).close()
        with socket.create_connection(listener.getsockname(), 0.9) as client:
            with pytest.raises(BlockingIOError):
                listener.accept()
            accepted, address = listener.accept()
            with accepted:
                assert address == client.getsockname()
            with pytest.raises(BlockingIOError):
                listener.accept()
