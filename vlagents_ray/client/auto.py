"""The fastest way to a server that its URL allows, found out when connecting."""

from __future__ import annotations

import time
from typing import Any

from vlagents_ray.client.http import HttpTransport
from vlagents_ray.client.shm import ShmTransport, reaches
from vlagents_ray.client.transport import Transport
from vlagents_ray.client.websocket import WebSocketTransport
from vlagents_ray.errors import ConfigError, NotReset, PolicyUnavailable
from vlagents_ray.wire.frames import ImageCodec
from vlagents_ray.wire.messages import Reply, Request


class AutoTransport:
    """Shared memory if the server runs on this machine for this user, a WebSocket otherwise."""

    def __init__(self, url: str, codec: ImageCodec, *, only_shm: bool = False) -> None:
        self._url = url
        self._codec = codec
        self._only_shm = only_shm
        self._chosen: Transport | None = None

    @property
    def name(self) -> str:
        """What was chosen; "auto" before."""
        return "auto" if self._chosen is None else self._chosen.name

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """The server's metadata, once it answers and the chosen transport is connected."""
        deadline = time.monotonic() + timeout_s
        door = HttpTransport(self._url, self._codec)
        try:
            metadata = door.connect(timeout_s)
        finally:
            door.close()
        left_s = max(1.0, deadline - time.monotonic())
        local = metadata.get("local")
        if local and reaches(local):
            transport = ShmTransport(local)
            try:
                transport.connect(left_s)
            except PolicyUnavailable:  # another user, or a container with a network of its own
                if self._only_shm:
                    raise
            else:
                self._chosen = transport
                return metadata
        elif self._only_shm:
            raise ConfigError(
                f"{self._url}: transport 'shm' needs a server on this machine; its metadata names another"
            )
        self._chosen = WebSocketTransport(self._url, self._codec)
        self._chosen.connect(left_s)
        return metadata

    def call(self, request: Request, timeout_s: float) -> Reply:
        """By the chosen transport."""
        if self._chosen is None:
            raise NotReset("not connected; reset first")
        return self._chosen.call(request, timeout_s)

    def close(self) -> None:
        """End the session; the next connection chooses anew, since the server may have moved."""
        if self._chosen is not None:
            self._chosen.close()
            self._chosen = None
