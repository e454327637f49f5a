"""Tests of the acceptor of the dialects with their own ports."""

from __future__ import annotations

import socket
import time

import pytest
from eval_fakes import wait_for

from vlagents_ray_dialects import acceptor


@pytest.mark.slow
def test_connections_that_their_clients_have_ended_neither_count_nor_delay_the_next(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """If ended connections counted, the last client would wait for days at the rate set below."""
    monkeypatch.setattr(acceptor, "_ACCEPTED_PER_S", 1e-3)
    listener = socket.create_server(("127.0.0.1", 0))
    address = listener.getsockname()
    accepted: list[socket.socket] = []
    listener.listen(1000)
    for _ in range(300):
        socket.create_connection(address, 5).close()
    begun = time.monotonic()
    with socket.create_connection(address, 5) as client:
        accepting = acceptor.Acceptor("test", listener, accepted.append)
        wait_for(lambda: accepted, 5)
        assert time.monotonic() - begun < 5
        assert [each.getpeername() for each in accepted] == [client.getsockname()]
        accepting.close()
        accepted[0].close()
