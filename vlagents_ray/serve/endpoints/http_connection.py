"""HTTP/1.1 at the replica's own port: `POST …/reset`, `…/act` and `…/close`, below its path.

The policy thread reads these connections like WebSockets, so a request passes through no proxy and
no event loop. The decoders, the status codes and the error documents are the same as at the
server's port (`http_messages`), and the access control is the same as in `AccessMiddleware`: each
request needs a key if the server has keys, and otherwise a host and an origin of this server.

One request of a connection is served at a time. The bytes of the next request stay in the socket
until the answer is sent.
"""

from __future__ import annotations

import http
import socket
import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from email.utils import formatdate
from functools import lru_cache, partial
from typing import cast

import httptools
from starlette.requests import Request as HttpRequest
from starlette.responses import Response

from vlagents_ray.errors import (
    Forbidden,
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    PolicyUnavailable,
    TooManyRequests,
    Unauthorized,
    UnknownApp,
    VLAgentsError,
    shown,
)
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import PRIORITY_HEADER, REQUEST_ID_HEADER, Budget, Op
from vlagents_ray.serve.access.api_keys import Caller, Identity
from vlagents_ray.serve.access.charges import Charge
from vlagents_ray.serve.endpoints import http_messages
from vlagents_ray.serve.endpoints.connection import (
    INTERNAL_ERROR,
    LEAST_WAIT_S,
    POLICY_VIOLATION,
    SERVICE_RESTART,
    PolledServer,
)
from vlagents_ray.serve.endpoints.message_connection import (
    READ_BYTES,
    TRY_AGAIN_LATER,
    MessageConnection,
)
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.engine.sender import Sender, message_admission
from vlagents_ray.serve.requests import IncomingMessage

HEAD_BYTES = 16 * 1024  # maximum size of a request's head
END_OF_HEAD = b"\r\n\r\n"
# Maximum number of fields of a head, about as at the server's port, where HAProxy allows 101. Each
# field takes as long as hundreds of bytes, before the key is known.
MOST_FIELDS = 100
# Larger forms are read on another thread, since finding the end of each part takes time.
_INLINE_FORM_BYTES = 2**20
# Maximum number of bytes of a body with chunks that are read at once, since a chunk of one byte
# costs as much as a chunk of a kilobyte.
_CHUNKED_BYTES = 16 * 1024
# Maximum number of bytes around the chunks: the heads of chunks, their extensions, and trailers.
# The maximum is the first number plus this share of the body's size.
_FRAMING_BYTES, _FRAMING_SHARE = 16 * 1024, 1 / 64
_MOST_REFUSED_S = 1.0  # maximum time for which the refusal of a first request is delayed
_REFUSED = "its request is refused"  # a further reason for not polling a connection
_CONTINUE = b"HTTP/1.1 100 Continue\r\n\r\n"
_TIMEOUT, _HEAD_TOO_LARGE, _NOT_ALLOWED = 408, 431, 405
_NO_PATH = (
    "no such path at a replica's own port, which has only reset, act and close; GET /docs of the "
    "server's port lists the others"
)
# The error for the client if a connection ends during a request, by the close code that a WebSocket
# would have.
_ENDINGS: dict[int, type[VLAgentsError]] = {
    POLICY_VIOLATION: Unauthorized,
    TRY_AGAIN_LATER: Overloaded,
    SERVICE_RESTART: PolicyUnavailable,
    _TIMEOUT: MalformedMessage,
}


@dataclass(slots=True)
class HttpHead:
    """The head of a request, as httptools reports it."""

    method: str = ""
    path: str = ""
    is_kept: bool = True  # whether the client requests to keep the connection
    version: str = "1.1"
    is_chunked: bool = False
    fields: list[tuple[bytes, bytes]] = field(default_factory=list)
    http: HttpRequest = field(init=False)  # the head in the form that the decoders need

    @property
    def headers(self) -> dict[str, str]:
        """The headers by lower-case name."""
        return http_messages.headers_of(self.http.scope)

    @property
    def length(self) -> int:
        """The declared number of bytes of the body."""
        return int(self.headers.get("content-length", "0"))

    @property
    def waits(self) -> bool:
        """Whether the client sends the body only after a "100 Continue"."""
        return self.version != "1.0" and self.headers.get("expect", "").lower() == "100-continue"


