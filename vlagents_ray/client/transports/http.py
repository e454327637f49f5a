"""The HTTP transport: `POST /v1/<op>` with binary frames on a persistent connection."""

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

from vlagents_ray.client.credentials import (
    ANONYMOUS,
    KEY_VARIABLE,
    Credentials,
    require_plain,
    tls_failure,
)
from vlagents_ray.client.http_deadline import DeadlineSocket
from vlagents_ray.client.transports.base import (
    CodecChoice,
    ConnectReport,
    connection_lost,
    first_timeout_s,
    no_answer,
)
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    Forbidden,
    MessageTooLarge,
    NoReplica,
    PolicyUnavailable,
    Unauthorized,
    UnknownApp,
    VLAgentsError,
)
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_replies, encode_requests, read_error
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    MACHINE_HEADER,
    REQUEST_ID_HEADER,
    SESSION_HEADER,
    Reply,
    Request,
)

_UNKNOWN_APP_S = 10.0  # a starting server has no path until its first replica exists


class HttpTransport:
    """The HTTP/1.1 transport. A header names the session, and routes all requests of this object to
    one replica.
    """

    name = "http"
    holds_sessions = False

    def __init__(
        self, url: str, codec: CodecChoice, credentials: Credentials = ANONYMOUS, machine: str = ""
    ) -> None:
        """Set the server. With `machine` (see `MACHINE_HEADER`), the least loaded replica on that
        machine is preferred.
        """
        self._machine, self._credentials = machine, credentials
        self._url = http_url(url)
        self._codec = codec
        self._session = uuid.uuid4().hex
        self._connection: tuple[http.client.HTTPConnection, DeadlineSocket] | None = None

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Return the server's metadata once it answers. This retries while it is not ready."""
        url = self._url.geturl()
        deadline = time.monotonic() + timeout_s
        report = ConnectReport(url, timeout_s)
        unknown_since: float | None = None  # time.monotonic() of the first answer without the app
        pause_s, attempt_s = 0.05, first_timeout_s(timeout_s)

        while True:
            left_s = deadline - time.monotonic()
            try:
                return self._metadata(max(0.1, min(left_s, attempt_s)))
            except (PolicyUnavailable, DeadlineExceeded) as error:
                # If the replica hangs, another session id selects another one.
                if isinstance(error, DeadlineExceeded):
                    self._session, attempt_s = uuid.uuid4().hex, 2 * attempt_s
                if isinstance(error, ConnectionLost):
                    require_plain(self._url, attempt_s)
                if pause_s > left_s:
                    raise PolicyUnavailable(
                        f"{url}: not ready within {round(timeout_s, 1):g} s ({error})"
                    ) from error
                unknown_since = None
                report.failed(error)
            except UnknownApp as error:
                unknown_since = unknown_since or time.monotonic()
                if time.monotonic() - unknown_since > _UNKNOWN_APP_S or pause_s > left_s:
                    raise
                report.failed(error)

            time.sleep(pause_s)
            pause_s = min(0.3, pause_s * 1.5)

    def _metadata(self, timeout_s: float) -> dict[str, Any]:
        # The session id selects the replica by its hash, since WebSockets rely on the load
        # balancer's round robin for their distribution.
        headers = {SESSION_HEADER: self._session}
        if self._machine:
            headers[MACHINE_HEADER] = self._machine

        metadata = self.get("/v1/metadata", timeout_s, headers)
        if "protocol" not in metadata:
            raise ConfigError(
                f"{self._url.geturl()}: expected a vlagents_ray server, got another one "
                f"({str(metadata)[:80]}); check the URL"
            )
        return metadata

    def get(
        self,
        path: str,
        timeout_s: float,
        headers: dict[str, str] | None = None,
        *,
        method: str = "GET",
    ) -> dict[str, Any]:
        """Return the JSON document with which the server answers a request without a body."""
        status, kind, body = self._exchange(method, path, None, headers or {}, timeout_s)
        if status != 200:
            raise refusal(status, kind, body)
        document = _json(body)
        if not isinstance(document, dict):
            raise ConfigError(
                f"{self._url.geturl()}: expected a vlagents_ray server, got another one "
                f"({body[:80]!r}); check the URL"
            )
        return document

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send one POST request. A response that is not a frame of replies becomes an error of the
        server or of the proxy.
        """
        headers = {
            SESSION_HEADER: self._session,
            REQUEST_ID_HEADER: requests[0].request_id,
            "content-type": CONTENT_TYPE,
            "accept": CONTENT_TYPE,
        }
        frame = encode_requests(requests, self._codec.codec_for(requests[0].obs))
        path = f"/v1/{requests[0].op}"

        status, kind, body = self._exchange("POST", path, frame, headers, timeout_s)
        if status == 200:
            return decode_replies(body)
        error = refusal(status, kind, body)
        return [Reply(request.request_id, error=error) for request in requests]

    def close(self) -> None:
        """Close the connection; the next one may reach another replica."""
        if self._connection is not None:
            connection, _ = self._connection
            connection.close()
            self._connection = None

    def _exchange(
        self, method: str, path: str, body: bytes | None, headers: dict[str, str], timeout_s: float
    ) -> tuple[int, str, bytes]:
        """Send a request; return the status, content type and body of the answer."""
        begun = time.monotonic()
        connection, deadline_socket = self._open(timeout_s)
        deadline_socket.begin_exchange(timeout_s - (time.monotonic() - begun))
        try:
            connection.request(
                method, self._url.path.rstrip("/") + path, body, headers | self._credentials.headers
            )
            answer = connection.getresponse()

            content = answer.read(DEFAULT_LIMITS.body_bytes + 1)
            if len(content) > DEFAULT_LIMITS.body_bytes:
                self.close()
                raise MessageTooLarge(
                    f"{self._url.geturl()}: expected the answer of a policy server, got more than "
                    f"{DEFAULT_LIMITS.body_bytes} bytes; check the URL"
                )
            return answer.status, answer.headers.get("content-type", ""), content
        except TimeoutError as error:
            self.close()
            raise no_answer(self._url.geturl(), timeout_s) from error
        except ssl.SSLError as error:
            # With TLS 1.3, the server checks the client's certificate only now.
            self.close()
            raise tls_failure(self._url.geturl(), error) from error
        except (OSError, http.client.HTTPException) as error:
            self.close()
            reason = f"{type(error).__name__}: {error}"
            raise connection_lost(self._url.geturl(), reason) from error

    def _open(self, timeout_s: float) -> tuple[http.client.HTTPConnection, DeadlineSocket]:
        if self._connection is not None and _closed_by_peer(self._connection[0].sock):
            self.close()

        if self._connection is None:
            host, port = self._url.hostname or "", self._url.port
            context = self._credentials.context(self._url.geturl())
            if context is None:
                connection = http.client.HTTPConnection(host, port, timeout=timeout_s)
            else:
                connection = http.client.HTTPSConnection(
                    host, port, timeout=timeout_s, context=context
                )
            try:
                connection.connect()
            except ssl.SSLError as error:
                raise tls_failure(self._url.geturl(), error) from error
            except OSError as error:
                raise no_replica(self._url.geturl(), error) from error
            connection.sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._connection = connection, DeadlineSocket.install(connection)
        return self._connection


def no_replica(url: str, error: Exception) -> NoReplica:
    """Return the error for a client that cannot connect."""
    if isinstance(error, socket.gaierror):
        return NoReplica(
            f"{url}: there is no host of this name ({error}); correct the name, or write its IP "
            "address"
        )
    return NoReplica(f"{url}: cannot connect ({error}); is it running?")


def http_url(url: str) -> SplitResult:
    """Return the http(s) form of a server's URL.

    Raises:
        ConfigError: It is not the URL of a server.
    """
    parts = urlsplit(url)
    scheme = {"http": "http", "https": "https", "ws": "http", "wss": "https"}.get(parts.scheme)
    if scheme is None or not parts.hostname:
        raise ConfigError(
            f"url: expected http(s)://HOST:PORT, ws(s)://HOST:PORT or serve://APP, got {url!r}"
        )
    return parts._replace(scheme=scheme)


def _closed_by_peer(sock: socket.socket | None) -> bool:
    """Return whether the server has closed an idle connection, which is then readable."""
    if sock is None:
        return True
    poller = select.poll()
    poller.register(sock, select.POLLIN)
    return bool(poller.poll(0))


def refusal(status: int, kind: str, body: bytes) -> VLAgentsError:
    """Return the error for an HTTP response of the server, or of a proxy in front of it, that is
    not a frame.
    """
    document = _json(body) if "json" in kind else None
    if isinstance(document, dict):
        return read_error(document)

    text = body[:200].decode(errors="replace").strip()
    if status == 413:
        return MessageTooLarge(
            f"a proxy rejects bodies of this size ({text}); raise its limit, or send JPEG"
        )
    if status in (401, 403):  # without a JSON document, as for a rejected WebSocket
        return (Unauthorized if status == 401 else Forbidden)(
            f"the server rejects this API key, or requires one (HTTP {status}); set api_key or "
            f"{KEY_VARIABLE}"
        )
    if status == 404:
        return UnknownApp(f"no application at this path ({text}); check the URL")
    if status in (500, 502, 503, 504):  # from the proxy: no replica is ready
        return NoReplica(f"no replica answers (HTTP {status}: {text})")
    return VLAgentsError(f"HTTP {status}: {text}")


def _json(body: bytes) -> Any:
    try:
        return json.loads(body)
    except (ValueError, RecursionError):  # not JSON, or JSON of a hostile server
        return None
