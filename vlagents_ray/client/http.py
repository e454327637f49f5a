"""`POST /v1/<op>` with binary frames on a kept-alive connection."""

from __future__ import annotations

import http.client
import json
import select
import socket
import ssl
import time
import uuid
from collections.abc import Sequence
from typing import Any
from urllib.parse import SplitResult, urlsplit

from vlagents_ray.client.credentials import KEY_VARIABLE, NOBODY, Credentials, tls_failure
from vlagents_ray.client.link import CodecChoice
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    Forbidden,
    MessageTooLarge,
    PolicyUnavailable,
    Unauthorized,
    UnknownApp,
    VLAgentsError,
)
from vlagents_ray.wire.frames import CONTENT_TYPE, decode_replies, encode_requests, read_error
from vlagents_ray.wire.messages import MACHINE_HEADER, REQUEST_ID_HEADER, SESSION_HEADER, Reply, Request

_UNKNOWN_APP_S = 10.0  # a starting server knows no path until its first replica exists


class HttpTransport:
    """HTTP/1.1; the header that names a session brings all requests of this object to one replica."""

    name = "http"
    holds_sessions = False

    def __init__(self, url: str, codec: CodecChoice, credentials: Credentials = NOBODY, machine: str = "") -> None:
        """With `machine` (see `MACHINE_HEADER`) the metadata is the least loaded replica's there, if there is one."""
        self._machine = machine
        self._credentials = credentials
        self._url = http_url(url)
        self._codec = codec
        self._session = uuid.uuid4().hex
        self._connection: http.client.HTTPConnection | None = None

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """The server's metadata, as soon as it answers; retries while it is not ready."""
        begun = time.monotonic()
        unknown_since: float | None = None
        pause_s = 0.05
        while True:
            left_s = begun + timeout_s - time.monotonic()
            try:
                return self._metadata(max(0.1, left_s))
            except (PolicyUnavailable, DeadlineExceeded) as error:
                if pause_s > left_s:
                    raise PolicyUnavailable(
                        f"{self._url.geturl()}: not ready within {timeout_s:g} s ({error})"
                    ) from error
                unknown_since = None
            except UnknownApp:
                unknown_since = unknown_since or time.monotonic()
                if time.monotonic() - unknown_since > _UNKNOWN_APP_S or pause_s > left_s:
                    raise
            time.sleep(pause_s)
            pause_s = min(1.0, pause_s * 1.5)

    def _metadata(self, timeout_s: float) -> dict[str, Any]:
        # By this object's own hash: the load balancer's turn is left to WebSockets, which spread by it.
        headers = {SESSION_HEADER: self._session} | ({MACHINE_HEADER: self._machine} if self._machine else {})
        status, kind, body = self._exchange("GET", "/v1/metadata", None, headers, timeout_s)
        if status != 200:
            raise refusal(status, kind, body)
        metadata = _json(body)
        if not isinstance(metadata, dict) or "protocol" not in metadata:
            raise ConfigError(f"{self._url.geturl()}: answers, but is no vlagents_ray server ({body[:80]!r})")
        return metadata

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """One POST; what is not a frame of replies is the server's or the proxy's refusal."""
        headers = {
            SESSION_HEADER: self._session,
            REQUEST_ID_HEADER: requests[0].request_id,
            "content-type": CONTENT_TYPE,
            "accept": CONTENT_TYPE,
        }
        codec = self._codec.of(requests[0].obs, lambda probe: self._probe(probe, timeout_s))
        frame = encode_requests(requests, codec)
        status, kind, body = self._exchange("POST", f"/v1/{requests[0].op}", frame, headers, timeout_s)
        if status == 200:
            return decode_replies(body)
        refused = refusal(status, kind, body)
        return [Reply(request.request_id, error=refused) for request in requests]

    def _probe(self, probe: bytes, timeout_s: float) -> None:
        headers = {SESSION_HEADER: self._session, "content-type": "application/octet-stream"}
        status, kind, body = self._exchange("POST", "/v1/probe", probe, headers, timeout_s)
        if status != 200:
            raise refusal(status, kind, body)

    def close(self) -> None:
        """Close the connection; the next one may be to another replica, over another link."""
        self._codec.forget()
        self._hang_up()

    def _hang_up(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def _exchange(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str], timeout_s: float
    ) -> tuple[int, str, bytes]:
        connection = self._open(timeout_s)
        try:
            connection.request(method, self._url.path.rstrip("/") + path, body, headers | self._credentials.headers)
            answer = connection.getresponse()
            return answer.status, answer.headers.get("content-type", ""), answer.read()
        except TimeoutError as error:
            self._hang_up()
            raise DeadlineExceeded(f"{self._url.geturl()}: no answer within {timeout_s:g} s") from error
        except ssl.SSLError as error:  # with TLS 1.3 the server looks at a client's certificate only now
            self._hang_up()
            raise tls_failure(self._url.geturl(), error) from error
        except (OSError, http.client.HTTPException) as error:
            self._hang_up()
            raise ConnectionLost(f"{self._url.geturl()}: {type(error).__name__}: {error}") from error

    def _open(self, timeout_s: float) -> http.client.HTTPConnection:
        if self._connection is not None and _closed_by_peer(self._connection.sock):
            self._hang_up()
        if self._connection is None:
            host, port = self._url.hostname or "", self._url.port
            context = self._credentials.context(self._url.geturl())
            connection = (
                http.client.HTTPConnection(host, port, timeout=timeout_s)
                if context is None
                else http.client.HTTPSConnection(host, port, timeout=timeout_s, context=context)
            )
            try:
                connection.connect()
            except ssl.SSLError as error:
                raise tls_failure(self._url.geturl(), error) from error
            except OSError as error:
                raise PolicyUnavailable(f"{self._url.geturl()}: cannot connect ({error}); is it running?") from error
            connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connection = connection
        self._connection.sock.settimeout(timeout_s)
        return self._connection