class _Reading:
    """The callbacks of httptools for one request."""

    def __init__(self) -> None:
        self.head = HttpHead()
        self.body = bytearray()  # received part of a chunked body
        self.fed = 0  # number of bytes that the parser of the body has received
        self.has_head = False  # whether the head is complete
        self.is_complete = False
        self.has_next = False  # whether bytes of another request followed
        # The parser of a chunked body. It refers to this object, so it is removed after use.
        self.parser: httptools.HttpRequestParser | None = None

    def on_message_begin(self) -> None:
        self.has_next = self.is_complete

    def on_url(self, url: bytes) -> None:
        if not self.has_next:
            self.head.path += url.decode("latin-1")

    def on_headers_complete(self) -> None:
        self.has_head = True

    def on_header(self, name: bytes, value: bytes) -> None:
        if not self.has_head:  # not a trailer or a header of the next request
            self.head.fields.append((name.lower(), value))

    def on_body(self, data: bytes) -> None:
        if not self.is_complete:
            self.body += data

    def on_message_complete(self) -> None:
        self.is_complete = True


def is_too_large(head: bytes) -> bool:
    """Return whether a head, or its received part, exceeds the limits of its size and fields."""
    # The request and the end of the head are two further lines.
    return len(head) > HEAD_BYTES or head.count(b"\n") > MOST_FIELDS + 2


def read_head(data: bytes) -> _Reading:
    """Parse the head of a request, which is not too large.

    Raises:
        MalformedMessage: The bytes are not HTTP, or a header is not UTF-8.
    """
    reading = _Reading()
    parser = httptools.HttpRequestParser(reading)
    try:
        parser.feed_data(data)
    except httptools.HttpParserUpgrade:  # the client's offer of another protocol may be ignored
        pass
    except httptools.HttpParserError as error:
        got = f"{data[:40]!r} ({error})"
        raise MalformedMessage(f"expected a request of HTTP/1.1, got {got}") from error

    if not reading.has_head:
        raise MalformedMessage("expected a request of HTTP/1.1, got empty lines")
    head = reading.head
    for name, value in head.fields:
        try:
            name.decode(), value.decode()
        except UnicodeDecodeError as error:
            got = shown(value)
            raise MalformedMessage(f"header {shown(name)}: expected UTF-8, got {got}") from error
    head.method = parser.get_method().decode()
    head.version = parser.get_http_version()
    head.is_kept = parser.should_keep_alive()
    head.http = HttpRequest({"type": "http", "method": head.method, "headers": head.fields})
    head.is_chunked = "transfer-encoding" in head.headers
    head.path = _path_of(head.path)
    if head.is_chunked:
        reading.parser = parser
    return reading


@lru_cache(maxsize=64)  # a client sends the same few URLs
def _path_of(url: str) -> str:
    """Return the path of a request's target, which may be a whole URL, without the query."""
    try:
        parts = httptools.parse_url(url.encode("latin-1"))
    except httptools.HttpParserInvalidURLError:
        return ""
    return (parts.path or b"").decode("latin-1")


def head_bytes(connection: socket.socket, received: bytes) -> int:
    """Return how many more bytes of a head to read after `received`: at least one, and no byte
    beyond the end of the head.

    Raises:
        BlockingIOError: The socket is empty.
    """
    peeked = connection.recv(HEAD_BYTES, socket.MSG_PEEK)
    # The end of the head may have arrived in parts.
    overlap = received[1 - len(END_OF_HEAD) :]
    end = (overlap + peeked).find(END_OF_HEAD)
    if end < 0:
        return len(peeked) or 1
    return end + len(END_OF_HEAD) - len(overlap)


