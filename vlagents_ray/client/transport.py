"""The seam between `RemoteAgent` and what carries its requests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from vlagents_ray.wire.messages import Reply, Request


class Transport(Protocol):
    """Carries the requests of one frame at a time to one replica of a server.

    A request names its session; what ends a session is its `close`, or the end of the connection.

    Errors: `PolicyUnavailable` when the server cannot be reached or is not ready, `ConnectionLost`
    when the connection broke after the request was sent, `DeadlineExceeded` when no answer came in
    time. An error that the server answered is in `Reply.error`.
    """

    @property
    def holds_sessions(self) -> bool:
        """Do sessions end with the connection?"""
        ...

    @property
    def name(self) -> str:
        """What users call it: "shm", "plasma", "websocket", "http", "handle"."""
        ...

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Reach the server, once; returns its metadata."""
        ...

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send requests as one frame and wait for their replies, in order. Never sends anything twice."""
        ...

    def close(self) -> None:
        """End the connection; `connect` may begin another, to another replica."""
        ...


def is_answer(replies: Sequence[Reply], requests: Sequence[Request]) -> bool:
    """Are these the replies to these requests, or to others that were given up? An unreadable frame has no id."""
    return replies[0].request_id in ("", requests[0].request_id)
