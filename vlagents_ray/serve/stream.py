"""A replica's own port for WebSockets: no proxy between the robot and the policy's thread.

The metadata tells a client the port and a path that nobody can guess, so that whoever may not read the one
cannot use the other; where there are keys, a client shows its own once more. Messages are those of `WS /v1/stream`
on the server's port, which stays for clients that do not reach this one. As with local clients the policy's own
thread reads the sockets (see `vlagents_ray.serve.local`), and decodes what they bring.
"""

from __future__ import annotations

import secrets
import socket

from websockets.http11 import Request as Handshake

from vlagents_ray.errors import ConfigError, PolicyUnavailable, UnknownApp, VLAgentsError
from vlagents_ray.serve.auth import Caller, token_of
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.local import Admit
from vlagents_ray.serve.origin import require_own_page
from vlagents_ray.serve.porter import Porter
from vlagents_ray.serve.stream_client import StreamClient
from vlagents_ray.wire.messages import STREAM_PATH, Limits, StreamAddress

_BACKLOG = 128
_STRANGERS = 64  # connections that have not said yet what they want

# A peer that vanished is noticed by the kernel: after 20 s of silence it asks every 5 s, three times.
_KEEPALIVE = (("TCP_KEEPIDLE", 20), ("TCP_KEEPINTVL", 5), ("TCP_KEEPCNT", 3), ("TCP_USER_TIMEOUT", 35_000))


class StreamDoor:
    """Listens from `open` on; everything else happens where the batch queue hears."""

    def __init__(
        self,
        engine: Engine,
        limits: Limits,
        host: str,
        ports: tuple[int, int] | None = None,
        admit: Admit | None = None,
    ) -> None:
        """At a port between `ports`, both included; None: any. `ConfigError` if all are taken.

        `admit`, where there are keys, says whose a client's is, or raises that it is none.
        """
        self._admit = admit
        self.engine = engine
        self.limits = limits
        self.path = STREAM_PATH + secrets.token_urlsafe(24)
        self._clients: set[StreamClient] = set()
        self._strangers: dict[StreamClient, None] = {}  # in the order they came
        self._listener = _listen(host, ports)
        self._porter = Porter(self._listener, self._welcome)
        self.address = StreamAddress(self._listener.getsockname()[1], self.path)

    def open(self) -> None:
        """Let clients in; before the engine starts."""
        self.engine.queue.watch(self._listener, self._porter.accept)

    def close(self) -> None:
        """Hang up; after the engine has ended."""
        self._listener.close()
        self._porter.close()
        for client in list(self._clients):
            client.release()

    def admit(self, client: StreamClient, request: Handshake) -> Caller | None:
        """Whose key it shows, where that is asked; `UnknownApp` for another path, `Unauthorized`, `Forbidden`."""
        if not secrets.compare_digest(request.path.encode(), self.path.encode()):
            raise UnknownApp("no such path")
        caller = None
        headers = {name.lower(): value for name, value in request.headers.raw_items()}
        if self._admit is None:
            require_own_page(headers)
        else:
            caller = self._admit(token_of(headers))
        self._strangers.pop(client, None)
        return caller

    def gone(self, client: StreamClient) -> None:
        """Its connection is closed."""
        self._strangers.pop(client, None)
        self._clients.discard(client)

    def full(self) -> VLAgentsError | None:
        """Why nobody else is let in, if that is so."""
        held, limit = len(self._clients) - len(self._strangers), self.engine.sessions.limit
        if held <= limit:
            return None
        return PolicyUnavailable(f"this replica has {held - 1} streams, its limit of sessions")

    def _welcome(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for name, value in _KEEPALIVE:
            if hasattr(socket, name):
                connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
        if len(self._strangers) >= _STRANGERS:
            next(iter(self._strangers)).hang_up()
        client = StreamClient(connection, self)
        self._clients.add(client)
        self._strangers[client] = None
        self.engine.queue.watch(connection, client.ready)


def _listen(host: str, ports: tuple[int, int] | None) -> socket.socket:
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
