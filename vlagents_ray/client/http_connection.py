"""A connection to an HTTP/1.1 server, with one time limit for each exchange.

`http.client.HTTPConnection` sends the head and the body of a request separately, which wakes up the
server twice, and copies large bodies. Its time limit applies to each read, so a server that sends a
byte from time to time could keep its client waiting forever. So this module writes the requests
itself, in one call, and limits the time of the whole exchange. The answers are parsed by
`http.client.HTTPResponse`.
"""

from __future__ import annotations

import http.client
import io
import re
import select
import socket
import ssl
import time
from collections.abc import Mapping, Sequence
from typing import IO, Any, cast
from urllib.parse import SplitResult

from vlagents_ray.protocol.frame_layout import Buffer

_DEFAULT_PORTS = {"http": http.client.HTTP_PORT, "https": http.client.HTTPS_PORT}
_FORBIDDEN = re.compile(r"[\0-\x1f\x7f]")  # characters that could forge another header


class ServerConnection:
    """An open connection to a server, which carries one exchange at a time.

    Args:
        url: The address of the server; only its scheme, host and port are used.
        context: The settings of TLS; None if the scheme is not "https".
        timeout_s: The time limit of connecting, s.

    Raises:
        OSError: The server cannot be reached; `ssl.SSLError` if TLS fails.
    """

    def __init__(self, url: SplitResult, context: ssl.SSLContext | None, timeout_s: float) -> None:
        host, default_port = url.hostname or "", _DEFAULT_PORTS[url.scheme]
        port = url.port or default_port
        self._socket = socket.create_connection((host, port), timeout_s)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if context is not None:
                context.set_alpn_protocols(["http/1.1"])
                self._socket = context.wrap_socket(self._socket, server_hostname=host)
        except BaseException:
            self._socket.close()
            raise

        self._host = _host_header(host, None if port == default_port else port)
        self._deadline = time.monotonic() + timeout_s
        self.poller = select.poll()  # polls whether there is something to read
        self.poller.register(self._socket, select.POLLIN)

    @property
    def sock(self) -> socket.socket:
        """The socket of the connection."""
        return self._socket

    @property
    def is_open(self) -> bool:
        """Whether the server has left the connection open between two exchanges, as far as this
        process knows.
        """
        if not self.poller.poll(0):
            return True
        if not isinstance(self._socket, ssl.SSLSocket):
            return False  # a closed connection is readable

        # The server may have sent a session ticket, which the read processes.
        self._socket.settimeout(0)
        try:
            self._socket.recv(1)
        except ssl.SSLWantReadError:
            return True
        except OSError:
            pass
        return False

    def send(
        self,
        method: str,
        target: str,
        headers: Mapping[str, str],
        body: Sequence[Buffer],
        timeout_s: float,
    ) -> None:
        """Begin an exchange: send a request.

        Args:
            method: The method, such as "POST".
            target: The path, and perhaps a query, in ASCII.
            headers: Further headers than the host and the length of the body.
            body: Consecutive pieces of the body; empty if the request has no body.
            timeout_s: The time limit of the whole exchange, s.

        Raises:
            http.client.InvalidURL: The target contains a character that HTTP does not permit.
            ValueError: A header contains such a character.
            OSError: The connection broke; `TimeoutError` if the time is over.
        """
        self._deadline = time.monotonic() + timeout_s
        # Without `identity`, a proxy might compress the answer.
        fields = {"host": self._host, "accept-encoding": "identity"}
        size = sum(memoryview(piece).nbytes for piece in body)
        if size or method != "GET":
            fields["content-length"] = str(size)
        head = request_head(method, target, {**fields, **headers})
        self._send_all(b"".join([head, *body]))

    def receive(self, method: str) -> http.client.HTTPResponse:
        """Return the response to the last request, of which the head has been read.

        Raises:
            http.client.HTTPException: The answer is not HTTP.
            OSError: The connection broke; `TimeoutError` if the time is over.
        """
        response = http.client.HTTPResponse(cast(socket.socket, self), method=method)
        response.begin()
        return response

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()

    def makefile(self, mode: str) -> IO[bytes]:
        """Return a buffered reader of one answer, for `http.client.HTTPResponse`."""
        if mode != "rb":
            raise ValueError(f"mode: expected 'rb', got {mode!r}")
        return io.BufferedReader(_AnswerReader(self))

    def receive_into(self, buffer: Buffer) -> int:
        """Read bytes within the time limit of the exchange; return their number, 0 at the end."""
        self._limit_next_call()
        return self._socket.recv_into(buffer)

    def _send_all(self, data: bytes) -> None:
        """Send all of the data within the time limit of the exchange.

        A TLS socket's `sendall` would apply the limit to each record.
        """
        remaining = memoryview(data)
        while remaining:
            self._limit_next_call()
            remaining = remaining[self._socket.send(remaining) :]

    def _limit_next_call(self) -> None:
        """Limit the next call of the socket to the remaining time of the exchange.

        Raises:
            TimeoutError: No time remains.
        """
        left_s = self._deadline - time.monotonic()
        if left_s <= 0:
            raise TimeoutError("timed out")
        self._socket.settimeout(left_s)


class _AnswerReader(io.RawIOBase):
    """Reads one answer. The connection stays open when the reader is closed."""

    def __init__(self, connection: ServerConnection) -> None:
        self._connection = connection

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        return self._connection.receive_into(buffer)


def request_head(method: str, target: str, headers: Mapping[str, str]) -> bytes:
    """Return the head of a request.

    Raises:
        http.client.InvalidURL: The target contains a character that HTTP does not permit.
        ValueError: A header contains such a character.
    """
    if not target.isascii() or " " in target or _FORBIDDEN.search(target):
        raise http.client.InvalidURL(f"expected a path of visible ASCII characters, got {target!r}")
    lines = [f"{method} {target} HTTP/1.1"]
    for name, value in headers.items():
        if _FORBIDDEN.search(value):
            raise ValueError(f"header {name}: expected no control characters, got {value!r}")
        lines.append(f"{name}: {value}")
    return "\r\n".join([*lines, "\r\n"]).encode("latin-1")


def _host_header(host: str, port: int | None) -> str:
    """Return the value of the header `host`; `port` is None if it is the default of the scheme."""
    name = host if host.isascii() else host.encode("idna").decode()
    name = f"[{name}]" if ":" in name else name
    return name if port is None else f"{name}:{port}"
