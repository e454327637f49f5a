"""Pauses of the process, during which messages wait in sockets.

Deadlines begin when a message arrives, and the kernel records that time for each message (see
`vlagents_ray.serve.endpoints.connection`). Serve's HTTP server and Ray's own calls do not expose
that time. After a pause of the whole process, the time is therefore looked up for HTTP requests;
messages of the server's WebSockets and Ray's calls are assumed to have waited since the pause
began.
"""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from collections.abc import Callable, Mapping
from contextvars import ContextVar
from typing import Any

from vlagents_ray.serve.periodic import Periodic

_LAST_DATA = struct.Struct("@52xI")  # field of TCP_INFO: time since data were last received, ms
_CHECK_S = 0.1  # interval of the checks for a pause
_PAUSE_S = 0.3  # time without a check above which the process was paused, rather than merely busy
# Minimum and maximum time to read the backlog of a pause, s. Between these limits, it is half as
# long as the pause.
_BACKLOG_S = (0.5, 5.0)

# Ports of both ends of the current HTTP request's TCP connection, the server's first.
_PORTS: ContextVar[tuple[int, int] | None] = ContextVar("vlagents_ray_ports", default=None)


def note_connection(scope: Mapping[str, Any]) -> None:
    """Record the connection of an HTTP request, for `PauseDetector.waited_s` in the same
    context.
    """
    server, client = scope.get("server"), scope.get("client")
    _PORTS.set((server[1], client[1]) if server and client else None)


def _since_last_data_s() -> float | None:
    """Return the time since the connection of the current HTTP request received data, s; None if it
    is unknown.

    Serve does not expose its sockets, so this searches all sockets of the process, which takes
    milliseconds.
    """
    ports = _PORTS.get()
    if ports is None:
        return None

    with contextlib.suppress(OSError):  # the system does not list descriptors
        for descriptor in map(int, os.listdir("/proc/self/fd")):
            with contextlib.suppress(OSError):  # not a connected socket, or closed
                connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, fileno=descriptor)
                try:
                    names = connection.getsockname(), connection.getpeername()
                    # The address of a Unix socket is not a tuple.
                    connected = tuple(name[1] for name in names if isinstance(name, tuple))
                    if connected == ports:
                        info = connection.getsockopt(
                            socket.IPPROTO_TCP, socket.TCP_INFO, _LAST_DATA.size
                        )
                        milliseconds: int = _LAST_DATA.unpack(info)[0]
                        return milliseconds / 1e3
                finally:
                    connection.detach()
    return None


class PauseDetector:
    """Detects pauses of the process (frozen or starved): between `start` and `stop` a thread
    checks the clock.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._checks = Periodic(_CHECK_S)
        self._checked: float | None = None  # time of the last check
        # Start of the first pause whose messages are still being read, and the end of the time for
        # that backlog.
        self._pause_began, self._backlog_until = 0.0, float("-inf")
        self._latest_began = 0.0  # start of the latest pause

    def start(self) -> None:
        """Start checking for pauses."""
        self._checked = self._clock()
        self._checks.add(self.check)

    def stop(self) -> None:
        """Stop checking for pauses; does nothing if `start` was not called."""
        self._checks.remove(self.check)
        self._checked = None

    def check(self) -> None:
        """Record the pause since the last check, if there was one; a pause during a backlog
        extends the backlog.
        """
        now = self._clock()
        if self._checked is not None and now - self._checked > _PAUSE_S:
            self._record_pause(self._checked, now)
        # This assignment comes last, since `waited_s` regards the pause as unrecorded until then.
        self._checked = now

    def _record_pause(self, began: float, ended: float) -> None:
        lasted_s = ended - began
        self._latest_began = began
        if began < self._backlog_until:
            self._backlog_until += lasted_s
            return

        shortest_s, longest_s = _BACKLOG_S
        self._pause_began = began
        self._backlog_until = ended + max(shortest_s, min(longest_s, lasted_s / 2))

    def latest(self) -> float:
        """Return the start of the latest pause, s, of the clock, which identifies the pause; 0.0 if
        no message can have waited in a pause.
        """
        checked, now = self._checked, self._clock()
        if checked is None:
            return 0.0
        if now - checked > _PAUSE_S:  # this pause is not recorded yet
            return checked
        return self._latest_began if now < self._backlog_until else 0.0

    def waited_s(self) -> float:
        """Return how long a request that was just read may have waited, s; 0 if there
        was no pause.
        """
        if self._checked is None:
            return 0.0
        now = self._clock()
        if now - self._checked > _PAUSE_S:  # this pause is not recorded yet
            began = self._pause_began if self._checked < self._backlog_until else self._checked
        elif now < self._backlog_until:
            began = self._pause_began
        else:
            return 0.0
        waited_s = _since_last_data_s()
        return now - began if waited_s is None else waited_s
