"""The HTTP transport: POST requests with binary frames on a persistent connection.

The server chooses a replica for this client. The requests go to this replica's own port, whose
number is in the metadata. If that port cannot be reached (because of a firewall, a tunnel of one
port, or TLS, which ends at the proxy), the client uses `POST /v1/<op>` on the server's port, which
is slower, with a header that routes the requests to the same replica. Later, the client pings the
replica's own port, and uses this port again after an answer.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import socket
import ssl
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any
from urllib.parse import SplitResult, urlsplit

from vlagents_ray.client.credentials import (
    ANONYMOUS,
    KEY_VARIABLE,
    Credentials,
    require_plain,
    tls_failure,
)
from vlagents_ray.client.http_connection import ServerConnection
from vlagents_ray.client.transports.base import (
    AVOIDED_S,
    DIRECT_S,
    PROBE_S,
    CodecChoice,
    ConnectReport,
    ReplicaSilent,
    ReplicaWatch,
    connection_lost,
    first_timeout_s,
    left_s,
    no_answer,
)
from vlagents_ray.errors import (
    ConfigError,
    ConnectionLost,
    DeadlineExceeded,
    Forbidden,
    MalformedMessage,
    MessageTooLarge,
    NoReplica,
    PolicyUnavailable,
    TooManyRequests,
    Unauthorized,
    UnknownApp,
    VLAgentsError,
)
from vlagents_ray.protocol.frame_layout import Buffer
from vlagents_ray.protocol.frames import CONTENT_TYPE, decode_replies, read_error, request_parts
from vlagents_ray.protocol.json_messages import PROBLEM_TYPE
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    MACHINE_HEADER,
    REQUEST_ID_HEADER,
    SERVERS_MACHINE,
    SESSION_HEADER,
    Reply,
    Request,
    StreamAddress,
    read_address,
)

_MOST_JSON = 4 * 2**20  # size of a document, bytes; metadata with statistics have 0.1 MB
_UNKNOWN_APP_S = 10.0  # a starting server has no route until its first replica exists
# Maximum number of header values to try until the proxy's hash selects the chosen replica; it is
# small, as each value costs a request. The second number is the time limit of each request, s,
# since it may reach a frozen replica.
_MOST_HEADERS, _HEADER_S = 4, 0.5


class HttpTransport:
    """The HTTP/1.1 transport. A header contains the session id, and routes all requests of this
    object to one replica.
    """

    name = "http"
    holds_sessions = False

    def __init__(
        self,
        url: str,
        codec: CodecChoice,
        credentials: Credentials = ANONYMOUS,
        machine: str = SERVERS_MACHINE,
        watch: ReplicaWatch | None = None,
    ) -> None:
        """Set the server.

        Args:
            machine: The least loaded replica on this machine is preferred; see `MACHINE_HEADER`.
            watch: Detects whether the replica is frozen, at its own port and behind the proxy.
        """
        self._watch = watch
        self._machine, self._credentials = machine, credentials
        self._url = http_url(url)
        self._codec = codec
        self._session = uuid.uuid4().hex
        self._link = _Link(self._url, credentials, watch)
        # The own port of the replica behind the proxy that answered the last request; None before
        # the first answer.
        self._answered_by: StreamAddress | None = None
        self._direct: _Link | None = None  # connection to the own port of the replica that answered
        self._direct_address: StreamAddress | None = None
        self._own_ports = _OwnPorts()
        self._has_answered = False  # whether an own port has answered

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Connect to the replica that the server chooses, and return its metadata. This retries
        while the server is not ready.
        """
        deadline = time.monotonic() + timeout_s
        metadata = self.read_metadata(timeout_s)
        if not self._open_direct(left_s(deadline)):
            replica = read_address(StreamAddress, metadata.get("stream"))
            if replica is not None:
                self._choose_session(replica, deadline)
        return metadata

    def read_metadata(self, timeout_s: float) -> dict[str, Any]:
        """Return the metadata of the replica that the server chooses, without connecting to the
        replica. This retries while the server is not ready.
        """
        url = self._url.geturl()
        deadline = time.monotonic() + timeout_s
        report = ConnectReport(url, timeout_s)
        # Time of the first answer that the app does not exist, time.monotonic().
        unknown_since: float | None = None
        pause_s, attempt_s = 0.05, first_timeout_s(timeout_s)

        while True:
            remaining_s = deadline - time.monotonic()
            try:
                return self._metadata(max(0.1, min(remaining_s, attempt_s)))
            except (PolicyUnavailable, DeadlineExceeded) as error:
                # If the replica hangs, another session id selects another replica.
                if isinstance(error, DeadlineExceeded):
                    self._session, attempt_s = uuid.uuid4().hex, 2 * attempt_s
                if isinstance(error, ConnectionLost):
                    require_plain(self._url, attempt_s)
                if pause_s > remaining_s:
                    raise PolicyUnavailable(
                        f"{url}: not ready within {round(timeout_s, 1):g} s ({error})"
                    ) from error
                unknown_since = None
                report.failed(error)
            except UnknownApp as error:
                unknown_since = unknown_since or time.monotonic()
                if time.monotonic() - unknown_since > _UNKNOWN_APP_S or pause_s > remaining_s:
                    raise
                report.failed(error)

            time.sleep(pause_s)
            pause_s = min(0.3, pause_s * 1.5)

    def _metadata(self, timeout_s: float) -> dict[str, Any]:
        # The proxy's hash of the session id selects a replica, which then chooses the replica for
        # this client.
        headers = {SESSION_HEADER: self._session, MACHINE_HEADER: self._machine}
        self._answered_by = None
        metadata = self.get("/v1/metadata", timeout_s, headers)
        if "protocol" not in metadata:
            raise ConfigError(
                f"{self._url.geturl()}: expected a vlagents_ray server, got another server "
                f"({str(metadata)[:80]}); check the URL"
            )
        self._set_direct(read_address(StreamAddress, metadata.get("stream")))
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
        status, kind, body = self._link.exchange(method, path, (), headers or {}, timeout_s)
        if status != 200:
            raise refusal(status, kind, body)
        document = _json(body)
        if not isinstance(document, dict):
            raise ConfigError(
                f"{self._url.geturl()}: expected a vlagents_ray server, got another server "
                f"({body[:80]!r}); check the URL"
            )
        return document

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send one POST request. A response that is not a frame of replies is converted to an error
        of the server or the proxy.
        """
        headers = {
            SESSION_HEADER: self._session,
            REQUEST_ID_HEADER: requests[0].request_id,
            "content-type": CONTENT_TYPE,
            "accept": CONTENT_TYPE,
        }
        frame = request_parts(requests, self._codec.codec_for(requests[0].obs))
        deadline = time.monotonic() + timeout_s
        op = requests[0].op
        answer = self._call_direct(op, frame, headers, deadline)
        if answer is None:
            if self._watch is not None:
                self._watch.is_proxied = True
            probe = _ProxiedProbe(self._url, self._credentials, self._session, self._answered_by)
            # After a silence, the proxy may route this call to a replica that searches for the
            # session on the silent replica. So the watch treats this call as if the silent replica
            # had received it.
            probe.accepts_first = self._watch is None or not self._watch.is_silent
            path = f"/v1/{op}"
            answer = self._link.exchange("POST", path, frame, headers, left_s(deadline), probe)
            self._answered_by = _address_of_link(self._link.alternate, op)
            if self._answered_by is not None:
                # The replica of the earlier calls has ended, or its own port can be used again.
                self._set_direct(self._answered_by)
        status, kind, body = answer
        if status == 200:
            return decode_replies(body)
        error = refusal(status, kind, body)
        return [Reply(request.request_id, error=error) for request in requests]

    def _set_direct(self, address: StreamAddress | None) -> None:
        """Beginning with the next call, use the own port of the replica that answered last."""
        if self._direct is not None:
            self._direct.close()
            self._direct = self._direct_address = None
        # The port is not encrypted.
        if address is None or self._url.scheme != "http":
            return
        if self._own_ports.may_use(address, lambda: self._own_link(address).is_alive()):
            self._direct, self._direct_address = self._own_link(address), address

    def _own_link(self, address: StreamAddress) -> _Link:
        """Return a connection to a replica's own port, without opening it."""
        host = self._url.hostname or ""
        name = f"[{host}]" if ":" in host else host
        url = self._url._replace(netloc=f"{name}:{address.port}", path=address.path)
        return _Link(url, self._credentials, self._watch)

    def _open_direct(self, timeout_s: float) -> bool:
        """Connect to the replica's own port; return False if it cannot be reached."""
        if self._direct is None:
            return False
        try:
            self._direct.open(min(timeout_s, DIRECT_S))
        except NoReplica as error:
            if isinstance(error.__cause__, TimeoutError):  # a firewall drops the packets
                self._own_ports.avoid_all()
            self._leave_direct()
            return False
        return True

    def _choose_session(self, replica: StreamAddress, deadline: float) -> None:
        """Choose a session id whose hash makes the proxy route the calls to the replica with this
        own port. If a few attempts find no such id, the calls go to another replica.
        """
        session, answered_by = self._session, self._answered_by
        for _ in range(_MOST_HEADERS):
            limit_s = min(_HEADER_S, deadline - time.monotonic())
            if limit_s <= 0:
                break
            try:
                metadata = self.get("/v1/metadata", limit_s, {SESSION_HEADER: self._session})
                address = read_address(StreamAddress, metadata.get("stream"))
                if address is not None:
                    session, answered_by = self._session, address
            # The session itself needs the rest of the request rate of the API key.
            except TooManyRequests:
                break
            except VLAgentsError:  # another replica may answer the next attempt
                pass
            if answered_by == replica:
                break
            self._session = uuid.uuid4().hex
        self._session, self._answered_by = session, answered_by

    def _call_direct(
        self, op: str, frame: Sequence[Buffer], headers: dict[str, str], deadline: float
    ) -> tuple[int, str, bytes] | None:
        """Send a request to the replica's own port; return None if it was not executed there, so
        that it may be sent to the server's port.
        """
        link = self._direct
        if link is None or not self._open_direct(left_s(deadline)):
            return None

        try:
            path = f"/{op}"
            if self._watch is not None:
                self._watch.is_proxied = False
            answer = link.exchange("POST", path, frame, headers, left_s(deadline), link.is_alive)
        except ConnectionLost:
            # A server of another protocol may have this port now.
            if not self._has_answered:
                self._own_ports.avoid_all()
            raise
        if _is_executed(answer):
            self._has_answered = True
            return answer
        self._leave_direct()
        return None

    def _leave_direct(self) -> None:
        """Use the server's port instead of an own port that failed to execute a request."""
        if self._direct_address is not None:
            self._own_ports.avoid(self._direct_address)
        self._set_direct(None)

    def close(self) -> None:
        """Close the connections; a later connection may reach another replica."""
        self._link.close()
        if self._direct is not None:
            self._direct.close()


