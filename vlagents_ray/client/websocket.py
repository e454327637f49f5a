"""`WS /v1/stream`: binary frames on one connection, which is the session."""

from __future__ import annotations

import contextlib
import ssl
import time
from collections.abc import Sequence
from typing import Any

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from vlagents_ray.client.credentials import NOBODY, Credentials, tls_failure
from vlagents_ray.client.http import HttpTransport, http_url, refusal
from vlagents_ray.client.link import CodecChoice
from vlagents_ray.client.transport import is_answer
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, MalformedMessage, MessageTooLarge, PolicyUnavailable
from vlagents_ray.wire.frames import decode_replies, decode_reply, encode_requests
from vlagents_ray.wire.messages import STREAM_BYTES, Reply, Request
from vlagents_ray.wire.probe import is_answer as is_probe_answer


class WebSocketTransport:
    """Sessions end with the connection."""

    name = "websocket"
    holds_sessions = True

    def __init__(self, url: str, codec: CodecChoice, credentials: Credentials = NOBODY) -> None:
        self._credentials = credentials
        base = http_url(url)
        scheme = "wss" if base.scheme == "https" else "ws"
        self._base = base.geturl()
        self._url = base._replace(scheme=scheme, path=base.path.rstrip("/") + "/v1/stream").geturl()
        self._codec = codec
        self._open = contextlib.ExitStack()
        self._socket: ClientConnection | None = None

    def connect(self, timeout_s: float) -> dict[str, Any]:
        """The server's metadata, once it answers and has accepted the stream."""
        deadline = time.monotonic() + timeout_s
        door = HttpTransport(self._base, self._codec, self._credentials)
        try:
            metadata = door.connect(timeout_s)
        finally:
            door.close()
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
        socket = self._stream(timeout_s)
        try:
            socket.send(frame)
            while True:
                data = socket.recv(timeout=max(0.0, deadline - time.monotonic()), decode=False)
                replies = decode_replies(data)
                if is_answer(replies, requests):
                    return replies
        except TimeoutError as error:
            raise DeadlineExceeded(f"{self._url}: no answer within {timeout_s:g} s") from error
        except (ConnectionClosed, OSError) as error:
            self.close()
            raise ConnectionLost(f"{self._url}: {error}; reset before the next act") from error

    def _probe(self, probe: bytes, timeout_s: float) -> None:
        socket = self._stream(timeout_s)
        try:
            socket.send(probe)
            data = socket.recv(timeout=timeout_s, decode=False)
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
        self._socket = None
        self._open.close()

    def _stream(self, timeout_s: float) -> ClientConnection:
        if self._socket is None:
            try:
                self._socket = self._open.enter_context(
                    connect(
                        self._url,
                        open_timeout=timeout_s,
                        close_timeout=1,
                        compression=None,
                        max_size=None,
                        ssl=self._credentials.context(self._url),
                        additional_headers=self._credentials.headers,
                    )
                )
            except ssl.SSLError as error:
                raise tls_failure(self._url, error) from error
            except InvalidStatus as error:
                if error.response.status_code in (401, 403, 429):
                    kind = error.response.headers.get("content-type", "")
                    raise refusal(error.response.status_code, kind, error.response.body or b"") from error
                raise PolicyUnavailable(f"{self._url}: refused with HTTP {error.response.status_code}") from error
            except (OSError, InvalidHandshake, TimeoutError) as error:
                raise PolicyUnavailable(f"{self._url}: cannot connect ({error}); is it running?") from error
        return self._socket
