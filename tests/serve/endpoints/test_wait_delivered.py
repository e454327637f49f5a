"""The wait until a client has received its last answers ends when the connection ends."""

from __future__ import annotations

import socket
import time

from vlagents_ray.serve.endpoints.connection import wait_delivered

LONG_S = 20.0


def connected() -> tuple[socket.socket, socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        client = socket.create_connection(listener.getsockname())
        return client, listener.accept()[0]


def test_a_connection_that_another_thread_has_closed_delivers_nothing_more() -> None:
    client, server = connected()
    server.close()
    began = time.monotonic()
    wait_delivered(server, began + LONG_S)
    assert time.monotonic() < began + LONG_S
    client.close()


def test_a_client_that_has_gone_is_not_waited_for() -> None:
    client, server = connected()
    with client, server:
        server.setblocking(False)
        while True:  # until the client's buffer is full
            try:
                server.send(bytes(1_000_000))
            except BlockingIOError:
                break
        client.close()
        began = time.monotonic()
        wait_delivered(server, began + LONG_S)
        assert time.monotonic() < began + LONG_S
