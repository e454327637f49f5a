"""Decoding of HTTP requests: forms, JSON documents and frames, within the limits of the
deployment.
"""

from __future__ import annotations

import base64
import hashlib
import logging
import math
import uuid
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, cast

from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException
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
    MessageLimits,
    Op,
    Request,
    is_name,
)
from vlagents_ray.serve.engine.admission import MessageAdmission

logger = logging.getLogger(__name__)

# Longer JSON or msgpack is decoded on another thread, to keep the event loop responsive.
LONG_BYTES = 512 * 1024
_POLICY_VIOLATION = 1008  # WebSocket close code
_GZIP = b"\x1f\x8b"  # the first bytes of a gzip file
_HEADERS = "vlagents_ray.headers"  # key of the decoded headers in an ASGI scope


class _Refused(MultiPartException):
    """Raised to stop the reading of a body; the parser of a form then closes its files."""

    def __init__(self, error: VLAgentsError) -> None:
        super().__init__(str(error))
        self.error = error


async def read_requests(
    op: Op, http: HttpRequest, admission: MessageAdmission, name: str
) -> Decoded:
    """Read the requests of a POST to the path of `op`; the first one gets the id `name` if it has
    none.

    An error that concerns the whole body is raised.
    """
    headers = headers_of(http.scope)
    limits = admission.limits
    content_type = headers.get("content-type", "").partition(";")[0].strip().lower()
    length = headers.get("content-length", "")
    if length.isdigit() and int(length) > limits.body_bytes:
        raise MessageTooLarge(f"body: declares {length} bytes, the limit is {limits.body_bytes}")

    if content_type == "multipart/form-data":
        decoded = Decoded([await _read_form(op, http, admission)], {})
    elif op == "close" and not content_type:
        decoded = Decoded([Request("close")], {})
    else:
        body = await read_body(http, admission)
        if content_type == CONTENT_TYPE:
            decoded = await admission.decoded(partial(decode_requests, body))
        elif content_type == "application/json":
            read = partial(request_from_parts, op, body, {})
            decoded = Decoded([await admission.decoded(read, long=len(body) > LONG_BYTES)], {})
        else:
            raise MalformedMessage(
                f"content-type: got {content_type or 'none'!r}, want multipart/form-data, "
                f"application/json or {CONTENT_TYPE}"
            )

    _read_headers(op, decoded.requests, headers, name, limits)
    return decoded


