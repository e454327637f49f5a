"""Accepting clients at a listening socket, whatever fails with one of them."""

from __future__ import annotations

import os
import resource
import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest

from vlagents_ray.protocol.messages import MessageLimits
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.endpoints.connection import _ENDED_AT_ONCE, BACKLOG, PolledServer
from vlagents_ray.serve.token_bucket import TokenBucket


class Endpoint(PolledServer[Any]):
    """An endpoint that keeps the connections of its clients, or fails to add them."""

    def __init__(self) -> None:
        listener = socket.create_server(("127.0.0.1", 0))
        listener.settimeout(5)
        engine = SimpleNamespace(queue=SimpleNamespace(poller=None))
        super().__init__(cast(Any, engine), MessageLimits(), NoKey.OPEN, listener)
        self.clients: list[socket.socket] = []
        self.broken = False

    def _add_client(self, connection: socket.socket) -> None:
        if self.broken:
            raise OSError
        self.clients.append(connection)

    def connect(self) -> socket.socket:
        return socket.create_connection(self._listener.getsockname(), 5)


@pytest.fixture
def endpoint() -> Iterator[Endpoint]:
    endpoint = Endpoint()
    yield endpoint
    endpoint.close()
    for each in endpoint.clients:
        each.close()


@contextmanager
def no_descriptors_left() -> Iterator[None]:
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    highest = max(map(int, os.listdir("/proc/self/fd")))
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 1, limits[1]))
    try:
        with ExitStack() as held:
            while True:
                try:
                    held.enter_context(open(os.devnull))
                except OSError:
                    break
            yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


@pytest.mark.own_process
def test_who_comes_when_no_descriptor_is_left_is_turned_away_and_the_next_let_in(
    endpoint: Endpoint,
) -> None:
    for _ in range(2):
        with endpoint.connect() as refused:
            with no_descriptors_left():
                endpoint.accept()
            assert refused.recv(1) == b""
    with endpoint.connect():
        endpoint.accept()
    assert len(endpoint.clients) == 1


def test_whom_the_endpoint_cannot_take_is_turned_away_and_the_next_let_in(
    endpoint: Endpoint,
) -> None:
    endpoint.broken = True
    with endpoint.connect() as refused:
        endpoint.accept()
        assert refused.recv(1) == b""
    endpoint.broken = False
    with endpoint.connect():
        endpoint.accept()
    assert len(endpoint.clients) == 1


def test_connections_that_their_clients_have_ended_neither_count_nor_delay_the_next(
    endpoint: Endpoint,
) -> None:
    """All connections also fit into the backlog. Otherwise the kernel would discard the next
    client's SYN, which is sent again after one second.
    """
    endpoint._listener.listen(BACKLOG)
    endpoint._accepting = TokenBucket(1e-3, time.monotonic())  # one connection in 1,000 s
    for _ in range(300):
        endpoint.connect().close()
    begun = time.monotonic()
    with endpoint.connect() as client:
        assert time.monotonic() - begun < 0.9
        for _ in range(300 // _ENDED_AT_ONCE + 1):
            endpoint.accept()
        assert [each.getpeername() for each in endpoint.clients] == [client.getsockname()]


def test_a_client_that_leaves_before_it_is_let_in_is_not_logged(
    endpoint: Endpoint, caplog: pytest.LogCaptureFixture
) -> None:
    endpoint._listener.setblocking(False)
    endpoint.connect().close()
    endpoint.accept()
    assert not endpoint.clients
    assert not caplog.records