class _OwnPorts:
    """Decides which of the replicas' own ports the client uses.

    The client avoids a port that it could not use for `AVOIDED_S`, and then until the port answers
    a ping. The ping has its own thread and connection, so that no request waits for it or is lost.
    """

    def __init__(self) -> None:
        # The earliest time of the next ping, time.monotonic(), by port; the key None stands for all
        # ports.
        self._ping_at: dict[StreamAddress | None, float] = {}
        self._lock = threading.Lock()

    def avoid(self, address: StreamAddress) -> None:
        """Avoid a port that failed to execute a request."""
        with self._lock:
            self._ping_at[address] = time.monotonic() + AVOIDED_S

    def avoid_all(self) -> None:
        """Avoid all ports, as this client cannot reach them."""
        with self._lock:
            self._ping_at[None] = time.monotonic() + AVOIDED_S

    def may_use(self, address: StreamAddress, is_alive: Callable[[], bool]) -> bool:
        """Return whether a port may be used. If a ping of the port is due, begin the ping.

        Args:
            is_alive: Pings the port, and returns whether there was an answer.
        """
        with self._lock:
            avoided = [key for key in (None, address) if key in self._ping_at]
            if not avoided:
                return True
            if time.monotonic() < max(self._ping_at[key] for key in avoided):
                return False
            for key in avoided:
                self._ping_at[key] = float("inf")  # no further ping until this ping has ended
        ping = partial(self._ping, avoided, is_alive)
        threading.Thread(target=ping, name="ping", daemon=True).start()
        return False

    def _ping(self, keys: Sequence[StreamAddress | None], is_alive: Callable[[], bool]) -> None:
        is_answered = False
        try:
            is_answered = is_alive()
        finally:
            with self._lock:
                for key in keys:
                    self._ping_at[key] = time.monotonic() + AVOIDED_S
                    if is_answered:
                        del self._ping_at[key]


