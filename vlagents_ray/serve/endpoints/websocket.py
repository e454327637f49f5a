"""The WebSocket port of a replica, without a proxy between the robot and the policy thread.

The metadata gives a client the port and an unguessable path, so that a client that may not read the metadata cannot
use the port; where there are API keys, the handshake must contain one, too. Messages are those of `WS /v1/stream` on
the server's port, which remains for clients that cannot reach this one. As with local clients the policy thread reads
the sockets (see `vlagents_ray.serve.endpoints.unix_messages`) and decodes the messages.
"""

from __future__ import annotations

import secrets
import socket
import time
from collections.abc import Collection
from functools import cache

from websockets.http11 import Request as Handshake

from vlagents_ray.errors import ConfigError, PolicyUnavailable, UnknownApp, VLAgentsError
from vlagents_ray.protocol.messages import STREAM_PATH, Limits, StreamAddress
from vlagents_ray.serve.access.api_keys import (
    Caller,
    Identity,
    NoKey,
    token_of,
)
from vlagents_ray.serve.access.origin_check import require_own_page
from vlagents_ray.serve.endpoints.acceptor import Acceptor
from vlagents_ray.serve.endpoints.unix_messages import Admit
from vlagents_ray.serve.endpoints.websocket_connection import WebSocketConnection
from vlagents_ray.serve.engine import arrival
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.periodic import each_half_second

_BACKLOG = 128
_MAX_HANDSHAKES = 64  # maximum of connections without a completed handshake

# The kernel detects a peer that vanished: after 20 s of silence it sends three probes, 5 s apart.
_KEEPALIVE = (("TCP_KEEPIDLE", 20), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3), ("TCP_USER_TIMEOUT", 35_000))


class WebSocketServer:
    """Listens from `open` on; all reading happens on the thread that polls for the batch queue."""

    def __init__(
        self,
        engine: Engine,
        limits: Limits,
        host: str,
        ports: tuple[int, int] | None,
        admit: Admit | NoKey,
        *,
        slow_s: float = 30.0,
        idle_s: float = 600.0,
        hosts: Collection[str] = (),
    ) -> None:
        """Bind a port.

        Args:
            engine: Executes the requests.
            limits: Of a request.
            host: The address to bind.
            ports: The first and last port to try, both included; None for any free port.
            admit: Returns the caller that a key belongs to, or raises for an invalid key.
            slow_s: Maximum time that a message may take to arrive, s.
            idle_s: Maximum time that a connection may be silent, s.
            hosts: Further host names of the server.

        Raises:
            ConfigError: All ports are in use.
        """
        self._hosts = hosts
        self._admit = admit
        self._engine = engine
        self._limits = limits
        self._slow_s = slow_s
        self._idle_s = idle_s
        self.path = STREAM_PATH + secrets.token_urlsafe(24)
        self._clients: set[WebSocketConnection] = set()
        self._handshaking: dict[WebSocketConnection, None] = {}  # without a handshake so far, in order of arrival
        self._listener = _bind(host, ports)
        self._acceptor = Acceptor(self._listener, self._add_client)
        self.address = StreamAddress(self._listener.getsockname()[1], self.path)

    def open(self) -> None:
        """Accept clients; call it before the engine starts."""
        arrival.enable_timestamps(self._listener)  # accepted connections inherit it; the kernel takes a moment to begin
        self._engine.queue.watch(self._listener, self._acceptor.accept)
        each_half_second.add(self.close_overdue)

    def close(self) -> None:
        """Close the listener and all connections; call it after the engine has ended."""
        each_half_second.remove(self.close_overdue)
        self._listener.close()
        self._acceptor.close()
        for client in list(self._clients):
            client.release()

    def _identify(self, client: WebSocketConnection, request: Handshake) -> Identity:
        """Return the owner of the handshake's key, and count one connection more for that key.

        Raises:
            UnknownApp: The path is another one.
            Unauthorized: The key is missing, unknown, revoked or expired.
            Forbidden: The key is for other applications, or the page is another site's.
            TooManyRequests: The key has as many connections as it may hold sessions, or is over its rate.
            PolicyUnavailable: The replica has as many connections as it may hold sessions.
        """
        if not secrets.compare_digest(request.path.encode(), self.path.encode()):
            raise UnknownApp("no such path")
        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        caller: Identity
        if isinstance(self._admit, NoKey):
            require_own_page(headers, self._hosts)
            caller = self._admit
        else:
            caller = self._admit(token_of(headers))
        if (full := self._full()) is not None:
            raise full
        if isinstance(caller, Caller):
            caller.require_unthrottled()
            caller.hold()
            caller.note("let in by", client.name)
        del self._handshaking[client]
        return caller

    def _full(self) -> VLAgentsError | None:
        """Return the error for further clients if the replica has as many connections as it may hold sessions."""
        held, limit = len(self._clients) - len(self._handshaking), self._engine.sessions.limit
        return PolicyUnavailable(f"this replica has {held} streams, its limit of sessions") if held >= limit else None

    def _remove(self, client: WebSocketConnection) -> None:
        """Remove a client whose connection is closed."""
        self._handshaking.pop(client, None)
        self._clients.discard(client)
        if isinstance(client.caller, Caller):
            client.caller.hold(-1)

    def close_overdue(self) -> None:
        """Close the connections that are overdue, silent, or whose key is no longer valid; works on any thread."""
        now = time.monotonic()
        refusal = cache(Caller.refusal)  # evaluated once for all connections of a key
        for client in list(self._clients):
            if (cause := client.overdue(now, refusal)) is not None:
                client.end(*cause)

    def _add_client(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        if len(self._handshaking) >= _MAX_HANDSHAKES:
            next(iter(self._handshaking)).disconnect()
        client = WebSocketConnection(
            connection,
            self._engine,
            self._limits,
            self._identify,
            self._remove,
            slow_s=self._slow_s,
            idle_s=self._idle_s,
        )
        self._clients.add(client)
        self._handshaking[client] = None
        self._engine.queue.watch(connection, client.ready)


def _bind(host: str, ports: tuple[int, int] | None) -> socket.socket:
    first, last = ports or (0, 0)
    for port in range(first, last + 1):
        listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, port))
            listener.listen(_BACKLOG)
            listener.setblocking(False)
        except OSError as error:
            listener.close()
            refusal = error
        else:
            return listener
    raise ConfigError(f"stream: cannot listen at {host}, ports {first} to {last} ({refusal}); choose other ones")
