"""Selects the transport for a URL."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, get_args
from urllib.parse import urlsplit

from vlagents_ray.client.credentials import ANONYMOUS, Credentials
from vlagents_ray.client.transports.codec_selection import CodecChoice
from vlagents_ray.client.transports.http import http_url
from vlagents_ray.errors import ConfigError

if TYPE_CHECKING:
    from vlagents_ray.client.transports.base import Transport

TransportName = Literal["auto", "shm", "plasma", "websocket", "http", "handle"]


def select_transport(url: str, transport: str, codec: CodecChoice, credentials: Credentials = ANONYMOUS) -> Transport:
    """Return the transport for a URL; raises `ConfigError` if the two do not go together."""
    scheme = urlsplit(url).scheme
    if transport not in get_args(TransportName):
        raise ConfigError(f"transport: got {transport!r}, want one of {list(get_args(TransportName))}")
    inside = scheme == "serve"
    if transport in (("http", "websocket") if inside else ("handle", "plasma")):
        raise ConfigError(
            f"transport {transport!r} does not reach {url!r}; 'handle' and 'plasma' go together with serve://APP"
        )
    credentials.use_at(url)
    if transport == "handle":
        from vlagents_ray.client.transports.serve_handle import HandleTransport

        return HandleTransport(urlsplit(url).netloc)
    if transport == "plasma":
        from vlagents_ray.client.transports.plasma import PlasmaTransport

        return PlasmaTransport(urlsplit(url).netloc)
    if transport == "http":
        from vlagents_ray.client.transports.http import HttpTransport

        return HttpTransport(url, codec, credentials)
    if transport == "websocket":
        from vlagents_ray.client.transports.websocket import WebSocketTransport

        return WebSocketTransport(url, codec, credentials)
    if not inside:
        http_url(url)  # raises for an invalid URL before anything is tried
    from vlagents_ray.client.transports.auto import AutoTransport

    return AutoTransport(url, codec, credentials, only_shm=transport == "shm")