class _Link:
    """A persistent connection to one address."""

    def __init__(
        self, url: SplitResult, credentials: Credentials, watch: ReplicaWatch | None = None
    ) -> None:
        self.url = url
        self._watch = watch or ReplicaWatch()
        self._credentials = credentials
        self._connection: ServerConnection | None = None
        self._path = url.path.rstrip("/")
        self.alternate = ""  # the header `Link` of the last answer

    def exchange(
        self,
        method: str,
        path: str,
        body: Sequence[Buffer],
        headers: dict[str, str],
        timeout_s: float,
        probe: Callable[[], bool] | None = None,
    ) -> tuple[int, str, bytes]:
        """Send a request; return the status, content type and body of the answer.

        Args:
            body: Consecutive pieces of the body; empty if the request has no body.
            probe: Pings the replica, and returns whether it is alive. It is called on other
                threads, as one connection carries one request at a time. If it is None, the replica
                is not watched.

        Raises:
            NoReplica: Nothing was sent, as the address cannot be reached.
            ConnectionLost: The connection broke, or the client left the replica.
            DeadlineExceeded: There was no answer in time.
        """
        deadline = time.monotonic() + timeout_s
        connection = self.open(timeout_s)
        try:
            connection.send(
                method,
                self._path + path,
                headers | self._credentials.headers,
                body,
                deadline - time.monotonic(),
            )
            self._await_answer(connection, deadline, probe)
            answer = connection.receive(method)

            content = answer.read(DEFAULT_LIMITS.body_bytes + 1)
            if len(content) > DEFAULT_LIMITS.body_bytes:
                self.close()
                raise MessageTooLarge(
                    f"{self.url.geturl()}: expected the answer of a policy server, got more than "
                    f"{DEFAULT_LIMITS.body_bytes} bytes; check the URL"
                )
            if answer.will_close:
                self.close()
            self.alternate = answer.headers.get("link", "")
            return answer.status, answer.headers.get("content-type", ""), content
        except ReplicaSilent:
            self.close()
            raise
        except TimeoutError as error:
            self.close()
            raise no_answer(self.url.geturl(), timeout_s) from error
        except ssl.SSLError as error:
            # With TLS 1.3, the server checks the client's certificate only after the handshake, so
            # the error occurs here.
            self.close()
            raise tls_failure(self.url.geturl(), error) from error
        except (OSError, http.client.HTTPException) as error:
            self.close()
            reason = f"{type(error).__name__}: {error}"
            raise connection_lost(self.url.geturl(), reason) from error

    def open(self, timeout_s: float) -> ServerConnection:
        """Return the connection, and connect if it is closed.

        Raises:
            NoReplica: The address cannot be reached.
        """
        if self._connection is not None and not self._connection.is_open:
            self.close()

        if self._connection is None:
            context = self._credentials.context(self.url.geturl())
            try:
                self._connection = ServerConnection(self.url, context, timeout_s)
            except ssl.SSLError as error:
                raise tls_failure(self.url.geturl(), error) from error
            except OSError as error:
                raise no_replica(self.url.geturl(), error) from error
        return self._connection

    def close(self) -> None:
        """Close the connection."""
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def is_alive(self) -> bool:
        """Send a request over another connection. Any answer shows that the process at the address
        is alive.
        """
        link = _Link(self.url, self._credentials)
        with contextlib.closing(link), contextlib.suppress(VLAgentsError):
            link.exchange("GET", "/ping", (), {}, PROBE_S)
            return True
        return False

    def _await_answer(
        self, connection: ServerConnection, deadline: float, probe: Callable[[], bool] | None
    ) -> None:
        """Wait for the first byte of an answer."""
        watch = ReplicaWatch() if probe is None else self._watch
        watch.begin()
        ping = None if probe is None else partial(watch.probe, probe)
        watch.wait(connection.poller, deadline, ping)
        watch.received()


