"""A TLS socket that one thread reads while others write."""

from __future__ import annotations

import contextlib
import os
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from certificates import authority
from eval_fakes import wait_for

from vlagents_ray.client.shared_tls_socket import SharedTlsSocket

SIZE = 4 * 1024 * 1024  # more than the kernel's buffers take
LIMIT_S = 0.3


@contextlib.contextmanager
def connection(folder: Path) -> Iterator[tuple[SharedTlsSocket, ssl.SSLSocket]]:
    """Yield the two ends of a connection, the client's and the server's. Nothing reads the server's
    end yet.
    """
    ours = authority(folder, "ours")
    server_context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    server_context.load_cert_chain(*ours.sign("server"))
    client_context = ssl.create_default_context(cafile=str(ours.file))
    accepted: list[ssl.SSLSocket] = []

    client_end, server_end = socket.socketpair()
    accepting = threading.Thread(
        target=lambda: accepted.append(server_context.wrap_socket(server_end, server_side=True))
    )
    accepting.start()
    tls = client_context.wrap_socket(client_end, server_hostname="127.0.0.1")
    accepting.join()
    client, [server] = SharedTlsSocket(tls), accepted
    try:
        yield client, server
    finally:
        client.close()
        server.close()


def received(end: SharedTlsSocket | ssl.SSLSocket, size: int) -> bytes:
    """Read `size` bytes."""
    data = bytearray()
    while len(data) < size:
        piece = end.recv(65536)
        assert piece, "the connection ended"
        data += piece
    return bytes(data)


def test_a_thread_writes_while_another_one_reads(tmp_path: Path) -> None:
    """Both ends send at the same time, and much more than the kernel's buffers take."""
    to_server, to_client = os.urandom(SIZE), os.urandom(SIZE)
    read: dict[str, bytes] = {}
    with connection(tmp_path) as (client, server):

        def serve() -> None:
            read["server"] = received(server, SIZE)
            server.sendall(to_client)

        def read_client() -> None:
            read["client"] = received(client, SIZE)

        threads = [threading.Thread(target=serve), threading.Thread(target=read_client)]
        for thread in threads:
            thread.start()
        client.sendall(to_server)
        for thread in threads:
            thread.join(60)
    assert read == {"server": to_server, "client": to_client}


def test_closing_ends_a_read_that_waits(tmp_path: Path) -> None:
    ends: list[object] = []
    with connection(tmp_path) as (client, _):

        def read() -> None:
            try:
                ends.append(client.recv(10))
            except OSError as error:
                ends.append(error)

        reading = threading.Thread(target=read, daemon=True)
        reading.start()
        time.sleep(0.1)
        begun = time.monotonic()
        client.close()
        wait_for(lambda: not reading.is_alive(), 10)
        assert time.monotonic() - begun < 0.9  # it does not wait for its next check
    assert len(ends) == 1
    with pytest.raises(OSError, match="Bad file descriptor"):
        client.recv(10)


def test_a_read_and_a_write_end_at_their_limits(tmp_path: Path) -> None:
    with connection(tmp_path) as (client, _):
        client.settimeout(LIMIT_S)
        begun = time.monotonic()
        with pytest.raises(TimeoutError):
            client.recv(10)
        with pytest.raises(TimeoutError):
            client.sendall(bytes(SIZE))
        assert 2 * LIMIT_S <= time.monotonic() - begun < 5


def test_the_end_of_the_peer_is_an_empty_read(tmp_path: Path) -> None:
    with connection(tmp_path) as (client, server):
        server.sendall(b"last")
        server.shutdown(socket.SHUT_RDWR)
        assert received(client, 4) == b"last"
        assert client.recv(10) == b""
