"""The opening handshake with a server that does not answer it, such as a frozen one behind a proxy,
and with a server that answers at once.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from certificates import authority
from websockets.sync.server import serve

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.websocket import ProxiedSocket

LIMIT_S = 0.5
SILENT_S = 20.0  # time for which the server keeps a connection


@contextlib.contextmanager
def silent_server(context: ssl.SSLContext | None) -> Iterator[int]:
    """Yield the port of a server that completes each TLS handshake, with session tickets, and sends
    nothing more.
    """
    ended = threading.Event()

    def serve(listener: socket.socket) -> None:
        with contextlib.suppress(OSError):  # the client or the test has ended
            connection = listener.accept()[0]
            if context is not None:
                connection = context.wrap_socket(connection, server_side=True)
            connection.recv(65536)
            ended.wait(SILENT_S)
            connection.close()

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve, args=(listener,))
        thread.start()
        yield listener.getsockname()[1]
        ended.set()
        thread.join()


@pytest.mark.parametrize("scheme", ["ws", "wss"])
def test_the_opening_handshake_ends_at_its_limit(scheme: str, tmp_path: Path) -> None:
    ours = authority(tmp_path, "ours")
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
    context.load_cert_chain(*ours.sign("server"))
    credentials = Credentials("", ours.file if scheme == "wss" else None)

    with silent_server(context if scheme == "wss" else None) as port:
        began = time.monotonic()
        with pytest.raises(TimeoutError):
            ProxiedSocket(f"{scheme}://127.0.0.1:{port}/v1/stream", credentials, LIMIT_S)
        assert time.monotonic() - began < SILENT_S / 2


def test_no_opening_handshake_over_tls_is_lost(tmp_path: Path) -> None:
    """In an earlier version one handshake in a hundred was lost, while another thread read the
    server's session ticket.
    """
    ours = authority(tmp_path, "ours")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*ours.sign("server"))
    credentials = Credentials("", ours.file)
    with serve(lambda connection: connection.close(), "127.0.0.1", 0, ssl=context) as server:
        serving = threading.Thread(target=server.serve_forever)
        serving.start()
        port = server.socket.getsockname()[1]
        for _ in range(100):
            ProxiedSocket(f"wss://127.0.0.1:{port}/", credentials, 10).close()
        server.shutdown()
        serving.join()
