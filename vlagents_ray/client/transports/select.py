"""Selects the transport for a URL. "auto" is the fastest one that the server allows at the time of
the connection.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any, Literal, get_args
from urllib.parse import urlsplit

from vlagents_ray.client.credentials import Credentials
from vlagents_ray.client.transports.base import CodecChoice, ReplicaWatch, Transport
from vlagents_ray.client.transports.http import HttpTransport, http_url
from vlagents_ray.client.transports.serve_handle import HandleTransport, PlasmaTransport
from vlagents_ray.client.transports.shm import ShmTransport, reaches
from vlagents_ray.client.transports.websocket import WebSocketTransport
from vlagents_ray.errors import ConfigError, MessageTooLarge, NotReset, PolicyUnavailable
from vlagents_ray.protocol.messages import LocalAddress, Reply, Request, boot_id, read_address

TransportName = Literal["auto", "shm", "plasma", "websocket", "http", "handle"]


class AutoTransport:
    """Uses shared memory if the policy runs on this machine for this user, otherwise a WebSocket.

    Inside the cluster, it uses shared memory, otherwise a plasma channel on the replica's node,
    otherwise the Serve handle. Shared memory is the first choice because it is faster, as it needs
    no locks and no framing of Ray. Plasma reaches a replica on this node whose socket is in another
    network namespace. If the object store has no space for a channel, the handle is used instead:
    the handle puts its frames into the store only for a moment, or on disk if the store has no
    space for them.
    """

    def __init__(
        self,
        url: str,
        codec: CodecChoice,
        credentials: Credentials,
        watch: ReplicaWatch | None = None,
        *,
        only_shm: bool,
    ) -> None:
        self._url = url
        self._watch = watch
        self._codec = codec
        self._credentials = credentials
        self._only_shm = only_shm
        self._chosen: (
            ShmTransport | PlasmaTransport | HandleTransport | WebSocketTransport | None
        ) = None
        # Serve handle to the replica of a plasma channel, for frames that are too large for the
        # channel.
        self._handle: HandleTransport | None = None

    @property
    def name(self) -> str:
        """The name of the chosen transport; "auto" before the choice."""
        return "auto" if self._chosen is None else self._chosen.name

    @property
    def holds_sessions(self) -> bool:
        """Whether sessions end with the connection of the chosen transport."""
        return self._chosen is not None and self._chosen.holds_sessions

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Return the server's metadata, once it answers and the chosen transport is connected."""
        deadline = time.monotonic() + timeout_s
        parts = urlsplit(self._url)
        handle: HandleTransport | None = None
        metadata_source: HandleTransport | HttpTransport
        if parts.scheme == "serve":
            handle = HandleTransport(parts.netloc, self._watch, must_be_near=self._only_shm)
            metadata_source, read_metadata = handle, handle.connect
        else:
            http = HttpTransport(self._url, self._codec, self._credentials, boot_id())
            metadata_source, read_metadata = http, http.read_metadata

        try:
            metadata = read_metadata(timeout_s)
            local = read_address(LocalAddress, metadata.get("local"))
        except BaseException:
            metadata_source.close()
            raise

        # A client in the cluster needs a key only for shared memory. Without a key, it uses another
        # transport.
        needs_key = local is not None and local.keyed and not self._credentials.api_key
        if handle is not None and not self._only_shm and needs_key:
            local = None

        left_s = max(1.0, deadline - time.monotonic())
        shm = self._shm(local, left_s)
        if shm is not None or handle is None:
            metadata_source.close()

        if shm is not None:
            self._chosen = shm
        elif handle is not None:
            channel = PlasmaTransport(parts.netloc, self._watch)
            try:
                channel.connect_to(handle, metadata, left_s)
                self._chosen, self._handle = channel, handle
            except (ConfigError, PolicyUnavailable):  # the replica is on another node
                self._chosen, self._handle = handle, None
        else:
            stream = WebSocketTransport(self._url, self._codec, self._credentials, self._watch)
            stream.connect_to(metadata, left_s)
            self._chosen = stream
        return metadata

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send requests as one frame with the chosen transport, and return their replies."""
        if self._chosen is None:
            raise NotReset("not connected; reset first")
        try:
            return self._chosen.call(requests, timeout_s)
        except MessageTooLarge:  # too large for the channel; nothing was sent
            if self._handle is None:
                raise

        self._chosen.close()
        self._chosen, self._handle = self._handle, None
        return self._chosen.call(requests, timeout_s)

    def close(self) -> None:
        """End the connection. The next connection selects a transport again, since the server may
        have moved.
        """
        if self._chosen is not None:
            self._chosen.close()
            self._chosen = self._handle = None

    def _shm(self, local: LocalAddress | None, timeout_s: float) -> ShmTransport | None:
        if local is None or not reaches(local):
            if self._only_shm:
                raise ConfigError(
                    f"{self._url}: expected the policy on this machine for transport 'shm', got a "
                    f"policy on another machine; use transport 'auto'"
                )
            return None
        transport = ShmTransport(local, self._credentials, self._watch)
        try:
            transport.connect(timeout_s)
        except PolicyUnavailable:
            # The server belongs to another user, or is in a container with its own network.
            if self._only_shm:
                raise
            return None
        return transport


def select_transport(
    url: str,
    transport: str,
    codec: CodecChoice,
    credentials: Credentials,
    watch: ReplicaWatch | None = None,
) -> Transport:
    """Return the transport for a URL. The `watch` detects whether the replica is frozen, if the
    transport can send pings.

    Raises:
        ConfigError: The URL does not support the transport.
    """
    is_in_cluster = url.startswith("serve://")
    if transport not in get_args(TransportName):
        raise ConfigError(
            f"transport: expected one of {list(get_args(TransportName))}, got {transport!r}"
        )
    unsupported = ("http", "websocket") if is_in_cluster else ("handle", "plasma")
    if transport in unsupported:
        raise ConfigError(
            f"transport {transport!r} does not reach {url!r}; 'handle' and 'plasma' are for "
            f"serve://APP, 'http' and 'websocket' for http://HOST:PORT"
        )

    if not is_in_cluster:
        http_url(url)  # raises for an invalid URL before any attempt to connect
    credentials.use_at(url)
    if transport in ("handle", "plasma"):
        app = urlsplit(url).netloc
        kind = HandleTransport if transport == "handle" else PlasmaTransport
        return kind(app, watch)
    if transport in ("http", "websocket"):
        if transport == "http":
            return HttpTransport(url, codec, credentials, watch=watch)
        return WebSocketTransport(url, codec, credentials, watch)
    return AutoTransport(url, codec, credentials, watch, only_shm=transport == "shm")