def http_url(url: str) -> SplitResult:
    """The http(s) form of a server's URL; `ConfigError` if it is not one."""
    parts = urlsplit(url)
    scheme = {"http": "http", "https": "https", "ws": "http", "wss": "https"}.get(parts.scheme)
    if scheme is None or not parts.hostname:
        raise ConfigError(f"url: got {url!r}, want http(s)://HOST:PORT, ws(s)://HOST:PORT or serve://APP")
    return parts._replace(scheme=scheme)


def _closed_by_peer(sock: socket.socket | None) -> bool:
    """An idle connection has nothing to read, unless the server closed it."""
    if sock is None:
        return True
    poller = select.poll()
    poller.register(sock, select.POLLIN)
    return bool(poller.poll(0))


def refusal(status: int, kind: str, body: bytes) -> VLAgentsError:
    """What the server, or a proxy before it, meant by an answer that is none."""
    if "json" in kind and isinstance(document := _json(body), dict):
        return read_error(document)
    text = body[:200].decode(errors="replace").strip()
    if status == 413:
        return MessageTooLarge(f"a proxy takes no body as large ({text}); raise its limit, or send JPEG")
    if status in (401, 403):  # without a document, where a WebSocket's refusal cannot bring one
        return (Unauthorized if status == 401 else Forbidden)(
            f"the server refuses this API key, or that there is none (HTTP {status}); set api_key or {KEY_VARIABLE}"
        )
    if status == 404:
        return UnknownApp(f"no application at this path ({text}); check the URL")
    if status == 500 or status in (502, 503, 504):  # the proxy's own: no replica is ready
        return PolicyUnavailable(f"no replica answers (HTTP {status}: {text})")
    return VLAgentsError(f"HTTP {status}: {text}")


def _json(body: bytes) -> Any:
    try:
        return json.loads(body)
    except ValueError:
        return None
