"""Binary frames on one WebSocket, with which its sessions end: to a replica's own port, or through the proxy.

The metadata says where the replica listens. Where that port is not reached (a firewall, a tunnel of one port,
TLS, which ends at the proxy), `WS /v1/stream` on the server's port does the same, a little slower.
"""

from __future__ import annotations

import contextlib
import logging
import socket
import ssl
import struct
import time
from collections.abc import Sequence
from typing import Any, Protocol

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from vlagents_ray.client.credentials import NOBODY, WEBSOCKET_LOG, Credentials, tls_failure
from vlagents_ray.client.http import HttpTransport, http_url, refusal
from vlagents_ray.client.link import CodecChoice
from vlagents_ray.client.stream import Stream
from vlagents_ray.client.transport import is_answer
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, MalformedMessage, MessageTooLarge, PolicyUnavailable
from vlagents_ray.wire.frames import decode_replies, decode_reply, encode_requests
from vlagents_ray.wire.messages import SERVERS_MACHINE, STREAM_BYTES, Reply, Request, StreamAddress
from vlagents_ray.wire.probe import is_answer as is_probe_answer

logger = logging.getLogger(__name__)

_PASSING = (408, 500, 502, 503, 504)  # statuses of a proxy; HAProxy says 500 for its own 502 to 504
_PAUSE_S = 0.2
_DIRECT_S = 1.0  # for a replica's own port to answer: a firewall may swallow the question


class _Socket(Protocol):
    def send(self, message: bytes, timeout_s: float) -> None: ...

    def recv(self, timeout_s: float) -> bytes: ...

    def close(self) -> None: ...


class _Proxied:
    """A connection through the proxy, whose pings a thread answers."""

    def __init__(self, url: str, credentials: Credentials, timeout_s: float) -> None:
        self._open = contextlib.ExitStack()
        self._connection = self._open.enter_context(
            connect(
                url,
                open_timeout=timeout_s,
                close_timeout=1,
                compression=None,
                max_size=None,
                ssl=credentials.context(url),
                additional_headers=credentials.headers,
                logger=WEBSOCKET_LOG,
            )
        )
        self.close = self._open.close

    def send(self, message: bytes, timeout_s: float) -> None:
        # Kept by the kernel, as websockets sends without a limit: a proxy that hangs would hold up a robot for minutes.
        limit = struct.pack("@ll", int(timeout_s), int(timeout_s % 1 * 1e6))
        self._connection.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
        self._connection.send(message)

    def recv(self, timeout_s: float) -> bytes:
        return self._connection.recv(timeout=timeout_s, decode=False)


class WebSocketTransport:
    """Sessions end with the connection."""

    name = "websocket"
    holds_sessions = True

    def __init__(self, url: str, codec: CodecChoice, credentials: Credentials = NOBODY) -> None:
        self._credentials = credentials
        base = http_url(url)
        scheme = "wss" if base.scheme == "https" else "ws"
        self._base = base
        self._url = base._replace(scheme=scheme, path=base.path.rstrip("/") + "/v1/stream").geturl()
        self._codec = codec
        self._socket: _Socket | None = None
        self._address: StreamAddress | None = None  # of the replica that answered
        self._unreachable = False  # such ports, from here

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """The server's metadata, once it answers and has accepted the stream."""
        deadline = time.monotonic() + timeout_s
        door = HttpTransport(self._base.geturl(), self._codec, self._credentials, SERVERS_MACHINE)
        try:
            metadata = door.connect(timeout_s)
        finally:
            door.close()
        stream = metadata.get("stream")
        self._address = StreamAddress(**stream) if stream and self._base.scheme == "http" else None
        self._stream(max(1.0, deadline - time.monotonic()))
        return metadata

    def call(self, requests: Sequence[Request], timeout_s: float) -> list[Reply]:
        """One frame out, its replies back; replies to requests given up earlier are discarded."""
        deadline = time.monotonic() + timeout_s
        codec = self._codec.of(requests[0].obs, lambda probe: self._probe(probe, timeout_s), STREAM_BYTES)
        frame = encode_requests(requests, codec)
        if len(frame) > STREAM_BYTES:  # the server would only hang up
            raise MessageTooLarge(
                f"{self._url}: got {len(frame)} bytes, the limit of a WebSocket message is {STREAM_BYTES}; "
                f"send JPEG, or use transport='http'"
            )
        connection = self._stream(timeout_s)
        try:
            connection.send(frame, timeout_s)
            while True:
                data = connection.recv(max(0.0, deadline - time.monotonic()))
                replies = decode_replies(data)
                if is_answer(replies, requests):
                    return replies
        except TimeoutError as error:
            raise DeadlineExceeded(f"{self._url}: no answer within {timeout_s:g} s") from error
        except (ConnectionClosed, OSError) as error:
            self.close()
            raise ConnectionLost(f"{self._url}: {error}; reset before the next act") from error

    def _probe(self, probe: bytes, timeout_s: float) -> None:
        connection = self._stream(timeout_s)
        try:
            connection.send(probe, timeout_s)
            data = connection.recv(timeout_s)
        except TimeoutError as error:
            self.close()  # its answer may come later, and would be taken for another's
            raise DeadlineExceeded(
                f"{self._url}: no answer to a probe of {len(probe)} bytes within {timeout_s:g} s"
            ) from error
        except (ConnectionClosed, OSError) as error:
            self.close()
            raise ConnectionLost(f"{self._url}: {error}; reset before the next act") from error
        if not is_probe_answer(data):
            raise decode_reply(data).error or MalformedMessage(f"{self._url}: got another answer to a probe")

    def close(self) -> None:
        """Close the connection, and so its sessions."""
        self._codec.forget()
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _stream(self, timeout_s: float) -> _Socket:
        if self._socket is None:
            self._socket = self._direct(timeout_s) or self._proxied(timeout_s)
        return self._socket

    def _direct(self, timeout_s: float) -> Stream | None:
        if self._address is None or self._unreachable:
            return None
        try:
            limit_s = min(timeout_s, _DIRECT_S)
            return Stream(self._base, self._address.port, self._address.path, limit_s, self._credentials.headers)
        except TimeoutError:  # a firewall swallows the question: once is enough
            self._unreachable = True
        except (OSError, InvalidHandshake) as error:
            logger.debug("%s: port %d: %s", self._url, self._address.port, error)
        return None

    def _proxied(self, timeout_s: float) -> _Proxied:
        """Through the proxy, which is asked again while it says that a replica is about to come or to go."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                return self._accepted(max(0.1, deadline - time.monotonic()))
            except PolicyUnavailable as error:
                cause = error.__cause__
                passing = isinstance(cause, InvalidStatus) and cause.response.status_code in _PASSING
                if not passing or time.monotonic() + _PAUSE_S > deadline:
                    raise
            time.sleep(_PAUSE_S)

    def _accepted(self, timeout_s: float) -> _Proxied:
        try:
            return _Proxied(self._url, self._credentials, timeout_s)
        except ssl.SSLError as error:
            raise tls_failure(self._url, error) from error
        except InvalidStatus as error:
            if error.response.status_code in (401, 403, 429):
                kind = error.response.headers.get("content-type", "")
                raise refusal(error.response.status_code, kind, bytes(error.response.body or b"")) from error
            raise PolicyUnavailable(f"{self._url}: refused with HTTP {error.response.status_code}") from error
        except (OSError, InvalidHandshake, TimeoutError) as error:
            raise PolicyUnavailable(f"{self._url}: cannot connect ({error}); is it running?") from error
