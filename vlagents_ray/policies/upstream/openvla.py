"""A client of OpenVLA's REST server, `vla-scripts/deploy.py`, and of its forks."""

from __future__ import annotations

import http.client
import select
import socket
import ssl
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar
from urllib.parse import urlsplit

from vlagents_ray.errors import ConnectionLost, MessageTooLarge
from vlagents_ray.policies.upstream.client import Answer, ClientOptions, UpstreamClient
from vlagents_ray.wire import openvla

_BUSY = (408, 429, 502, 503, 504)


class OpenVLAClient(UpstreamClient):
    """A client that posts one observation per request to `/act`, over a connection that stays open."""

    mapping: ClassVar[str | None] = "openvla"
    schemes: ClassVar[tuple[str, ...]] = ("http", "https")

    def __init__(self, options: ClientOptions) -> None:
        super().__init__(options)
        self._url = urlsplit(options.url)
        self._path = self._url.path.rstrip("/") or "/act"
        self._headers = {"Content-Type": "application/json"}
        if options.key is not None:
            self._headers["Authorization"] = f"Bearer {options.key}"
        self._connection: http.client.HTTPConnection | None = None

    @staticmethod
    def is_nested(key: str) -> bool:  # noqa: ARG004 - overrides
        """Return False: an observation is one flat map."""
        return False

    @property
    def is_open(self) -> bool:
        sock = self._connection.sock if self._connection is not None else None
        if sock is None:
            return False
        if isinstance(sock, ssl.SSLSocket):
            return True  # readable data may be a TLS session ticket
        ended = select.poll()  # uvicorn closes a connection that is idle for 5 s
        ended.register(sock, select.POLLIN)
        return not ended.poll(0)

    def connect(self, timeout_s: float) -> dict[str, Any]:
        secure = self._url.scheme == "https"
        kind = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        connection = kind(self._url.hostname or "", self._url.port, timeout=timeout_s)
        try:
            connection.connect()
        except OSError as error:
            connection.close()
            raise self.unreachable(error) from error
        connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.sock.settimeout(self.options.timeout_s)
        connection.auto_open = 0
        self._connection = connection
        return {}

    def ask(self, observations: Sequence[Mapping[str, Any]]) -> list[Answer]:
        [observation] = observations
        if self._connection is None:
            raise self.closed()
        most = self.options.limits.body_bytes
        try:
            self._connection.request("POST", self._path, openvla.encode(observation), self._headers)
            response = self._connection.getresponse()
            body = response.read(most + 1)
        except (http.client.HTTPException, OSError) as error:
            raise self.lost(error) from error
        if len(body) > most:
            self.close()
            raise MessageTooLarge(f"upstream {self.options.url}: an answer of more than {most} bytes")
        if response.will_close:
            self.close()
        if response.status in _BUSY:
            raise ConnectionLost(f"upstream {self.options.url}: it answered with HTTP {response.status}")
        if response.status != http.HTTPStatus.OK:
            raise self.failed(f"HTTP {response.status}: {body[:2000]!r}")
        if (action := openvla.decode_action(body, self.options.limits)) is None:
            raise self.failed("error")
        return [action]

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
