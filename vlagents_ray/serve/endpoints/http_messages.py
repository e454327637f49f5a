"""Decoding of HTTP requests: forms, JSON documents and frames, within the limits of the
deployment.
"""

from __future__ import annotations

import base64
import hashlib
import logging
import math
import re
import sys
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias, cast

from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request as HttpRequest
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.types import Message, Receive, Scope
from starlette.websockets import WebSocket

from vlagents_ray.errors import (
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    PolicyUnavailable,
    TooManyRequests,
    VLAgentsError,
)
from vlagents_ray.protocol.frames import CONTENT_TYPE, Decoded, check_request, decode_requests
from vlagents_ray.protocol.json_messages import (
    CAMERA_PREFIX,
    PROBLEM_TYPE,
    problem,
    request_from_parts,
)
from vlagents_ray.protocol.messages import (
    DEADLINE_HEADER,
    MOST_DEADLINE_MS,
    PRIORITY_HEADER,
    REQUEST_ID_HEADER,
    SESSION_HEADER,
    STEP_HEADER,
    Budget,
    MessageLimits,
    Op,
    Request,
    StreamAddress,
    is_name,
)
from vlagents_ray.serve.endpoints import answers
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.requests import IncomingMessage

logger = logging.getLogger(__name__)

# Longer JSON or msgpack is decoded on another thread, to keep the event loop responsive.
LONG_BYTES = 512 * 1024
DROPPED_BYTES = 2**20  # a connection is closed after a rejected request with a longer body
# Delay of the answer to a caller without a valid key, s. Without this delay, eight connections that
# send only wrong keys double the time of a robot's act on two cores, and the bodies of their
# requests take the whole bandwidth. A person with a wrong key does not notice the delay.
REFUSAL_S = 0.05
FORM_TYPE = "multipart/form-data"
_POLICY_VIOLATION = 1008  # WebSocket close code
# A host name or an address, before the port in a `host` header.
_HOST = re.compile(r"[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]")
_GZIP = b"\x1f\x8b"  # the first bytes of a gzip file
_HEADERS = "vlagents_ray.headers"  # key of the decoded headers in an ASGI scope


class _Refused(MultiPartException):
    """Raised to stop the reading of a body; the parser of a form then closes its files."""

    def __init__(self, error: VLAgentsError) -> None:
        super().__init__(str(error))
        self.error = error


@dataclass(frozen=True, slots=True)
class Body:
    """A body that has arrived."""

    read: Callable[[Budget], Decoded]  # function that decodes the requests
    is_long: bool = False  # whether the body is always decoded on another thread


async def read_requests(
    op: Op, http: HttpRequest, admission: MessageAdmission, name: str
) -> Decoded:
    """Read the requests of a POST to the path of `op`; the first request gets the id `name` if it
    has no id.

    An error that concerns the whole body is raised.
    """
    body = await receive_body(op, http, admission, name)
    return await admission.decoded(body.read, long=body.is_long)


def body_of(op: Op, http: HttpRequest, data: bytes, admission: MessageAdmission, name: str) -> Body:
    """Return a body whose bytes have all arrived, as `receive_body` does."""
    content_type = content_type_of(headers_of(http.scope))
    if content_type != FORM_TYPE and (op != "close" or content_type):
        _require_uncompressed(http)
        if data:
            admission.receive(len(data))
        return _body(op, http, admission.limits, name, *_decoder(op, content_type, data))

    async def receive() -> Message:
        """Return the whole body."""
        return {"type": "http.request", "body": data, "more_body": False}

    receiving = receive_body(op, HttpRequest(http.scope, receive), admission, name)
    try:
        # The coroutine waits only for bytes, since forms are kept in memory.
        receiving.send(None)
    except StopIteration as ended:
        body: Body = ended.value
        return body
    receiving.close()
    raise RuntimeError("the body was not read at once")


async def receive_body(op: Op, http: HttpRequest, admission: MessageAdmission, name: str) -> Body:
    """Receive the body of a POST to the path of `op`; the arguments and errors are the same as in
    `read_requests`.
    """
    headers = headers_of(http.scope)
    content_type = content_type_of(headers)
    require_length(headers, admission.limits)

    if content_type == FORM_TYPE:
        document, files = await _receive_form(http, admission)
        read: _Decoder = partial(request_from_parts, op, document, files)
        is_long = len(document) > LONG_BYTES
    elif op == "close" and not content_type:
        read, is_long = _bare_close, False
    else:
        read, is_long = _decoder(op, content_type, await read_body(http, admission))
    return _body(op, http, admission.limits, name, read, is_long)


