"""The HTTP transport, against a socket."""

from __future__ import annotations

import contextlib
import socket
import threading

from vlagents_ray.client.transports.base import CodecChoice
from vlagents_ray.client.transports.http import HttpTransport
from vlagents_ray.protocol.frames import encode_requests
from vlagents_ray.protocol.messages import Request


def test_head_and_body_of_a_request_arrive_together() -> None:
    """If the head came first, the proxy and the replica would each be woken twice."""
    arrived: list[bytes] = []

    def answer() -> None:
        for _ in range(20):
            arrived.append(connection.recv(65536))
            connection.sendall(b"HTTP/1.1 503 No replica\r\ncontent-length: 0\r\n\r\n")

    request = Request("close", request_id="1", session="a")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        url = f"http://127.0.0.1:{listener.getsockname()[1]}"
        with contextlib.closing(HttpTransport(url, CodecChoice("raw"))) as transport:
            transport._open(5)
            connection, _ = listener.accept()
            with connection:
                thread = threading.Thread(target=answer)
                thread.start()
                for _ in range(20):
                    transport.call([request], 5)
                thread.join()
    assert all(one.endswith(encode_requests([request])) for one in arrived)
