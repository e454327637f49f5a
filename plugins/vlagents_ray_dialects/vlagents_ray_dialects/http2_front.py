"""A proxy between the clients of a gRPC dialect and gRPC's server, which limits the connections and
the frames.

gRPC's library accepts and answers on native threads, as fast as a client sends: eight clients
without a session that connect and send pings use both cores of a small machine. The front accepts
at a bounded rate, forwards a connection only after its HTTP/2 preface, and stops reading from a
connection that sends more small frames than a robot needs.
"""

from __future__ import annotations

import socket
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.serve.token_bucket import TokenBucket
from vlagents_ray_dialects.client_reader import share_of
from vlagents_ray_dialects.forwarding import SHORT_FOLDER, ForwardedConnection
from vlagents_ray_dialects.messages.http2 import PREFACE, FrameCounter

_HANDSHAKE_S = 5.0  # maximum time until the preface of a client
_END_S = 3.0  # maximum time for the last answers when the front is closed
# A robot sends about four small frames with each request, and at most 7 at once. At 30 Hz, with two
# requests for each observation, it sends 270 in a second.
_FRAMES_PER_S = 300.0
_FRAMES_AT_ONCE = 150
# The time for which a connection with more frames stays open without being read, s. If the
# connection ended immediately, its client would connect again, which costs the server more than the
# frames.
_UNREAD_S = 1.0
# Maximum number of connections that are not clients; one more ends the oldest.
_STRANGERS = 64


class Http2Front:
    """Forwards connections to a gRPC server on a Unix socket that only this user can reach.

    gRPC's server must listen at `address`.

    Args:
        name: The name of the dialect.
        is_client: Returns whether a peer is a client, given gRPC's name of the peer,
            `ServicerContext.peer()`.
        forget: Called with gRPC's name of a peer whose connection has ended.
    """

    def __init__(
        self, name: str, is_client: Callable[[str], bool], forget: Callable[[str], None]
    ) -> None:
        self.name = name
        self._is_client = is_client
        self._forget = forget
        self._folder = tempfile.TemporaryDirectory(prefix="vlr-", dir=SHORT_FOLDER)
        self.path = str(Path(self._folder.name, "grpc"))
        self._lock = threading.Lock()  # guards the next two fields
        # The open connections, the oldest first.
        self._connections: dict[Http2Connection, None] = {}
        self._shares: dict[str, str] = {}  # names of shares by gRPC's name of the peer

    @property
    def address(self) -> str:
        """The address for gRPC's server."""
        return f"unix:{self.path}"

    def add(self, client: socket.socket) -> None:
        """Forward a connection on its own threads. If there are too many connections that are not
        clients, end the oldest of them.
        """
        connection = Http2Connection(self, client)
        with self._lock:
            strangers = []
            for earlier in self._connections:
                if earlier.is_open and not self._is_client(earlier.peer):
                    strangers.append(earlier)
            self._connections[connection] = None

        if len(strangers) >= _STRANGERS:
            strangers[0].end()
        connection.thread.start()

    def share_of(self, peer: str) -> str:
        """Return the name of a peer's share of the bytes in flight, which is the name of its
        address.
        """
        with self._lock:
            return self._shares.get(peer, "address unknown")

    def set_share(self, peer: str, share: str) -> None:
        """Set the name of a peer's share, before the peer is connected to gRPC's server."""
        with self._lock:
            self._shares[peer] = share

    def remove(self, connection: Http2Connection) -> None:
        """Remove a connection that has ended."""
        with self._lock:
            del self._connections[connection]
            self._shares.pop(connection.peer, None)
        self._forget(connection.peer)

    def close(self) -> None:
        """Forward the last answers to clients, end all connections, and remove the socket.

        gRPC's server must have been stopped.
        """
        with self._lock:
            connections = list(self._connections)

        deadline = time.monotonic() + _END_S
        clients = [connection for connection in connections if self._is_client(connection.peer)]
        for connection in connections:
            # A connection that is not a client must not delay the stop.
            if connection not in clients:
                connection.end()
        for connection in clients:
            connection.wait_answered(deadline)
            connection.end()
        for connection in connections:
            connection.thread.join(max(0.0, deadline - time.monotonic()))
        self._folder.cleanup()


class Http2Connection(ForwardedConnection):
    """One connection of a client, and its connection to gRPC's server.

    Args:
        front: The front.
        client: The connection of the client.
    """

    def __init__(self, front: Http2Front, client: socket.socket) -> None:
        super().__init__(front.name, client)
        self._front = front
        self.peer = f"unix-abstract:{self._server.getsockname()[1:].decode()}"
        self._frames = FrameCounter()
        self._allowed_frames = TokenBucket(_FRAMES_PER_S, time.monotonic(), _FRAMES_AT_ONCE)

    def greet(self) -> tuple[str, bytes]:
        """Read the preface of HTTP/2; raise `MalformedMessage` for other bytes."""
        deadline = time.monotonic() + _HANDSHAKE_S
        preface = b""
        while preface != PREFACE:
            received = self.read(len(PREFACE) - len(preface), deadline)
            preface += received
            if not received or not PREFACE.startswith(preface):
                raise MalformedMessage(
                    "expected the preface of HTTP/2, got another one; use a client of gRPC"
                )
        self._front.set_share(self.peer, share_of(self._client))
        return self._front.path, PREFACE

    def admit(self, data: bytes) -> bool:
        """Wait until the client's frames are within the allowed rate."""
        frames = self._frames.count(data)
        if frames > _FRAMES_AT_ONCE:
            self._ended.wait(_UNREAD_S)
            raise MalformedMessage(
                f"expected at most {_FRAMES_AT_ONCE} small frames at once, got {frames}"
            )

        wait_s = self._allowed_frames.take(time.monotonic(), frames)
        while wait_s > 0:
            if self._ended.wait(wait_s):
                return False
            wait_s = self._allowed_frames.take(time.monotonic(), frames)
        return True

    def closed(self) -> None:
        self._front.remove(self)
