"""A server that reads nothing from its clients, or only a few bytes from time to time."""

from __future__ import annotations

import contextlib
import socket
import ssl
import threading
from collections.abc import Iterator

from websockets.http11 import Request
from websockets.server import ServerProtocol

_PERIOD_S = 0.05  # time between two reads
_WINDOW_BYTES = 2**16  # bytes that the kernel receives although the server does not read


@contextlib.contextmanager
def deaf_server(
    read_bytes: int = 0,
    *,
    greeting: bytes | None = b"",
    context: ssl.SSLContext | None = None,
) -> Iterator[int]:
    """Accept connections, read at most `read_bytes` bytes from each every 50 ms, and yield the
    port.

    Args:
        read_bytes: Bytes of each read; 0 reads nothing.
        greeting: The first message over a WebSocket; if it is empty, no message is sent. None for a
            server without WebSockets, which does not read a handshake either.
        context: The TLS context of the server, or None for a server without TLS.
    """
    ended = threading.Event()

    def shake_hands(connection: socket.socket, message: bytes) -> None:
        protocol = ServerProtocol()
        protocol.receive_data(connection.recv(65536))
        [request] = protocol.events_received()
        assert isinstance(request, Request)
        protocol.send_response(protocol.accept(request))
        if message:
            protocol.send_binary(message)
        connection.sendall(b"".join(protocol.data_to_send()))

    def serve(accepted: socket.socket) -> None:
        with contextlib.suppress(OSError):
            connection = context.wrap_socket(accepted, server_side=True) if context else accepted
            with connection:
                if greeting is not None:
                    shake_hands(connection, greeting)
                while not ended.wait(_PERIOD_S):
                    if read_bytes and not connection.recv(read_bytes):
                        return

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = listener.accept()
                thread = threading.Thread(target=serve, args=(connection,), daemon=True)
                threads.append(thread)
                thread.start()

    threads: list[threading.Thread] = []
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _WINDOW_BYTES)
        accepting = threading.Thread(target=accept, daemon=True)
        accepting.start()
        try:
            yield listener.getsockname()[1]
        finally:
            ended.set()
            listener.shutdown(socket.SHUT_RDWR)
            for thread in [accepting, *threads]:
                thread.join(30)