_Decoder: TypeAlias = Callable[[Budget], Request | Decoded]


def _decoder(op: Op, content_type: str, data: bytes) -> tuple[_Decoder, bool]:
    """Return the decoder of a body that is not a form, and whether the body is long."""
    if data.startswith(_GZIP):
        raise MalformedMessage("body: expected it uncompressed, got gzip; send it as it is")
    if content_type == CONTENT_TYPE:
        return partial(decode_requests, data), False
    if content_type == "application/json":
        return partial(request_from_parts, op, data, {}), len(data) > LONG_BYTES
    raise MalformedMessage(
        f"content-type: expected multipart/form-data, application/json or {CONTENT_TYPE}, got "
        f"{content_type or 'none'!r}"
    )


def _body(
    op: Op, http: HttpRequest, limits: MessageLimits, name: str, read: _Decoder, is_long: bool
) -> Body:
    """Return a body whose decoded requests also contain the settings in the headers."""
    headers = headers_of(http.scope)

    def read_with_headers(budget: Budget) -> Decoded:
        """Decode the requests, and add the settings in the headers."""
        content = read(budget)
        decoded = Decoded([content], {}) if isinstance(content, Request) else content
        _read_headers(op, decoded.requests, headers, name, limits)
        return decoded

    return Body(read_with_headers, is_long)


def content_type_of(headers: Mapping[str, str]) -> str:
    """Return the content type of a request in lower case, without parameters."""
    return headers.get("content-type", "").partition(";")[0].strip().lower()


def require_length(headers: Mapping[str, str], limits: MessageLimits) -> None:
    """Raise `MessageTooLarge` if the headers declare a body above its limit."""
    length = headers.get("content-length", "")
    if length.isdigit() and int(length) > limits.body_bytes:
        raise MessageTooLarge(
            f"body: expected at most {limits.body_bytes} bytes, got {length} declared"
        )


def _bare_close(_: Budget) -> Request:
    return Request("close")


def _read_headers(
    op: Op, requests: list[Request], headers: dict[str, str], name: str, limits: MessageLimits
) -> None:
    """Check the requests, and add the deadline, step and priority in the headers to them."""
    id_header = headers.get(REQUEST_ID_HEADER, "")
    if not is_name(id_header):
        raise MalformedMessage(
            f"header {REQUEST_ID_HEADER}: expected 1 to 128 visible ASCII characters, got "
            f"{id_header[:40]!r}"
        )

    deadline = headers.get(DEADLINE_HEADER)
    priority = headers.get(PRIORITY_HEADER)
    step = headers.get(STEP_HEADER)
    fields: dict[str, Any] = {}
    for index, request in enumerate(requests):
        if request.op != op:
            raise MalformedMessage(f"op: the frame says {request.op!r}, the path says {op!r}")
        if deadline:
            fields["deadline_ms"] = _deadline_ms(deadline)
        if step:
            fields["step"] = _step(step)
        if priority:
            fields["priority"] = priority

        default_id = name if index == 0 else ""
        request_id = request.request_id or default_id
        requests[index] = replace(request, request_id=request_id, **fields)
        if priority:
            check_request(requests[index], limits)


class _FormParser(MultiPartParser):
    """A parser that keeps all files in memory; this memory counts as in-flight memory."""

    spool_max_size = sys.maxsize


