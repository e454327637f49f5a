"""The HTTP protocol of the small servers without HAProxy: the page of an evaluation, and the
operator's page.

uvicorn waits for the headers of a request without a time limit, and accepts any number of
connections: strangers could use up the descriptors of the process that runs the robots.
"""

from __future__ import annotations

import asyncio
import socket
from typing import Any

from uvicorn.protocols.http.auto import AutoHTTPProtocol

_HEADERS_S = 5.0  # maximum time without a request, s; a connection is closed within twice that time
_CONNECTIONS = 128  # maximum number of connections
_CONNECTIONS_PER_ADDRESS = 32
# Maximum number of connections that asyncio accepts in one turn of its loop, during which nothing
# else is answered: with uvicorn's 2048, a client that connects and leaves delays each answer by
# 15 ms.
BACKLOG = 16
# Maximum number of connections that wait in the kernel. Above it the kernel discards a client's
# SYN, which the client repeats after one second.
_QUEUE = 1024
# Maximum number of ended connections that are closed in one turn; each takes about 0.01 ms.
_ENDED_AT_ONCE = 64


class PageListener(socket.socket):
    """The listener of a page: it accepts no connection that its client has ended already.

    Such a connection would take the loop ten times as long, and others wait behind it. The queue of
    waiting connections is longer than the number that asyncio accepts in one turn, for which
    asyncio has a single setting.
    """

    @classmethod
    def bound(cls, host: str, port: int) -> PageListener:
        """Return a listener at that address; port 0 selects a free one."""
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
        raise BlockingIOError  # the loop calls again in its next turn


def _has_ended(connection: socket.socket) -> bool:
    """Return whether the client has ended a connection, and has sent nothing before."""
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
            # uvicorn would count it until the loop's next turn, in which one address may have
            # connected 2,000 times: other addresses would then be over the limit of all
            # connections.
            self.connections.discard(self)
            transport.abort()
            return
        # asyncio sets this only if the listener was made with the protocol's number, which
        # `create_server` leaves at 0; without it, the body of an answer waits for 40 ms for the
        # client to acknowledge its head.
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._last_cycle: Any = None
        self.loop.call_later(_HEADERS_S, self._close_if_silent)

    def _close_if_silent(self) -> None:
        # It is a WebSocket now.
        if self.transport.is_closing() or self.transport.get_protocol() is not self:
            return
        answering = self.cycle is not None and not self.cycle.response_complete
        if not answering and self.cycle is self._last_cycle:
            self.transport.close()
            return
        self._last_cycle = self.cycle
        self.loop.call_later(_HEADERS_S, self._close_if_silent)
