"""A replica's own port, for WebSockets and HTTP, without a proxy between the robot and the policy
thread.

Large messages are not copied, and a client that reads slowly delays no other client.

The metadata contains the port and an unguessable path, so that only clients that may read the
metadata can use the port; on a server with API keys, a handshake or a request must also contain a
key. The messages of WebSockets are the same as at `WS /v1/stream` on the server's port, and the
HTTP requests are the same as at `POST /v1/act`. Clients that cannot reach this port use the
server's port. As for local clients, the policy thread reads the sockets (see
`vlagents_ray.serve.endpoints.connection`) and decodes the messages.
"""

from __future__ import annotations

import contextlib
import logging
import re
import secrets
import socket
import time
from collections.abc import Callable, Collection, Mapping
from typing import ClassVar

from websockets.http11 import Request as Handshake
from websockets.protocol import State

from vlagents_ray.errors import (
    ConfigError,
    PolicyUnavailable,
    TooManyRequests,
    UnknownApp,
    VLAgentsError,
)
from vlagents_ray.protocol import messages
from vlagents_ray.serve.access.api_keys import Caller, Identity, NoKey, token_of
from vlagents_ray.serve.access.origin_check import require_own_page
from vlagents_ray.serve.endpoints.connection import (
    BACKLOG,
    KeyCheck,
    enable_timestamps,
    has_unread,
)
from vlagents_ray.serve.endpoints.http_connection import (
    END_OF_HEAD,
    HEAD_BYTES,
    HttpConnection,
    HttpServer,
    head_bytes,
    is_too_large,
)
from vlagents_ray.serve.endpoints.message_connection import MessageConnection
from vlagents_ray.serve.endpoints.request_stream import RequestStream
from vlagents_ray.serve.endpoints.websocket_connection import WebSocketConnection
from vlagents_ray.serve.engine.engine import Engine

logger = logging.getLogger(__name__)

_MAX_HANDSHAKES = 64  # maximum number of connections without a completed handshake
_HANDSHAKE_S = 5.0  # maximum time of a handshake
_REFUSED_S = 1.0  # maximum time for which the refusal of a handshake is delayed
# The head of a WebSocket's handshake; any other head belongs to an HTTP request.
_HANDSHAKE = re.compile(rb"\AGET .*\r\nupgrade:[ \t]*websocket\b", re.IGNORECASE | re.DOTALL)
_REFUSED = "its handshake is refused"  # a further reason for not polling a connection

# The kernel detects that a peer has disappeared: after 20 s of silence it sends three probes, 5 s
# apart.
_KEEPALIVE = (
    ("TCP_KEEPIDLE", 20),
    ("TCP_KEEPINTVL", 5),
    ("TCP_KEEPCNT", 3),
    ("TCP_USER_TIMEOUT", 35_000),
)


class OwnPortServer(HttpServer):
    """Accepts WebSockets and HTTP connections at a port of the replica."""

    name: ClassVar[str] = "websocket"

    def __init__(
        self,
        engine: Engine,
        limits: messages.MessageLimits,
        host: str,
        ports: tuple[int, int] | None,
        check_key: KeyCheck | NoKey,
        *,
        slow_s: float = 30.0,
        idle_s: float = 600.0,
        hosts: Collection[str] = (),
    ) -> None:
        """Bind a port.

        Args:
            ports: The first and last port to try, both included; None for any free port.
            check_key: Returns the caller that owns a key, or raises an error for an invalid key.
            slow_s: Maximum time that a message may take to arrive, s.
            idle_s: Maximum time that a connection may be silent, s.
            hosts: Further host names of the server.

        Raises:
            ConfigError: All ports are in use.
        """
        super().__init__(engine, limits, check_key, _bind(host, ports))

        self.slow_s = slow_s
        self.idle_s = idle_s
        self._hosts = hosts
        self.path = messages.STREAM_PATH + secrets.token_urlsafe(24)

        # Connections whose handshake is not complete, in order of arrival.
        self._handshaking: dict[MessageConnection, None] = {}
        self.address = messages.StreamAddress(self._listener.getsockname()[1], self.path)

    def open(self) -> None:
        """Accept clients; call this before the engine starts."""
        # Accepted connections inherit this socket option, which the kernel enables after a moment.
        enable_timestamps(self._listener)
        super().open()

    def identify(self, client: PortConnection, request: Handshake) -> Identity:
        """Return the owner of the handshake's key, and count one more connection for that key.

        Raises:
            UnknownApp: The path is wrong.
            VLAgentsError: The errors of `identify_request` and `count_connection`.
        """
        if not secrets.compare_digest(request.path.encode(), self.path.encode()):
            raise UnknownApp("no such path")

        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        caller, _ = self.identify_request(headers)
        self.count_connection(client, caller)
        return caller

    def identify_request(
        self, headers: Mapping[str, str], known: tuple[Identity, str | None] | None = None
    ) -> tuple[Identity, str | None]:
        if isinstance(self.check_key, NoKey):
            require_own_page(headers, self._hosts)
            return self.check_key, None
        token = token_of(headers)
        if known is not None and token == known[1]:
            return known
        return self.check_key(token), token

    def count_connection(self, client: MessageConnection, caller: Identity) -> None:
        connections = len(self._clients) - len(self._handshaking)
        if client in self._handshaking and connections >= self.engine.sessions.limit:
            raise PolicyUnavailable(
                f"this replica has {connections} streams, its limit of sessions"
            )
        if isinstance(caller, Caller):
            caller.require_unthrottled()
            caller.hold()
            caller.note("let in by", "http" if isinstance(client, HttpConnection) else self.name)
        if isinstance(client.caller, Caller):
            client.caller.hold(-1)
        self._handshaking.pop(client, None)

    def op_of(self, path: str) -> messages.Op | None:
        base, _, name = path.rpartition("/")
        is_known = secrets.compare_digest(base.encode(), self.path.encode())
        return next((op for op in messages.OPS if is_known and op == name), None)

    def serve_http(self, client: PortConnection, connection: socket.socket, head: bytes) -> None:
        """Serve a connection whose first head belongs to an HTTP request; the head is empty if it
        is too large.
        """
        successor = HttpConnection(self, connection)
        client.replace_by(successor)
        self._handshaking[successor] = None
        successor.take_over(head)

    def remove(self, client: MessageConnection) -> None:
        """Remove a connection, possibly during its handshake."""
        self._handshaking.pop(client, None)
        super().remove(client)

    def _add_client(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)

        if len(self._handshaking) >= _MAX_HANDSHAKES:
            oldest = next(iter(self._handshaking))
            oldest.disconnect()
        client = PortConnection(self, connection)
        self.serve(client, connection)
        self._handshaking[client] = None


