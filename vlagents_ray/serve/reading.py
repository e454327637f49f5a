"""Requests out of HTTP: forms, JSON documents and frames, under the limits of the deployment."""

from __future__ import annotations

import asyncio
import re
import uuid
from typing import cast

from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException
from starlette.requests import Request as HttpRequest
from starlette.types import Message, Receive

from vlagents_ray.errors import MalformedMessage, MessageTooLarge
from vlagents_ray.wire.frames import CONTENT_TYPE, check_request, decode_requests
from vlagents_ray.wire.messages import (
    DEADLINE_HEADER,
    RANK_HEADER,
    REQUEST_ID_HEADER,
    SESSION_HEADER,
    Limits,
    Op,
    RankName,
    Reply,
    Request,
)
from vlagents_ray.wire.plain import CAMERA_PREFIX, request_from_parts

_SESSION_ID = re.compile(r"[\x21-\x7e]{1,128}")
INLINE_BYTES = 512 * 1024  # a larger body is decoded beside the event loop, which others wait for


class _TooLong(MultiPartException):
    """A form, of which the parser then closes the files."""


class Requests:
    """Reads them; what is wrong with a whole body is raised."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits

    async def read(self, op: Op, http: HttpRequest) -> list[Request | Reply]:
        """The requests of a POST to the path of `op`; in place of one that is wrong, the reply that says so."""
        kind = http.headers.get("content-type", "").partition(";")[0].strip().lower()
        declared = http.headers.get("content-length", "")
        if declared.isdigit() and int(declared) > self._limits.body_bytes:
            raise MessageTooLarge(f"body: declares {declared} bytes, the limit is {self._limits.body_bytes}")
        if kind == "multipart/form-data":
            request = await self._read_form(op, http)
        elif op == "close" and not kind:
            request = Request("close")
        else:
            body = await self.body(http)
            if kind == CONTENT_TYPE:
                return self._checked(op, await self.decode(body), http)
            if kind == "application/json":
                request = request_from_parts(op, body, {}, self._limits)
            else:
                raise MalformedMessage(
                    f"content-type: got {kind or 'none'!r}, "
                    f"want multipart/form-data, application/json or {CONTENT_TYPE}"
                )
        return self._checked(op, [request], http)

    def _checked(self, op: Op, requests: list[Request | Reply], http: HttpRequest) -> list[Request | Reply]:
        deadline, rank = http.headers.get(DEADLINE_HEADER), http.headers.get(RANK_HEADER)
        for request in requests:
            if not isinstance(request, Request):
                continue
            if request.op != op:
                raise MalformedMessage(f"op: the frame says {request.op!r}, the path says {op!r}")
            if deadline:
                request.deadline_ms = _positive(deadline)
            if rank:
                request.rank = cast(RankName, rank)
                check_request(request, self._limits)
        return requests

    async def _read_form(self, op: Op, http: HttpRequest) -> Request:
        limits = self._limits
        document: str | bytes | None = None
        files: dict[str, bytes] = {}
        try:
            async with HttpRequest(http.scope, self._limited(http)).form(
                max_files=limits.cameras + 1, max_fields=limits.cameras + 1, max_part_size=limits.body_bytes
            ) as form:
                for name, part in form.multi_items():
                    data = part if isinstance(part, str) else await part.read()
                    if name == "obs":
                        document = data
                    elif name.startswith(CAMERA_PREFIX) and isinstance(data, bytes):
                        files[name.removeprefix(CAMERA_PREFIX)] = data
                    else:
                        raise MalformedMessage(f"form: unknown part {name!r}, want 'obs' and files 'cameras.<name>'")
        except (MultiPartException, HTTPException) as error:
            if isinstance(error, _TooLong) or isinstance(error.__context__, _TooLong):
                raise MessageTooLarge(f"body: over {limits.body_bytes} bytes, the limit") from None
            text = error.message if isinstance(error, MultiPartException) else error.detail
            raise MalformedMessage(f"form: {text}") from error
        if document is None:
            raise MalformedMessage("form: no part 'obs'; send a JSON document, {} at least")
        if sum(map(len, files.values())) > INLINE_BYTES:
            return await asyncio.to_thread(request_from_parts, op, document, files, limits)
        return request_from_parts(op, document, files, limits)

    def _limited(self, http: HttpRequest) -> Receive:
        """What a form's body comes by: the parser has a limit for each part alone, and none for files."""
        size = 0

        async def receive() -> Message:
            nonlocal size
            message = await http.receive()
            size += len(message.get("body", b""))
            if size > self._limits.body_bytes:
                raise _TooLong("body")
            return message

        return receive

    async def body(self, http: HttpRequest) -> bytes:
        """All of it, if it is not over the limit."""
        chunks: list[bytes] = []
        size = 0
        async for chunk in http.stream():
            size += len(chunk)
            if size > self._limits.body_bytes:
                raise MessageTooLarge(f"body: over {self._limits.body_bytes} bytes, the limit")
            chunks.append(chunk)
        return b"".join(chunks)

    async def decode(self, frame: bytes) -> list[Request | Reply]:
        """The requests of a frame."""
        if len(frame) > INLINE_BYTES:
            return await asyncio.to_thread(decode_requests, frame, self._limits)
        return decode_requests(frame, self._limits)


def session_id(http: HttpRequest) -> str:
    """What every request must state in its header."""
    name = http.headers.get(SESSION_HEADER, "")
    if not _SESSION_ID.fullmatch(name):
        raise MalformedMessage(
            f"header {SESSION_HEADER}: got {name[:40]!r}, want 1 to 128 visible ASCII characters; "
            f"choose one for each robot or env and send it with every request"
        )
    return name


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1e9:
        raise MalformedMessage(f"header {DEADLINE_HEADER}: got {text[:40]!r}, want a positive number of milliseconds")
    return value


def request_id(http: HttpRequest) -> str:
    """The caller's, or the one that Serve gave the request; Serve sends either back as a header."""
    return http.headers.get(REQUEST_ID_HEADER) or uuid.uuid4().hex
