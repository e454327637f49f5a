"""The fastest way to a server that its URL allows, found out when connecting."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

from vlagents_ray.client.credentials import NOBODY, Credentials
from vlagents_ray.client.handle import HandleTransport
from vlagents_ray.client.http import HttpTransport
from vlagents_ray.client.link import CodecChoice
from vlagents_ray.client.plasma import PlasmaTransport
from vlagents_ray.client.shm import ShmTransport, reaches
from vlagents_ray.client.transport import Transport
from vlagents_ray.client.websocket import WebSocketTransport
from vlagents_ray.errors import ConfigError, MessageTooLarge, NotReset, PolicyUnavailable
from vlagents_ray.wire.messages import Reply, Request, boot_id


class AutoTransport:
    """Shared memory if the policy runs on this machine for this user; else a WebSocket.

    Inside the cluster: shared memory, else a plasma channel on the replica's node, else the Serve handle.
    Shared memory comes first because it is faster, without Ray's locks and framing; plasma
    reaches a replica on this node whose socket is in another network namespace. Where the object store has no
    room for a channel, the handle takes over: its frames lie there for a moment, or for want of room on the disk.
    """

    def __init__(
        self, url: str, codec: CodecChoice, credentials: Credentials = NOBODY, *, only_shm: bool = False
    ) -> None:
        self._credentials = credentials
        self._url = url
        self._codec = codec
        self._only_shm = only_shm
        self._chosen: Transport | None = None
        self._handle: HandleTransport | None = None  # beside a channel to the same replica

    @property
    def name(self) -> str:
        """What was chosen; "auto" before."""
        return "auto" if self._chosen is None else self._chosen.name

    @property
    def holds_sessions(self) -> bool:
        """As what was chosen."""
        return self._chosen is not None and self._chosen.holds_sessions

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """The server's metadata, once it answers and the chosen transport is connected."""
        deadline = time.monotonic() + timeout_s
        parts = urlsplit(self._url)
        inside = HandleTransport(parts.netloc, must_be_near=self._only_shm) if parts.scheme == "serve" else None
        door = inside or HttpTransport(self._url, self._codec, self._credentials, boot_id())
        try:
            metadata = door.connect(timeout_s)
        except BaseException:
            door.close()
            raise
        left_s = max(1.0, deadline - time.monotonic())
        local = metadata.get("local")
        if inside is not None and not self._only_shm and local and local["keyed"] and not self._credentials.api_key:
            local = None  # who is in the cluster needs no key, but at that door
        near = self._near(local, left_s)
        if near is not None or inside is None:
            door.close()
        if near is not None:
            self._chosen = near
        elif inside is not None:
            channel = self._channel(inside, metadata, left_s)
            self._chosen, self._handle = channel or inside, None if channel is None else inside
        else:
            self._chosen = WebSocketTransport(self._url, self._codec, self._credentials)
            self._chosen.connect(left_s)
        return metadata

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """By the chosen transport."""
        if self._chosen is None:
            raise NotReset("not connected; reset first")
        try:
            return self._chosen.call(requests, timeout_s)
        except MessageTooLarge:  # for the channel; nothing was sent
            if self._handle is None:
                raise
        self._chosen.close()
        self._chosen, self._handle = self._handle, None
        return self._chosen.call(requests, timeout_s)

    def close(self) -> None:
        """End the connection; the next one chooses anew, since the server may have moved."""
        if self._chosen is not None:
            self._chosen.close()
            self._chosen = self._handle = None

    def _channel(self, inside: HandleTransport, metadata: dict[str, Any], timeout_s: float) -> PlasmaTransport | None:
        transport = PlasmaTransport(urlsplit(self._url).netloc)
        try:
            transport.connect_to(inside, metadata, timeout_s)
        except (ConfigError, PolicyUnavailable):  # on another node
            return None
        return transport

    def _near(self, local: dict[str, Any] | None, timeout_s: float) -> ShmTransport | None:
        if not local or not reaches(local):
            if self._only_shm:
                raise ConfigError(f"{self._url}: transport 'shm' needs the policy on this machine; it is on another")
            return None
        transport = ShmTransport(local, self._credentials)
        try:
            transport.connect(timeout_s)
        except PolicyUnavailable:  # another user's, or in a container with a network of its own
            if self._only_shm:
                raise
            return None
        return transport