class _ProxiedProbe:
    """Pings the replica of one call through the proxy, which may give a ping to another replica.

    The session header routes a ping to the replica that has the request, until the proxy marks this
    replica as down. Therefore an answer is a sign of life only if it comes from the replica that
    answered the previous call, or from the replica that answered the first ping of this call.
    """

    def __init__(
        self,
        url: SplitResult,
        credentials: Credentials,
        session: str,
        answered_by: StreamAddress | None,
    ) -> None:
        self._url, self._credentials = url, credentials
        self._headers = {SESSION_HEADER: session}
        self._replicas = set() if answered_by is None else {answered_by}
        # Whether the replica that answers the first ping is assumed to be the replica of this call.
        self.accepts_first = True

    def __call__(self) -> bool:
        """Return whether the replica of the call has answered a ping."""
        is_first, self.accepts_first = self.accepts_first, False
        link = _Link(self._url, self._credentials)
        with contextlib.closing(link), contextlib.suppress(VLAgentsError):
            status, _, body = link.exchange("GET", "/v1/metadata", (), self._headers, PROBE_S)
            metadata = _json(body)
            if status != 200 or not isinstance(metadata, dict):
                return False

            address = read_address(StreamAddress, metadata.get("stream"))
            if (
                address is None
            ):  # the replicas cannot be distinguished, so the client cannot choose another replica
                return True
            if is_first:
                self._replicas.add(address)
            return address in self._replicas
        return False


