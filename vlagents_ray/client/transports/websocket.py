"""The WebSocket transport: binary frames to a replica's own port, or through the proxy.

Sessions end with the connection. The metadata contains the replica's port. If that port cannot be
reached (because of a firewall, a tunnel of one port, or TLS, which ends at the proxy), the client
uses `WS /v1/stream` on the server's port, which is a little slower.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import ssl
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any
from urllib.parse import SplitResult, urlsplit

from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.protocol import State
from websockets.sync.client import connect
from websockets.uri import parse_uri

from vlagents_ray.client.credentials import (
    ANONYMOUS,
    WEBSOCKET_LOG,
    Credentials,
    require_plain,
    tls_failure,
)
from vlagents_ray.client.limited_websocket import LimitedWebSocket, SharedConnection
from vlagents_ray.client.transports.base import (
    AVOIDED_S,
    DIRECT_S,
    PROBE_S,
    CodecChoice,
    ReplicaSilent,
    ReplicaWatch,
    connection_lost,
    first_timeout_s,
    left_s,
    no_answer,
    poller_of,
    wait,
)
from vlagents_ray.client.transports.http import HttpTransport, http_url, no_replica, refusal
from vlagents_ray.errors import (
    MessageTooLarge,
    PolicyUnavailable,
    UnknownApp,
)
from vlagents_ray.images.codecs import RAW
from vlagents_ray.protocol.compact import STREAM_TAG, CompactWriter, is_compact, read_answers
from vlagents_ray.protocol.frame_layout import Buffer
from vlagents_ray.protocol.frames import decode_replies, request_parts
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    STREAM_BYTES,
    Reply,
    Request,
    StreamAddress,
    read_address,
)
from vlagents_ray.protocol.websocket_frames import ReceiveBuffer, frame_head

logger = logging.getLogger(__name__)

# Transient statuses of a proxy. HAProxy sends 500 in place of its own 502 to 504, and 404 while it
# restarts.
_TRANSIENT = (404, 408, 500, 502, 503, 504)
_PAUSE_S = 0.2
_CLOSE_S = 1.0  # maximum duration of a closing handshake
_PING_SENT_S = 1.0  # s, time limit for the rest of a partly sent ping
_READ_BYTES = 256 * 1024
# The maximum number of pieces that are sent without a copy; Linux takes at most 1,024 at once.
_MAX_PIECES = 64
# A client must mask its frames, so that a web page cannot choose the bytes that a proxy reads (RFC
# 6455, 10.3). This client is not a web page. Its mask of zeros leaves the bytes unchanged, which
# saves two passes over each message.
_NO_MASK = bytes(4)


class ProxiedSocket:
    """A connection through the proxy. A thread answers the server's pings, and reads the answers to
    this client's pings; only the replica at the other end sends these answers.
    """

    def __init__(
        self,
        url: str,
        credentials: Credentials,
        timeout_s: float,
        watch: ReplicaWatch | None = None,
    ) -> None:
        """Connect; raises the errors of `websockets`."""
        self._watch = watch or ReplicaWatch()
        self._watch.is_proxied = True
        self._messages: list[bytes] = []
        self._silent = False  # whether the client has left the replica
        # In websockets 17.1, `connect` must be used as a context manager.
        self._open = contextlib.ExitStack()
        connection = self._open.enter_context(
            connect(
                url,
                open_timeout=timeout_s,
                close_timeout=_CLOSE_S,
                compression=None,
                max_size=DEFAULT_LIMITS.body_bytes,
                ssl=credentials.context(url),
                additional_headers=credentials.headers,
                create_connection=SharedConnection,
                logger=WEBSOCKET_LOG,
            )
        )
        self._websocket = LimitedWebSocket(connection)

    def send(self, message: bytes, timeout_s: float) -> None:
        """Send a message within a time limit; if the limit passes, the connection ends."""
        self._websocket.send(message, timeout_s)

    def send_pieces(self, pieces: Sequence[Buffer], timeout_s: float) -> None:
        """Send a message, given as consecutive pieces, within a time limit."""
        self.send(b"".join(pieces), timeout_s)

    def recv(self, timeout_s: float) -> bytes:
        """Return the next message as bytes, even if it is text.

        Raises:
            TimeoutError: No message arrived in time.
            ReplicaSilent: The client leaves the replica.
        """
        self._watch.begin()
        ping = partial(self._watch.probe, self._is_alive)
        try:
            self._watch.wait_until(self._is_received, time.monotonic() + timeout_s, ping)
        except ReplicaSilent:
            self._silent = True
            raise
        self._watch.received()
        return self._messages.pop(0)

    def close(self) -> None:
        """Close the connection, with a closing handshake that has a time limit; there is no
        handshake if the client has left the replica.
        """
        if self._silent:
            self._websocket.shut_down()
        self._websocket.close(2 * _CLOSE_S)
        self._open.close()

    def _is_received(self, limit_s: float) -> bool:
        """Return whether a message has arrived, or arrives within a time limit."""
        if not self._messages:
            with contextlib.suppress(TimeoutError):
                message = self._websocket.connection.recv(timeout=limit_s, decode=False)
                self._messages.append(message)
        return bool(self._messages)

    def _is_alive(self) -> bool:
        """Return whether the replica answers a ping."""
        with contextlib.suppress(ConnectionClosed, OSError):
            return self._websocket.connection.ping().wait(PROBE_S)
        return False


def open_websocket(
    url: str, credentials: Credentials, timeout_s: float, watch: ReplicaWatch | None = None
) -> ProxiedSocket:
    """Connect to a path of a server's port. The `watch` detects whether the replica is frozen.

    Raises:
        NoReplica: The server cannot be reached, or has no replica yet.
        PolicyUnavailable: The server is not ready.
        VLAgentsError: The server rejects the key.
    """
    try:
        return ProxiedSocket(url, credentials, timeout_s, watch)
    except ssl.SSLError as error:
        raise tls_failure(url, error) from error
    except InvalidStatus as error:
        if error.response.status_code in (401, 403, 404, 429):
            kind = error.response.headers.get("content-type", "")
            raise refusal(
                error.response.status_code, kind, bytes(error.response.body or b"")
            ) from error
        raise PolicyUnavailable(
            f"{url}: the handshake was rejected with HTTP {error.response.status_code}"
        ) from error
    except (OSError, InvalidHandshake, TimeoutError) as error:
        if isinstance(error, InvalidHandshake):
            require_plain(urlsplit(url), timeout_s)
        raise no_replica(url, error) from error


class Stream:
    """A connection to a replica's own port.

    Only the thread that waits for an answer reads and writes the connection, and it pings the
    server while it waits. Between calls, nothing answers the server's pings, so the server must
    rely on the kernel's keep-alive.
    """

    def __init__(
        self,
        base: SplitResult,
        port: int,
        path: str,
        timeout_s: float,
        headers: Mapping[str, str] | None = None,
        watch: ReplicaWatch | None = None,
    ) -> None:
        """Connect to `port` on the host of `base`.

        Raises:
            OSError: The port cannot be reached.
            InvalidHandshake: Another server answers.
        """
        host = base.hostname or ""
        deadline = time.monotonic() + timeout_s
        self._watch = watch or ReplicaWatch()
        self._protocol = ClientProtocol(
            parse_uri(f"ws://{f'[{host}]' if ':' in host else host}:{port}{path}"),
            max_size=DEFAULT_LIMITS.body_bytes,
            logger=WEBSOCKET_LOG,
        )
        self._received = ReceiveBuffer(DEFAULT_LIMITS.body_bytes)
        self._messages: list[bytes] = []
        self._read_memory = memoryview(bytearray(_READ_BYTES))
        self._silent = False  # whether the server failed to read or answer the last message in time

        self._socket = socket.create_connection((host, port), timeout_s)
        try:
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            self._socket.setblocking(False)
            self._poller = poller_of(self._socket, select.POLLIN)

            request = self._protocol.connect()
            request.headers.update(headers or {})
            self._protocol.send_request(request)
            self._flush(deadline)

            while self._protocol.state is State.CONNECTING:
                wait(self._poller, deadline)
                self._read(lambda data: self._protocol.receive_data(bytes(data)), deadline)
                if self._protocol.handshake_exc is not None:
                    raise self._protocol.handshake_exc
            self._received.attach(self._protocol)
            self._watch.is_proxied = False
            self._watch.received()
        except BaseException:
            self._socket.close()
            raise

    def send(self, message: bytes, timeout_s: float) -> None:
        """Send a binary message; raises the errors of `send_pieces`."""
        self.send_pieces([message], timeout_s)

    def send_pieces(self, pieces: Sequence[Buffer], timeout_s: float) -> None:
        """Send a binary message, given as consecutive pieces.

        Raises the errors of `recv`, and `OSError` if the server does not read all of it in time.
        """
        self._check_open()
        self._watch.begin()
        try:
            self._send_message(pieces, time.monotonic() + timeout_s)
        except ReplicaSilent:
            self._silent = True
            raise
        except TimeoutError as error:
            self._silent = True
            raise ConnectionAbortedError(
                f"the server took no message within {timeout_s:g} s"
            ) from error

    def recv(self, timeout_s: float) -> bytes:
        """Return the next binary message.

        Raises:
            ConnectionClosed: The server has closed the connection.
            OSError: The connection broke.
            TimeoutError: No message arrived in time.
            ReplicaSilent: The client leaves the replica.
        """
        deadline = time.monotonic() + timeout_s
        try:
            while not self._messages:
                self._check_open()
                self._watch.wait(self._poller, deadline, self._ping)
                self._read(self._received.parse, deadline)
        except (TimeoutError, ReplicaSilent):
            self._silent = True
            raise
        self._silent = False
        return self._messages.pop(0)

    def close(self) -> None:
        """Close the connection, so that the server notices.

        A message that was not answered in time is useless. Over a broken link, however, the kernel
        would resend the message for minutes. Until then, the server would keep the sessions, and
        would then execute the late message. A TCP reset of the connection prevents both.
        """
        with contextlib.suppress(OSError):
            if self._silent:
                self._socket.setsockopt(
                    socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
                )
            elif self._protocol.state is State.OPEN:
                self._protocol.send_close()
                self._flush(time.monotonic() + 1.0)
        self._socket.close()

    def _check_open(self) -> None:
        """Raise `ConnectionClosed` or `OSError` if the connection is closed, or if the server is
        closing it.
        """
        state = self._protocol.state
        if state is State.CLOSED:
            raise self._protocol.close_exc
        if state is not State.OPEN:
            raise ConnectionResetError(
                f"the server closes the connection ({self._protocol.close_rcvd})"
            )

    def _read(self, parse: Callable[[memoryview], None], deadline: float) -> None:
        count = self._socket.recv_into(self._read_memory)
        self._watch.received()
        if count:
            parse(self._read_memory[:count])
        else:
            self._protocol.receive_eof()
        for event in self._protocol.events_received():
            if isinstance(event, Frame) and event.opcode is Opcode.BINARY:
                self._messages.append(bytes(event.data))
        self._flush(deadline)

    def _ping(self) -> None:
        """Ping the server, unless the socket is full of bytes that the server has not read."""
        self._protocol.send_ping(b"")
        for piece in self._protocol.data_to_send():
            with contextlib.suppress(BlockingIOError):
                sent = self._socket.send(piece)
                self._send(memoryview(piece)[sent:], time.monotonic() + _PING_SENT_S)

    def _flush(self, deadline: float) -> None:
        for piece in self._protocol.data_to_send():
            self._send(memoryview(piece), deadline)

    def _send_message(self, pieces: Sequence[Buffer], deadline: float) -> None:
        """Send a binary message in one frame (RFC 6455, 5.2), without copying its pieces."""
        size = sum(map(len, pieces))
        head = frame_head(size, _NO_MASK)
        pieces = [head, *pieces]
        if len(pieces) > _MAX_PIECES:
            pieces = [b"".join(pieces)]
        try:
            sent = self._socket.sendmsg(pieces)
        except BlockingIOError:
            sent = 0
        if sent < len(head) + size:
            self._send(memoryview(b"".join(pieces))[sent:], deadline)

    def _send(self, data: memoryview, deadline: float) -> None:
        while data:
            try:
                data = data[self._socket.send(data) :]
            except BlockingIOError:
                self._watch.wait(poller_of(self._socket, select.POLLOUT), deadline)
                self._watch.received()


class WebSocketTransport:
    """Frames over a WebSocket; sessions end with the connection."""

    name = "websocket"
    holds_sessions = True

    def __init__(
        self,
        url: str,
        codec: CodecChoice,
        credentials: Credentials = ANONYMOUS,
        watch: ReplicaWatch | None = None,
    ) -> None:
        self._credentials = credentials
        self._watch = watch
        self._base = base = http_url(url)
        scheme = "wss" if base.scheme == "https" else "ws"
        self._url = base._replace(scheme=scheme, path=base.path.rstrip("/") + "/v1/stream").geturl()
        self._codec = codec
        self._socket: ProxiedSocket | Stream | None = None
        self._address: StreamAddress | None = None  # the address of the replica that answered
        self._sends_compact = False  # whether the server accepts acts in compact form
        self._writer = CompactWriter()
        # The earliest time at which a replica's own port is tried, time.monotonic().
        self._try_own_port_at = float("-inf")

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """Return the server's metadata, once it answers and has accepted the stream."""
        deadline = time.monotonic() + timeout_s
        http = HttpTransport(self._base.geturl(), self._codec, self._credentials)
        try:
            metadata = http.read_metadata(timeout_s)
        finally:
            http.close()
        self.connect_to(metadata, max(1.0, deadline - time.monotonic()))
        return metadata

    def connect_to(self, metadata: dict[str, Any], timeout_s: float) -> None:
        """Connect like `connect`, but to the replica with this metadata."""
        stream = read_address(StreamAddress, metadata.get("stream"))
        self._address = stream if self._base.scheme == "http" else None
        self._sends_compact = metadata.get("compact") is True
        self._stream(timeout_s)

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """Send one message and return its replies. Replies to earlier requests that timed out are
        discarded.
        """
        deadline = time.monotonic() + timeout_s
        connection = self._stream(left_s(deadline))
        pieces = self._pieces(requests)
        size = sum(map(len, pieces))
        if size > STREAM_BYTES:  # the server would close the connection
            self._writer = CompactWriter()  # the server does not receive the new layouts
            raise MessageTooLarge(
                f"{self._url}: expected at most {STREAM_BYTES} bytes in a WebSocket message, got "
                f"{size}; send JPEG, or use transport='http'"
            )

        try:
            connection.send_pieces(pieces, left_s(deadline))
            while True:
                answer = connection.recv(max(0.0, deadline - time.monotonic()))
                if is_compact(answer):
                    replies = read_answers(memoryview(answer)[len(STREAM_TAG) :])
                else:
                    replies = decode_replies(answer)
                if replies[0].answers(requests[0]):
                    if not replies[0].request_id:  # the message was rejected before it was parsed
                        self._writer = CompactWriter()
                    return replies
        except ReplicaSilent:
            self.close()
            raise
        except TimeoutError as error:
            raise no_answer(self._url, timeout_s) from error
        except (ConnectionClosed, OSError) as error:
            self.close()
            raise connection_lost(self._url, f"{error}; reset before the next act") from error

    def close(self) -> None:
        """Close the connection and its sessions."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _pieces(self, requests: Sequence[Request]) -> list[Buffer]:
        """Return the pieces of a message, in compact form if possible."""
        codec = self._codec.codec_for(requests[0].obs, STREAM_BYTES)
        written = self._writer.write(requests) if self._sends_compact and codec == RAW else None
        return request_parts(requests, codec) if written is None else written.stream_parts()

    def _stream(self, timeout_s: float) -> ProxiedSocket | Stream:
        if self._socket is None:
            self._writer = CompactWriter()  # the new connection knows no layout
            self._socket = self._direct(timeout_s) or self._proxied(timeout_s)
        return self._socket

    def _direct(self, timeout_s: float) -> Stream | None:
        if self._address is None or time.monotonic() < self._try_own_port_at:
            return None
        try:
            limit_s = min(timeout_s, DIRECT_S)
            return Stream(
                self._base,
                self._address.port,
                self._address.path,
                limit_s,
                self._credentials.headers,
                self._watch,
            )
        except TimeoutError:  # a firewall drops the packets
            self._try_own_port_at = time.monotonic() + AVOIDED_S
        except (OSError, InvalidHandshake) as error:
            logger.debug("%s: port %d: %s", self._url, self._address.port, error)
        return None

    def _proxied(self, timeout_s: float) -> ProxiedSocket:
        """Connect through the proxy, and retry while the proxy reports that a replica is starting
        or stopping.

        It also retries if there is no answer, since the replica that the proxy chose may hang while
        the next replica works.
        """
        deadline = time.monotonic() + timeout_s
        attempt_s = first_timeout_s(timeout_s)

        while True:
            limit_s = max(0.1, min(attempt_s, deadline - time.monotonic()))
            try:
                return open_websocket(self._url, self._credentials, limit_s, self._watch)
            except (PolicyUnavailable, UnknownApp) as error:
                cause = error.__cause__
                is_transient = (
                    isinstance(cause, InvalidStatus) and cause.response.status_code in _TRANSIENT
                )
                is_silent = isinstance(cause, TimeoutError)
                if not (is_transient or is_silent) or time.monotonic() + _PAUSE_S > deadline:
                    raise
                if is_silent:
                    attempt_s *= 2

            time.sleep(_PAUSE_S)
