"""Time that a message has waited in a socket before it was read: the policy's thread may read it seconds late.

Deadlines begin when a message arrives, and the kernel records that time for each message. Messages that Serve's HTTP
server and Ray's own calls read have no such timestamp; for these, only pauses of the whole process are counted.
"""

from __future__ import annotations

import contextlib
import fcntl
import socket
import struct
import termios
import time
from array import array
from collections.abc import Callable, Sequence

from vlagents_ray.protocol.messages import Reply, Request
from vlagents_ray.serve.periodic import Periodic

_TIMESTAMP = 35  # SO_TIMESTAMPNS of Linux, which Python's socket does not name
_STAMP = struct.Struct("@qq")  # wall clock, s and ns
SPACE = socket.CMSG_SPACE(_STAMP.size)  # bytes of the timestamp in a message's control data

LEAST_S = 1e-3  # a shorter wait cannot be distinguished from the time to read a message
_CHECK_S = 0.1  # interval of the checks for a pause
_PAUSE_S = 0.3  # time without a check above which the process was paused, rather than merely busy
_BACKLOG_S = (0.5, 5.0)  # shortest and longest time to read the backlog of a pause; it is half as long as the pause

Control = Sequence[tuple[int, int, bytes]]


def enable_timestamps(connection: socket.socket) -> None:
    """Let the kernel record when messages arrive, if it supports that for this kind of socket."""
    with contextlib.suppress(OSError):
        connection.setsockopt(socket.SOL_SOCKET, _TIMESTAMP, 1)


def waited_s(control: Control) -> float:
    """Return how long the message with this control data has waited, s; 0 if that is negligible or unknown."""
    for level, kind, data in control:
        if level == socket.SOL_SOCKET and kind == _TIMESTAMP and len(data) == _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack(data)
            waited: float = time.time() - (seconds + nanoseconds * 1e-9)
            return waited if waited > LEAST_S else 0.0
    return 0.0


def has_unread(connection: socket.socket) -> bool:
    """Return whether the socket has received data that was not read yet."""
    waiting = array("i", [0])
    fcntl.ioctl(connection, termios.FIONREAD, waiting)
    return waiting[0] > 0


def count_wait(requests: Sequence[Request | Reply], seconds: float) -> None:
    """Shorten the requests' deadlines by the time that the requests have waited, s."""
    for request in requests:
        if isinstance(request, Request) and request.deadline_ms is not None:
            request.deadline_ms = max(0.0, request.deadline_ms - seconds * 1e3)


class PauseDetector:
    """Detects pauses of the process (frozen or starved): between `start` and `stop` a thread checks the clock."""

    def __init__(self, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._checks = Periodic(_CHECK_S)
        self._checked: float | None = None  # time of the last check
        self._pause_began, self._backlog_until = 0.0, float("-inf")  # start of the latest pause, and end of its backlog

    def start(self) -> None:
        """Start checking for pauses."""
        self._checked = self._clock()
        self._checks.add(self.check)

    def stop(self) -> None:
        """Stop checking for pauses; does nothing if `start` was not called."""
        self._checks.remove(self.check)
        self._checked = None

    def check(self) -> None:
        """Record the pause since the last check, if there was one; a pause within a backlog extends the backlog."""
        now = self._clock()
        if self._checked is not None and (lasted_s := now - self._checked) > _PAUSE_S:
            if self._checked < self._backlog_until:
                self._backlog_until += lasted_s
            else:
                least_s, most_s = _BACKLOG_S
                self._pause_began, self._backlog_until = self._checked, now + max(least_s, min(most_s, lasted_s / 2))
        self._checked = now

    def waited_s(self) -> float:
        """Return how long a request that was just read may have waited, s: 0 unless there was a pause."""
        if self._checked is None:
            return 0.0
        now = self._clock()
        if now - self._checked > _PAUSE_S:  # this pause is not recorded yet
            return now - (self._pause_began if self._checked < self._backlog_until else self._checked)
        return now - self._pause_began if now < self._backlog_until else 0.0