async def _receive_form(
    http: HttpRequest, admission: MessageAdmission
) -> tuple[str | bytes, dict[str, bytes]]:
    """Receive a form; return the JSON document `obs`, and the file of each camera."""
    _require_uncompressed(http)
    limits = admission.limits
    document: str | bytes | None = None
    files: dict[str, bytes] = {}
    limited = HttpRequest(http.scope, _limited(http, admission))
    try:
        parser = _FormParser(
            limited.headers,
            limited.stream(),
            max_files=limits.cameras + 1,
            max_fields=limits.cameras + 1,
            max_part_size=limits.body_bytes,
        )
        form = await parser.parse()
        try:
            for name, value in form.multi_items():
                data = value if isinstance(value, str) else await value.read()
                camera = name.removeprefix(CAMERA_PREFIX)
                is_document = name == "obs"
                is_camera = name != camera

                if (is_document and document is not None) or (is_camera and camera in files):
                    raise MalformedMessage(
                        f"form: expected the part {name[:80]!r} once, got it twice"
                    )
                if is_document:
                    document = data
                elif is_camera and camera and isinstance(data, bytes):
                    files[camera] = data
                else:
                    raise MalformedMessage(f"form: {_describe_wrong_part(name)}")
        finally:
            await form.close()
    except MultiPartException as error:
        for refused in (error, error.__context__):
            if isinstance(refused, _Refused):
                raise refused.error from None
        raise MalformedMessage(f"form: {error.message}") from error

    if document is None:
        raise MalformedMessage("form: no part 'obs'; send a JSON document, {} at least")
    return document, files


def _limited(http: HttpRequest, admission: MessageAdmission) -> Receive:
    """Return a `receive` that limits the whole body: the parser limits only single parts, and no
    files.
    """
    size = 0
    limit = admission.limits.body_bytes

    async def receive() -> Message:
        """Receive a message of the body, and count its bytes."""
        nonlocal size
        message = await http.receive()
        length = len(message.get("body", b""))
        size += length
        try:
            if size > limit:
                raise MessageTooLarge(f"body: over {limit} bytes, the limit")
            if length:
                admission.receive(length)
        except VLAgentsError as error:
            raise _Refused(error) from error
        return message

    return receive


async def read_body(http: HttpRequest, admission: MessageAdmission) -> bytes:
    """Return the whole body.

    Raises:
        MessageTooLarge: The body is over its limit.
        MalformedMessage: The body is compressed.
        Overloaded: The replica has no room for the body among its messages in flight.
    """
    _require_uncompressed(http)
    try:
        body = await HttpRequest(http.scope, _limited(http, admission)).body()
    except _Refused as refused:
        raise refused.error from None
    if body.startswith(_GZIP):
        raise MalformedMessage("body: expected it uncompressed, got gzip; send it as it is")
    return body


def _describe_wrong_part(name: str) -> str:
    if name == CAMERA_PREFIX:
        return f"expected a part 'cameras.<name>', got {name!r}, which names no camera"
    if name.startswith(CAMERA_PREFIX):
        return (
            f"expected a file in the part {name[:80]!r}, got text; send it with a filename, as "
            f"curl -F {name[:80]}=@FILE does"
        )
    return f"expected the parts 'obs' and files 'cameras.<name>', got {name[:80]!r}"


def _require_uncompressed(http: HttpRequest) -> None:
    coding = headers_of(http.scope).get("content-encoding", "identity").strip().lower()
    if coding not in ("", "identity"):
        raise MalformedMessage(
            f"content-encoding: expected none, got {coding[:40]!r}; send the body as it is "
            "(images are compressed already)"
        )


def headers_of(scope: Scope) -> dict[str, str]:
    """Return the headers of a request by lower-case name, decoded once; if a name occurs more than
    once, the last value counts.
    """
    headers: dict[str, str] | None = scope.get(_HEADERS)
    if headers is None:
        headers = {
            name.decode("latin-1").lower(): value.decode("latin-1")
            for name, value in scope["headers"]
        }
        scope[_HEADERS] = headers
    return headers


def session_id(http: HttpRequest) -> str:
    """Return the session id, which every request must have in its header; raise `MalformedMessage`
    if it is missing.
    """
    name = headers_of(http.scope).get(SESSION_HEADER, "")
    if not name or not is_name(name):
        raise MalformedMessage(
            f"header {SESSION_HEADER}: expected 1 to 128 visible ASCII characters, got "
            f"{name[:40]!r}; choose one for each robot or env and send it with every request"
        )
    return name


