"""The seam between `RemoteAgent` and what carries its requests."""

from __future__ import annotations

from typing import Any, Protocol

from vlagents_ray.wire.messages import Reply, Request


class Transport(Protocol):
    """Carries one request at a time to one session on a server.

    Errors: `PolicyUnavailable` when the server cannot be reached or is not ready, `ConnectionLost`
    when the connection broke after the request was sent, `DeadlineExceeded` when no answer came in
    time. An error that the server answered is in `Reply.error`.
    """

    @property
    def name(self) -> str:
        """What users call it: "shm", "plasma", "websocket", "http", "handle"."""
        ...

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Reach the server, once; returns its metadata."""
        ...

    def call(self, request: Request, timeout_s: float) -> Reply:
        """Send a request and wait for its reply. Never sends a request twice."""
        ...

    def close(self) -> None:
        """End the session and the connection."""
        ...
