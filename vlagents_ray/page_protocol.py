"""The HTTP protocol of the small servers that run without HAProxy: the page of an evaluation, and
the operator's page.

By itself, uvicorn waits for the headers of a request without a time limit, and accepts any number
of connections. So an attacker could use up the file descriptors of the process that runs the
robots.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from uvicorn.protocols.http.auto import AutoHTTPProtocol

# Maximum time without a request, s; an idle connection is closed within twice this time.
_HEADERS_S = 5.0
_CONNECTIONS = 128  # maximum number of connections
_CONNECTIONS_PER_ADDRESS = 32
# Maximum number of connections that asyncio accepts in one iteration of its event loop, during
# which no request is answered. With uvicorn's 2048, a client that keeps connecting and
# disconnecting delays each answer by 15 ms.
BACKLOG = 16
# Maximum number of connections that wait in the kernel. If more clients connect, the kernel
# discards their SYN packets, which the clients send again after one second.
_QUEUE = 1024
# Maximum number of ended connections that are closed in one iteration of the loop; each takes about
# 0.01 ms.
_ENDED_AT_ONCE = 64


class PageListener(socket.socket):
    """The listening socket of a page, which drops connections that their clients have already
    ended.

    Such a connection would occupy the event loop ten times as long, while other clients wait. The
    kernel's queue is longer than the number of connections that asyncio accepts in one iteration;
    asyncio has a single setting for both.
    """

    @classmethod
    def bound(cls, host: str, port: int) -> PageListener:
        """Return a listener at this address; port 0 selects a free port."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        created = socket.create_server((host, port), family=family)
        return cls(family, socket.SOCK_STREAM, 0, created.detach())

    def listen(self, backlog: int = _QUEUE, /) -> None:
        """Listen with a queue of at least `_QUEUE` connections."""
        super().listen(max(backlog, _QUEUE))

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept the next connection that has not ended; raise `BlockingIOError` if there is
        none.
        """
        for _ in range(_ENDED_AT_ONCE):
            connection, address = super().accept()
            if not _has_ended(connection):
                return connection, address
            connection.close()
        raise BlockingIOError  # the loop calls `accept` again in its next iteration


def _has_ended(connection: socket.socket) -> bool:
    """Return whether the client has ended a connection without sending anything."""
    try:
        return not connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT)
    except BlockingIOError:
        return False
    except OSError:  # the client has reset it
        return True


class PageProtocol(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
    """Bounds the number of connections, and closes one that sends no request."""

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Accept a connection, or close it at once if there are too many."""
        super().connection_made(transport)
        host = self.client and self.client[0]
        from_host = sum(1 for other in self.connections if other.client and other.client[0] == host)
        if len(self.connections) > _CONNECTIONS or from_host > _CONNECTIONS_PER_ADDRESS:
            # Without this line, uvicorn would count the connection until the loop's next iteration.
            # One address may connect 2,000 times before that iteration, and all other addresses
            # would exceed the total limit.
            self.connections.discard(self)
            transport.abort()
            return
        # asyncio sets TCP_NODELAY only on sockets with the protocol number of TCP, but
        # `create_server` leaves this number at 0. Without TCP_NODELAY, the body of an answer is
        # sent 40 ms late, after the client has acknowledged the headers.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._last_cycle: Any = None
        self.loop.call_later(_HEADERS_S, self._close_if_silent)

    def _close_if_silent(self) -> None:
        # With another protocol, the connection is a WebSocket.
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return
        answering = self.cycle is not None and not self.cycle.response_complete
        if not answering and self.cycle is self._last_cycle:
            self.transport.close()
            return
        self._last_cycle = self.cycle
        self.loop.call_later(_HEADERS_S, self._close_if_silent)