def _deadline_ms(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < MOST_DEADLINE_MS:
        raise MalformedMessage(
            f"header {DEADLINE_HEADER}: expected milliseconds above 0 and below "
            f"{MOST_DEADLINE_MS:g}, got {text[:40]!r}"
        )
    return value


def _step(text: str) -> int:
    if not text.isdecimal() or len(text) > 19:
        raise MalformedMessage(
            f"header {STEP_HEADER}: expected the number in the last answer's header, got "
            f"{text[:40]!r}"
        )
    return int(text)


def request_id(http: HttpRequest) -> str:
    """Return the request id in the header, which Serve adds if the caller has sent none."""
    return valid_request_id(headers_of(http.scope).get(REQUEST_ID_HEADER, ""))


def valid_request_id(header: str) -> str:
    """Return the request id of a header, or a new id if the header is empty, invalid, or could
    forge a log line.
    """
    return header if header and is_name(header) else uuid.uuid4().hex


async def answer_error(http: HttpRequest, error: Exception) -> Response:
    """Answer a request whose handler has raised an error of this package."""
    return problem_response(cast(VLAgentsError, error), request_id(http))


async def deny(socket: WebSocket, error: VLAgentsError) -> None:
    """Reject a WebSocket before it is accepted, with the error as an HTTP response if the server
    supports that.
    """
    if "websocket.http.response" in (socket.scope.get("extensions") or {}):
        await socket.send_denial_response(problem_response(error, ""))
    else:
        await socket.close(_POLICY_VIOLATION)


def html_response(
    html: str, *, styles: Sequence[str] = (), scripts: Sequence[str] = (), more: str = ""
) -> Response:
    """Return a page that loads nothing from other servers, and that no other site's page may frame.

    Args:
        styles: The texts of its style elements; no other style applies.
        scripts: The texts of its script elements; no other script runs.
        more: Further directives of its content security policy.
    """
    policy = ["default-src 'none'"]
    for kind, texts in (("style", styles), ("script", scripts)):
        if texts:
            digests = " ".join(_digest(text) for text in texts)
            policy.append(f"{kind}-src {digests}")
    if more:
        policy.append(more)
    policy.append("base-uri 'none'; form-action 'none'; frame-ancestors 'none'")

    headers = {
        "content-security-policy": "; ".join(policy),
        "cache-control": "no-cache",
        "referrer-policy": "no-referrer",
        "x-content-type-options": "nosniff",
    }
    return HTMLResponse(html, headers=headers)


def _digest(text: str) -> str:
    """Return the SHA-256 of a text as a source of a content security policy."""
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"


def accepts_frames(headers: Mapping[str, str]) -> bool:
    """Return whether the client of a request with these headers reads frames."""
    return CONTENT_TYPE in headers.get("accept", "")


def response_to(message: IncomingMessage, headers: Mapping[str, str]) -> Response:
    """Return the response with the replies of a message.

    Args:
        headers: The headers of the request.

    Raises:
        VLAgentsError: The only reply is an error.
    """
    replies = message.replies
    error = replies[0].error if len(replies) == 1 else None
    if error is not None:
        raise error
    if accepts_frames(headers) or len(replies) > 1:
        return Response(answers.as_frame(message), media_type=CONTENT_TYPE)

    step = replies[0].step
    step_header = {} if step is None else {STEP_HEADER: str(step)}
    document = answers.as_document(message)
    return Response(document, headers=step_header, media_type="application/json")


def add_link(response: Response, direct: StreamAddress, op: Op, headers: Mapping[str, str]) -> None:
    """Add a header with the address of the same operation at the replica's own port.

    The reference has no scheme, so that a client behind an outer proxy with TLS does not send its
    key in plain text (RFC 8288, RFC 3986, 4.2). There is no header if the request names no host.
    """
    host = _HOST.match(headers.get("host", ""))
    if host is not None:
        address = f"//{host[0]}:{direct.port}{direct.path}/{op}"
        response.headers["link"] = f'<{address}>; rel="alternate"'


def public_problem(error: Exception, operation: str, request_id: str) -> VLAgentsError:
    """Return the error that a client may see; details of an unexpected error are only logged."""
    if isinstance(error, VLAgentsError):
        return error
    logger.error("%s failed (request %s)", operation, request_id, exc_info=error)
    return VLAgentsError("internal error; the server's log has the details")


def problem_response(error: VLAgentsError, request_id: str, status: int | None = None) -> Response:
    """Return the problem document of an error, with `status` or, if it is None, the status of the
    error.
    """
    document = problem(error, request_id)
    if status is not None:
        document["status"] = status
    response = JSONResponse(document, status_code=document["status"], media_type=PROBLEM_TYPE)
    if isinstance(error, TooManyRequests | Overloaded | PolicyUnavailable):
        response.headers["retry-after"] = str(max(1, math.ceil(error.retry_after_s)))
    return response