def _read_headers(
    op: Op, requests: list[Request], headers: dict[str, str], name: str, limits: MessageLimits
) -> None:
    """Check the requests, and add the deadline, step and priority in the headers to them."""
    id_header = headers.get(REQUEST_ID_HEADER, "")
    if not is_name(id_header):
        raise MalformedMessage(
            f"header {REQUEST_ID_HEADER}: got {id_header[:40]!r}, want 1 to 128 visible ASCII "
            "characters"
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


async def _read_form(op: Op, http: HttpRequest, admission: MessageAdmission) -> Request:
    """Read the request of a form: the JSON document `obs`, and a file for each camera."""
    _require_uncompressed(http)
    limits = admission.limits
    document: str | bytes | None = None
    files: dict[str, bytes] = {}
    try:
        async with HttpRequest(http.scope, _limited(http, admission)).form(
            max_files=limits.cameras + 1,
            max_fields=limits.cameras + 1,
            max_part_size=limits.body_bytes,
        ) as form:
            for name, value in form.multi_items():
                data = value if isinstance(value, str) else await value.read()
                camera = name.removeprefix(CAMERA_PREFIX)
                is_document = name == "obs"
                is_camera = name != camera

                if (is_document and document is not None) or (is_camera and camera in files):
                    raise MalformedMessage(f"form: got the part {name[:80]!r} twice, want it once")
                if is_document:
                    document = data
                elif is_camera and camera and isinstance(data, bytes):
                    files[camera] = data
                else:
                    raise MalformedMessage(f"form: {_describe_wrong_part(name)}")
    except (MultiPartException, HTTPException) as error:
        for refused in (error, error.__context__):
            if isinstance(refused, _Refused):
                raise refused.error from None
        text = error.message if isinstance(error, MultiPartException) else error.detail
        raise MalformedMessage(f"form: {text}") from error

    if document is None:
        raise MalformedMessage("form: no part 'obs'; send a JSON document, {} at least")
    return await admission.decoded(
        partial(request_from_parts, op, document, files), long=len(document) > LONG_BYTES
    )


def _limited(http: HttpRequest, admission: MessageAdmission) -> Receive:
    """Return a `receive` that limits the whole body: the parser limits only single parts, and
    files not at all.
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
        raise MalformedMessage("body: got gzip, want it uncompressed; send it as it is")
    return body


def _describe_wrong_part(name: str) -> str:
    if name == CAMERA_PREFIX:
        return f"the part {name!r} names no camera, want 'cameras.<name>'"
    if name.startswith(CAMERA_PREFIX):
        return (
            f"the part {name[:80]!r} is text, want a file: send it with a filename, as curl -F "
            f"{name[:80]}=@FILE does"
        )
    return f"unknown part {name[:80]!r}, want 'obs' and files 'cameras.<name>'"


def _require_uncompressed(http: HttpRequest) -> None:
    coding = headers_of(http.scope).get("content-encoding", "identity").strip().lower()
    if coding not in ("", "identity"):
        raise MalformedMessage(
            f"content-encoding: got {coding[:40]!r}, want none; send the body as it is (images are "
            "compressed already)"
        )


def headers_of(scope: Scope) -> dict[str, str]:
    """Return the headers of a request by lower-case name, decoded once; of equal names the last
    one counts.
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
    """Return the session id, which every request must have in its header; raise
    `MalformedMessage` without one.
    """
    name = headers_of(http.scope).get(SESSION_HEADER, "")
    if not name or not is_name(name):
        raise MalformedMessage(
            f"header {SESSION_HEADER}: got {name[:40]!r}, want 1 to 128 visible ASCII characters; "
            f"choose one for each robot or env and send it with every request"
        )
    return name


def _deadline_ms(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < MOST_DEADLINE_MS:
        raise MalformedMessage(
            f"header {DEADLINE_HEADER}: got {text[:40]!r}, want milliseconds above 0 and below "
            f"{MOST_DEADLINE_MS:g}"
        )
    return value


def _step(text: str) -> int:
    if not text.isdecimal() or len(text) > 19:
        raise MalformedMessage(
            f"header {STEP_HEADER}: got {text[:40]!r}, want what the last answer's header says"
        )
    return int(text)


def request_id(http: HttpRequest) -> str:
    """Return the request id from the caller or, without one, from Serve, which returns it in a
    header.
    """
    return valid_request_id(headers_of(http.scope).get(REQUEST_ID_HEADER, ""))


def valid_request_id(header: str) -> str:
    """Return the request id of a header, or a new one if the header is empty, invalid, or could
    forge a log line.
    """
    return header if header and is_name(header) else uuid.uuid4().hex


async def answer_error(http: HttpRequest, error: Exception) -> Response:
    """Answer a request whose handler has raised an error of this package."""
    return problem_response(cast(VLAgentsError, error), request_id(http))


async def deny(socket: WebSocket, error: VLAgentsError) -> None:
    """Refuse a WebSocket before it is accepted, with the error as an HTTP response if the server
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


def public_problem(error: Exception, operation: str, request_id: str) -> VLAgentsError:
    """Return the error that a client may see; details of an unexpected error are only logged."""
    if isinstance(error, VLAgentsError):
        return error
    logger.error("%s failed (request %s)", operation, request_id, exc_info=error)
    return VLAgentsError("internal error; the server's log has the details")


def problem_response(error: VLAgentsError, request_id: str, status: int | None = None) -> Response:
    """Return the problem document of an error, with the status of the error unless another is
    given.
    """
    document = problem(error, request_id)
    if status is not None:
        document["status"] = status
    response = JSONResponse(document, status_code=document["status"], media_type=PROBLEM_TYPE)
    if isinstance(error, TooManyRequests | Overloaded | PolicyUnavailable):
        response.headers["retry-after"] = str(max(1, math.ceil(error.retry_after_s)))
    return response