def _address_of_link(header: str, op: str) -> StreamAddress | None:
    """Return the own port of the replica that sent this header `Link`; None if it has no own
    port.
    """
    target = header.partition(">")[0].rpartition(":")[2].removesuffix(f"/{op}")
    port, slash, path = target.partition("/")
    if not (port.isascii() and port.isdecimal()):
        return None
    with contextlib.suppress(MalformedMessage):
        return StreamAddress(int(port), slash + path)
    return None


def _is_executed(answer: tuple[int, str, bytes]) -> bool:
    """Return whether a replica may have executed a request, given the answer at its own port.

    Otherwise another server has the port, or the replica accepts no further connection.
    """
    status, kind, _ = answer
    if not kind.startswith((CONTENT_TYPE, PROBLEM_TYPE)):
        return False
    is_refused = status in (404, 503)
    return not (is_refused and type(refusal(*answer)) in (UnknownApp, PolicyUnavailable))


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
        ConfigError: The text is not the URL of a server.
    """
    try:
        parts = urlsplit(url)
        is_port = parts.port != 0
    except ValueError as error:  # raised for an invalid port or IPv6 address
        raise ConfigError(
            f"url: expected http(s)://HOST:PORT, with a port from 1 to 65535, got {url!r} ({error})"
        ) from error

    scheme = {"http": "http", "https": "https", "ws": "http", "wss": "https"}.get(parts.scheme)
    if scheme is None or not parts.hostname or not is_port:
        raise ConfigError(
            f"url: expected http(s)://HOST:PORT, ws(s)://HOST:PORT or serve://APP, got {url!r}"
        )
    return parts._replace(scheme=scheme)


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
    if status in (401, 403):  # the answer has no JSON document, e.g. if a WebSocket was rejected
        return (Unauthorized if status == 401 else Forbidden)(
            f"the server rejects this API key, or requires one (HTTP {status}); set api_key or "
            f"{KEY_VARIABLE}"
        )
    if status == 404:
        return UnknownApp(
            f"no application at this path ({text}); the URL ends in the route prefix of an "
            "application, such as http://HOST:8000/NAME; the server prints it when it starts"
        )
    if status in (500, 502, 503, 504):  # the proxy answered, since no replica is ready
        return NoReplica(f"no replica answers (HTTP {status}: {text})")
    return VLAgentsError(f"HTTP {status}: {text}")


def _json(body: bytes) -> Any:
    if len(body) > _MOST_JSON:  # parsing would take longer than the time limit of the call
        return None
    try:
        return json.loads(body)
    except (ValueError, RecursionError):  # the body is not JSON, or is hostile JSON
        return None