class HttpServer(PolledServer[MessageConnection]):
    """A server that accepts HTTP connections at its port."""

    slow_s: float  # maximum time that a request may take to arrive, s
    idle_s: float  # maximum time that a connection may be silent, s

    @abstractmethod
    def identify_request(
        self, headers: Mapping[str, str], known: tuple[Identity, str | None] | None = None
    ) -> tuple[Identity, str | None]:
        """Return the caller that owns the key in the headers, and the key.

        Args:
            known: The result for the connection's last request, to be returned if the key is the
                same. The caller then checks whether the key is still valid.

        Raises:
            Unauthorized: The key is missing, unknown, revoked or expired.
            Forbidden: The key is for other applications, or the page is another site's.
        """

    @abstractmethod
    def count_connection(self, client: MessageConnection, caller: Identity) -> None:
        """Count the connection for its caller, and no longer as a connection with an unknown
        caller.

        Raises:
            TooManyRequests: The key has as many connections as it may hold sessions, or is over its
                rate.
            PolicyUnavailable: The replica has as many connections as it may hold sessions.
        """

    @abstractmethod
    def op_of(self, path: str) -> Op | None:
        """Return the operation of a path below this server's unguessable path; None for any other
        path.
        """


class HttpConnection(MessageConnection):
    """One HTTP connection of the replica's own port.

    It replaces the `PortConnection` that has read the head of its first request.
    """

    late_code = _TIMEOUT

    def __init__(self, server: HttpServer, connection: socket.socket) -> None:
        limits = server.limits
        super().__init__(
            server,
            connection,
            server.engine.admission,
            slow_s=server.slow_s,
            idle_s=server.idle_s,
            answer_bytes=limits.body_bytes,
        )
        self._server = server
        self._engine = server.engine
        self._limits = limits
        self._key: str | None = None  # key of the caller

        self._head = b""  # received part of a head
        self._reading: _Reading | None = None  # request whose body is arriving
        self._left = 0  # number of missing bytes of that body; -1 if the body has chunks
        self._parts: list[bytes] = []  # received parts of that body
        self._size = 0  # number of bytes in these parts
        self._is_dropped = False  # whether the body is discarded because the request is rejected
        self._answering: HttpHead | None = None  # request whose answer is awaited
        self._request_id = ""  # request id in the headers of the answer
        self._name = ""  # request id in the document of an error
        self._sender: Sender | None = None  # sender of that request
        self._charge: Charge | None = None  # charge of the latest request

    # Reading.

    @property
    def _is_over(self) -> bool:
        return self._is_closed_here

    @property
    def _incomplete_bytes(self) -> int:
        return len(self._head) + self._size + (self._reading is not None)

    def _is_backlogged(self) -> bool:
        return self._unanswered > 0

    def _read(self) -> None:
        if self._unanswered and not self._is_over:
            self._read_early()
        else:
            super()._read()

    def _read_early(self) -> None:
        """Leave bytes in the socket that arrive before the answer is sent, and notice the end of
        the connection.
        """
        try:
            is_open = bool(self._connection.recv(1, socket.MSG_PEEK))
        except BlockingIOError:
            return
        except OSError:
            is_open = False
        if is_open:
            self._pause_if_backlogged()
        else:
            self.disconnect()

    def _bytes_to_read(self) -> int:
        if self._reading is None:
            return head_bytes(self._connection, self._head)
        return _CHUNKED_BYTES if self._left < 0 else min(self._left, READ_BYTES)

    def _receive_bytes(self, data: bytes | memoryview) -> bool:
        if not data:
            self.disconnect()
            return False
        if self._reading is None:
            self._receive_head(bytes(data))
        else:
            self._receive_body(data)
        if (
            self._incomplete_bytes
            and self.caller is not None
            and not (self._is_over or self._ended)
        ):
            self._count_incomplete()
        return self._polled and not (self._ended or self._unanswered or self._is_over)

    def _receive_head(self, data: bytes) -> None:
        """Process bytes of a head."""
        if not self._head:
            self._request_id = self._name = ""
        self._head += data
        if self._head.endswith(END_OF_HEAD) or is_too_large(self._head):
            head, self._head = self._head, b""
            self.begin(b"" if is_too_large(head) else head)

    def take_over(self, head: bytes) -> None:
        """Serve the first request, whose `head` was read before this object existed; see `begin`.
        An unexpected error ends this connection.
        """
        self._run(partial(self.begin, head))

    def begin(self, head: bytes) -> None:
        """Serve a request whose whole head has arrived; an empty `head` stands for a head that is
        too large, which is rejected.
        """
        try:
            if not head:
                raise MalformedMessage(
                    f"head: expected at most {HEAD_BYTES} bytes and {MOST_FIELDS} fields, got "
                    "more; send fewer header fields"
                )
            reading = read_head(head)
        except MalformedMessage as error:
            status = 400 if head else _HEAD_TOO_LARGE
            self._message_count += 1
            self.account.charge_abuse()
            self._answer_and_end(http_messages.problem_response(error, "", status))
            return

        self._request_id = self._name = http_messages.request_id(reading.head.http)
        try:
            self._charge_request(reading.head)
        except VLAgentsError as error:
            self._refuse_access(reading, error)
            return
        refusal = self._refusal_of(reading.head)
        if refusal is None:
            self._begin_body(reading)
        else:
            self._refuse(reading, refusal)

    def _charge_request(self, head: HttpHead) -> None:
        """Charge the request to its key, and count the connection for that key.

        Raises:
            VLAgentsError: The errors of `HttpServer.identify_request` and `count_connection`.
        """
        known = None if self.caller is None else (self.caller, self._key)
        caller, key = self._server.identify_request(head.headers, known)
        if caller is not self.caller:
            self._server.count_connection(self, caller)
            self.account.identify(caller)
            self._key = key
            self._is_rated = isinstance(caller, Caller)
        self._charge = self.account.charge()
        self._charge.require()

    def _refuse_access(self, reading: _Reading, error: VLAgentsError) -> None:
        """Reject a request whose client has no access, or has sent too many requests."""
        response = http_messages.problem_response(error, self._request_id)
        if isinstance(error, Unauthorized):
            response.headers["www-authenticate"] = 'Bearer realm="vlagents_ray"'

        answer = partial(self._answer_and_end, response, reading.head)
        if isinstance(error, TooManyRequests):
            if self.caller is not None:
                self._refuse(reading, response)
                return
            wait_s = min(error.retry_after_s, _MOST_REFUSED_S)
        elif isinstance(error, Unauthorized | Forbidden):
            wait_s = http_messages.REFUSAL_S
        else:
            answer()
            return
        # The delay bounds the rate of refusals.
        self._pause(_REFUSED)

        def refuse() -> None:
            """Send the refusal."""
            answer()
            self._resume(_REFUSED)

        self._call_later(wait_s, refuse)

    def _refusal_of(self, head: HttpHead) -> Response | None:
        """Return the response to a request that is rejected by its head; None if it is served."""
        try:
            if self._server.op_of(head.path) is None:
                raise UnknownApp(_NO_PATH)
            if head.method != "POST":
                wrong = MalformedMessage("Method Not Allowed; send POST")
                response = http_messages.problem_response(wrong, self._request_id, _NOT_ALLOWED)
                response.headers["allow"] = "POST"
                return response
            http_messages.session_id(head.http)
            http_messages.require_length(head.headers, self._limits)
        except VLAgentsError as error:
            return http_messages.problem_response(error, self._request_id)
        return None

    def _refuse(self, reading: _Reading, response: Response) -> None:
        """Reject a request, whose body is discarded if it is short; otherwise the connection
        ends.
        """
        head = reading.head
        is_known_path = self._server.op_of(head.path) is not None
        is_short = not (head.is_chunked or head.waits or head.length > http_messages.DROPPED_BYTES)
        if not (is_short and is_known_path):
            self._message_count += 1
            self._answer_and_end(response, head)
            return
        self._send_response(response, head)
        if not self._is_closed_here:
            self._is_dropped = True
            self._begin_body(reading)

    def _begin_body(self, reading: _Reading) -> None:
        head = reading.head
        self._reading = reading
        self._left = -1 if head.is_chunked else head.length
        if head.waits and self._left:
            with self._sending:
                if not self._ended:
                    self._out.send(_CONTINUE)
        if not self._left:
            self._complete()

    def _receive_body(self, data: bytes | memoryview) -> None:
        """Process bytes of a body. Unless the body is chunked, no byte lies beyond its end."""
        reading = self._reading
        if reading is None:
            return
        if self._left < 0:
            self._receive_chunks(reading, data)
            return
        self._left -= len(data)
        if not self._is_dropped:
            self._parts.append(bytes(data))
            self._size += len(data)
        if not self._left:
            self._complete()

    def _receive_chunks(self, reading: _Reading, data: bytes | memoryview) -> None:
        if reading.parser is None:
            return
        reading.fed += len(data)
        try:
            reading.parser.feed_data(data)
        except httptools.HttpParserUpgrade:
            pass
        except httptools.HttpParserError as error:
            if not reading.is_complete:
                wrong = MalformedMessage(f"body: its chunks are malformed ({error})")
                self._end_request(wrong)
                return
            reading.has_next = True
        self._size = len(reading.body)
        limit = self._limits.body_bytes
        if self._size > limit:
            self._end_request(MessageTooLarge(f"body: over {limit} bytes, the limit"))
        elif reading.is_complete:
            # A part of the next request has been read; its client must send it again.
            reading.head.is_kept = reading.head.is_kept and not reading.has_next
            self._parts = [bytes(reading.body)]
            self._complete()
        elif reading.fed - self._size > _FRAMING_BYTES + _FRAMING_SHARE * self._size:
            self._end_request(
                MalformedMessage(
                    f"body: expected longer chunks, got {self._size} bytes in chunks that take "
                    f"{reading.fed}; send a content-length"
                )
            )

    def _end_request(self, error: VLAgentsError) -> None:
        """Answer a request whose body cannot be read, and end the connection."""
        reading, self._reading = self._reading, None
        self._parts, self._size = [], 0
        if reading is not None:
            reading.parser = None
        self._release_arriving()
        response = http_messages.problem_response(error, self._request_id)
        self._answer_and_end(response, None if reading is None else reading.head)

    # Serving a request.

    def _complete(self) -> None:
        """Serve a request whose body has arrived."""
        reading, parts = self._reading, self._parts
        self._reading, self._parts, self._size, self._left = None, [], 0, 0
        self._release_arriving()
        self._message_count += 1
        if reading is not None:
            reading.parser = None
        if reading is None or self._is_dropped:
            self._is_dropped = False
            return

        head = self._answering = reading.head
        op = cast(Op, self._server.op_of(head.path))
        incoming = IncomingMessage("http", op, charge=self._charge)
        body = parts[0] if len(parts) == 1 else b"".join(parts)
        self.add_unanswered(len(body))
        incoming.size = len(body)
        try:
            self._decode(op, head, incoming, body)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            self._fail(incoming, error)

    def _decode(self, op: Op, head: HttpHead, incoming: IncomingMessage, data: bytes) -> None:
        """Decode the requests of a body, and submit them."""
        caller, charge = self.caller, incoming.charge
        if caller is None or charge is None:
            raise VLAgentsError("internal error: a request without a caller")
        sender = self._sender = Sender(
            self._engine,
            "http",
            http_messages.session_id(head.http),
            caller=caller,
            has_left=self.has_left,
            connected=False,
            # The end of the connection makes the client reconnect, even if the answer is JSON.
            can_move=True,
        )
        priority = head.headers.get(PRIORITY_HEADER, "robot")
        admission = message_admission(self._engine, charge, self._limits, priority=priority)
        name = self._request_id

        is_form = http_messages.content_type_of(head.headers) == http_messages.FORM_TYPE
        if is_form and len(data) > _INLINE_FORM_BYTES:

            def read(budget: Budget) -> Decoded:
                """Read a long form, on a thread for decoding."""
                return http_messages.body_of(op, head.http, data, admission, name).read(budget)

            body = http_messages.Body(read, is_long=True)
        else:
            body = http_messages.body_of(op, head.http, data, admission, name)

        submit = partial(self._submit, incoming, sender, admission, self._arrived)
        fail = partial(self._fail, incoming)
        self.decode(body.read, admission, submit, fail, long=body.is_long)

    def _submit(
        self,
        incoming: IncomingMessage,
        sender: Sender,
        admission: MessageAdmission,
        arrived: float,
        decoded: Decoded,
    ) -> None:
        """Send the requests to the engine; their deadlines count from the arrival of the body."""
        incoming.decoded(decoded)
        if decoded.requests:
            self._name = decoded.requests[0].request_id
        waited_s = time.perf_counter() - arrived
        sender.send(
            incoming,
            decoded,
            self,
            admission=admission,
            waited_s=waited_s if waited_s > LEAST_WAIT_S else 0.0,
            # For TCP, the kernel records the time of the last segment, which may be the segment
            # that ends the client's connection.
            may_have_waited=True,
        )

    def deliver(self, message: IncomingMessage) -> None:
        """Send the answer of a request, and continue reading."""
        self.send_answers(message, self._send_answer, self._engine.stats)
        self.remove_unanswered(message.size)

    def _fail(self, incoming: IncomingMessage, error: Exception) -> None:
        """Answer a request that cannot be decoded."""
        problem = http_messages.public_problem(error, incoming.kinds[0][0], self._name)
        incoming.refuse(problem, self._name)
        self.deliver(incoming)

    def _send_answer(self, message: IncomingMessage) -> None:
        head, self._sender = self._answering, None
        if head is None:  # the connection has ended
            return
        try:
            response = http_messages.response_to(message, head.headers)
        except VLAgentsError as error:
            response = http_messages.problem_response(error, self._name)
        self._answering = None
        # A client that has to reconnect uses the server's port again.
        is_kept = head.is_kept and not any(reply.draining for reply in message.replies)
        if is_kept:
            self._send_response(response, head)
        else:
            self._answer_and_end(response, head)

    def _send_response(self, response: Response, head: HttpHead) -> None:
        """Send a response after which the connection continues; on any thread."""
        if not head.is_kept:
            self._answer_and_end(response, head)
            return
        data = _bytes_of(response, head, self._request_id, is_kept=True)
        with self._sending:
            if not (self._ended or self._is_closed_here):
                self._out.send(data)

    def _answer_and_end(self, response: Response, head: HttpHead | None = None) -> None:
        """Send a response, and end the connection; on any thread."""
        data = _bytes_of(response, head, self._request_id, is_kept=False)
        with self._sending:
            if not (self._ended or self._is_closed_here):
                self._ended_at = time.monotonic()
                self._out.send(data, last=True)

    # The end.

    def _end_sessions(self) -> None:
        """Withdraw a request that no batch contains yet, and drop an incomplete request. Sessions
        over HTTP outlive a connection.
        """
        self._parts, self._reading = [], None
        self._release_arriving()
        sender, self._sender = self._sender, None
        if sender is not None:
            sender.release()

    def _send_close(self, code: int, reason: str) -> None:
        """Answer an incomplete or unanswered request with an error, and end the connection."""
        if self._is_closed_here:
            return
        self._ended_at = time.monotonic()
        head = self._answering
        if head is None and self._reading is not None:
            head = self._reading.head
        if head is None and not self._head:
            self._out.send(b"", last=True)
            return
        self._answering = None
        if code == INTERNAL_ERROR:
            reason = "internal error; the server's log has the details"
        error = _ENDINGS.get(code, VLAgentsError)(reason)
        status = _TIMEOUT if code == _TIMEOUT else None
        response = http_messages.problem_response(error, self._request_id, status)
        self._out.send(_bytes_of(response, head, self._request_id, is_kept=False), last=True)


def _bytes_of(
    response: Response, head: HttpHead | None, request_id: str, *, is_kept: bool
) -> bytes:
    """Return a response as bytes; `head` is None if the request's head was unreadable."""
    reason = http.HTTPStatus(response.status_code).phrase
    lines = [
        f"HTTP/1.1 {response.status_code} {reason}\r\ndate: {_date(int(time.time()))}".encode()
    ]
    lines += [name + b": " + value for name, value in response.raw_headers]
    if request_id:
        lines.append(f"{REQUEST_ID_HEADER}: {request_id}".encode())
    if not is_kept:
        lines.append(b"connection: close")
    elif head is not None and head.version == "1.0":
        lines.append(b"connection: keep-alive")
    body = b"" if head is not None and head.method == "HEAD" else bytes(response.body)
    return b"\r\n".join([*lines, b"", body])


@lru_cache(maxsize=1)
def _date(seconds: int) -> str:
    return formatdate(seconds, usegmt=True)
