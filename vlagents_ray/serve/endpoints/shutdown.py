"""The end of a replica, before which its WebSockets and incomplete uploads end."""

from __future__ import annotations

import time

STOPPING = "the replica is stopping; connect again"
_QUIET_S = 1.0  # time after which a silent connection ends when its replica stops


class Shutdown:
    """The end of a replica, before which its WebSockets and incomplete uploads end; its methods are
    thread-safe.

    Serve counts a WebSocket as a request. It ends a replica after its last request, and kills it
    after a time limit.
    """

    def __init__(self) -> None:
        self._begun = float("inf")  # time.monotonic(), s
        self._patience_s = 0.0

    def begin(self, patience_s: float = 0.0) -> None:
        """End all connections that are silent for a second, and after `patience_s` all remaining
        connections.
        """
        self._patience_s = patience_s
        self._begun = time.monotonic()

    def is_due(self, silent_s: float) -> bool:
        """Return whether a connection has to end if its client has been silent for `silent_s`."""
        stopping_s = time.monotonic() - self._begun
        return stopping_s >= self._patience_s or (stopping_s >= 0 and silent_s >= _QUIET_S)
