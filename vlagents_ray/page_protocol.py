"""The HTTP protocol of the small servers without HAProxy: the page of an evaluation, and the operator's page.

uvicorn waits for the headers of a request without a time limit, and accepts any number of connections: strangers could
use up the descriptors of the process that runs the robots.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.auto import AutoHTTPProtocol

_HEADERS_S = 5.0  # maximum time without a request, s; a connection is closed within twice that time
_CONNECTIONS = 128  # maximum number of connections
_CONNECTIONS_PER_ADDRESS = 32


class PageProtocol(AutoHTTPProtocol):  # type: ignore[misc, valid-type]
    """Bounds the number of connections, and closes one that sends no request."""

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Accept a connection, or close it at once if there are too many."""
        super().connection_made(transport)
        host = self.client and self.client[0]
        from_host = sum(1 for other in self.connections if other.client and other.client[0] == host)
        if len(self.connections) > _CONNECTIONS or from_host > _CONNECTIONS_PER_ADDRESS:
            transport.abort()
            return
        self._last_cycle: Any = None
        self.loop.call_later(_HEADERS_S, self._close_if_silent)

    def _close_if_silent(self) -> None:
        if self.transport.is_closing() or self.transport.get_protocol() is not self:  # it is a WebSocket now
            return
        answering = self.cycle is not None and not self.cycle.response_complete
        if not answering and self.cycle is self._last_cycle:
            self.transport.close()
            return
        self._last_cycle = self.cycle
        self.loop.call_later(_HEADERS_S, self._close_if_silent)