class PortConnection(WebSocketConnection):
    """A WebSocket of the replica's own port, from its handshake to its end."""

    def __init__(self, server: OwnPortServer, connection: socket.socket) -> None:
        super().__init__(
            server,
            connection,
            server.engine.admission,
            slow_s=server.slow_s,
            idle_s=server.idle_s,
        )
        self._server = server
        self._head = b""  # received part of the handshake
        self._opened_at = time.monotonic()
        # Time after which the key of the handshake is no longer over its rate.
        self._refused_for_s = 0.0

    def _bytes_to_read(self) -> int:
        """Return how many bytes to read now: first at most the handshake, and then at most one
        frame.
        """
        if self._handler is not None:
            return super()._bytes_to_read()

        return head_bytes(self._connection, self._head)

    def _receive_bytes(self, data: bytes | memoryview) -> bool:
        if self._handler is not None:
            return super()._receive_bytes(data)

        if not data:
            self.disconnect()
            return False
        self._head += data
        is_rejected = is_too_large(self._head)
        if not (is_rejected or self._head.endswith(END_OF_HEAD)):
            return False

        head, self._head = self._head, b""
        if is_rejected or not _HANDSHAKE.search(head):
            self._server.serve_http(self, self._connection, b"" if is_rejected else head)
        elif not self._accept_handshake(head):
            self._refuse_handshake()
        return False

    def _accept_handshake(self, head: bytes) -> bool:
        """Accept the handshake; return False if it is rejected, before the refusal is sent."""
        with self._sending:
            self._protocol.receive_data(head)
            events = self._protocol.events_received()
        if len(events) == 1 and isinstance(events[0], Handshake):
            try:
                self.account.identify(self._server.identify(self, events[0]))
                response = self._protocol.accept(events[0])
            except VLAgentsError as refused:
                response = self._protocol.reject(refused.status, f"{refused}\n")
                if isinstance(refused, TooManyRequests | PolicyUnavailable):
                    response.headers["Retry-After"] = "1"
                if isinstance(refused, TooManyRequests):
                    self._refused_for_s = refused.retry_after_s
            with self._sending:
                self._protocol.send_response(response)

        if self._protocol.state is not State.OPEN or self.caller is None:
            return False
        server = self._server
        self.accepted(RequestStream(self, server.engine, server.limits, self.caller))
        with self._sending:
            self._flush()
        return True

    def _refuse_handshake(self) -> None:
        """Reject the handshake.

        If the key is over its rate, the refusal is delayed, which bounds the rate of refusals.
        """
        self._pause(_REFUSED)

        def refuse() -> None:
            """Send the refusal, and close the connection."""
            with self._sending:
                if not self._ended:
                    self._flush()
                    # Closing a socket with unread bytes resets the connection.
                    with contextlib.suppress(OSError):
                        self._connection.recv(HEAD_BYTES)
            self.disconnect()

        if self._refused_for_s > 0:
            self._call_later(min(self._refused_for_s, _REFUSED_S), refuse)
        else:
            refuse()

    def overdue(
        self, now: float, refusal: Callable[[Caller], str | None]
    ) -> tuple[str, int] | None:
        """Return a reason and a close code, as in `WebSocketConnection`; cut off a client without
        a complete handshake.
        """
        if self._handler is not None:
            return super().overdue(now, refusal)
        if now - self._opened_at > _HANDSHAKE_S:
            with self._sending:
                is_unread = not self._ended and has_unread(self._connection)
            if not is_unread:
                self._cut_off()
        return None


def _bind(host: str, ports: tuple[int, int] | None) -> socket.socket:
    """Return a non-blocking socket that listens at the first free port."""
    first, last = ports or (0, 0)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    for port in range(first, last + 1):
        listener = socket.socket(family)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(BACKLOG)
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            refusal = error
        else:
            return listener
    raise ConfigError(
        f"stream: cannot listen at {host}, ports {first} to {last} ({refusal}); choose other ports"
    )
