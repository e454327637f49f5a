"""The robots' door: HTTP and WebSocket on one port, as an ASGI application over an engine.

    POST /v1/reset, /v1/act, /v1/close   multipart/form-data, application/json, or one binary frame
    POST /v1/probe                       answered at once, for measuring the link
    WS   /v1/stream                      sessions that end with the connection; binary frames or probes
    GET  /healthz, /v1/metadata, /docs

Errors over HTTP are problem+json with a stable code; over WebSocket they are reply frames.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
import uuid
from collections.abc import Awaitable, Callable
from typing import Any, cast

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException
from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.types import Message
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, PolicyUnavailable, UnknownApp, VLAgentsError
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.docs import docs_page
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire.frames import CONTENT_TYPE, check_request, decode_requests, encode_replies
from vlagents_ray.wire.messages import (
    DEADLINE_HEADER,
    MACHINE_HEADER,
    OPS,
    RANK_HEADER,
    REQUEST_ID_HEADER,
    SESSION_HEADER,
    Limits,
    Op,
    RankName,
    Reply,
    Request,
)
from vlagents_ray.wire.plain import CAMERA_PREFIX, PROBLEM_TYPE, problem, request_from_parts
from vlagents_ray.wire.probe import answer, is_probe, probed_frame

logger = logging.getLogger(__name__)

_SESSION_ID = re.compile(r"[\x21-\x7e]{1,128}")
_TRY_AGAIN_LATER = 1013  # a WebSocket close code
_INLINE_BYTES = 512 * 1024  # a larger body is decoded beside the event loop, which others wait for


def build_ingress(
    engine: Engine,
    metadata: Callable[[], dict[str, Any]],
    limits: Limits,
    near: Callable[[str], Awaitable[dict[str, Any]]] | None = None,
) -> Starlette:
    """The ASGI application of a replica; `near` gives the metadata for a caller on the machine with that boot id."""
    door = _Door(engine, metadata, limits, near)
    return Starlette(
        routes=[
            *(Route(f"/v1/{op}", door.endpoint(op), methods=["POST"]) for op in OPS),
            Route("/v1/probe", door.probe, methods=["POST"]),
            WebSocketRoute("/v1/stream", door.stream),
            Route("/v1/metadata", door.show_metadata),
            Route("/healthz", door.health),
            Route("/docs", door.docs),
        ],
        exception_handlers={HTTPException: _http_problem},
    )


class _Door:
    def __init__(
        self,
        engine: Engine,
        metadata: Callable[[], dict[str, Any]],
        limits: Limits,
        near: Callable[[str], Awaitable[dict[str, Any]]] | None,
    ) -> None:
        self._engine = engine
        self._metadata = metadata
        self._limits = limits
        self._near = near

    async def health(self, http: HttpRequest) -> Response:
        return self._when_ready(http, lambda: PlainTextResponse("OK\n"))

    async def show_metadata(self, http: HttpRequest) -> Response:
        machine = http.headers.get(MACHINE_HEADER)
        if machine and self._near is not None and self._engine.ready:
            return JSONResponse(await self._near(machine))
        return self._when_ready(http, lambda: JSONResponse(self._metadata()))

    async def docs(self, http: HttpRequest) -> Response:
        return self._when_ready(http, lambda: HTMLResponse(docs_page(self._metadata())))

    async def probe(self, http: HttpRequest) -> Response:
        """Neither a session nor the policy hears of it."""
        try:
            return Response(await self._probed(await self._body(http)), media_type="application/octet-stream")
        except ClientDisconnect:
            return Response(status_code=499)
        except VLAgentsError as error:
            return _problem(error, _request_id(http))

    async def _probed(self, message: bytes) -> bytes:
        if (frame := probed_frame(message)) is not None:
            for request in await self._decode(frame):
                if isinstance(request, Reply) and request.error is not None:
                    raise request.error
        return answer(message)

    def _when_ready(self, http: HttpRequest, answer: Callable[[], Response]) -> Response:
        try:
            self._engine.require_ready()
        except VLAgentsError as error:
            document = problem(error, _request_id(http)) | {"status": 503}
            return JSONResponse(document, status_code=503, media_type=PROBLEM_TYPE)
        return answer()

    def endpoint(self, op: Op) -> Callable[[HttpRequest], Awaitable[Response]]:
        """The handler of `POST /v1/<op>`."""

        async def handle(http: HttpRequest) -> Response:
            visit = Visit(self._engine.stats, "http", op)
            request_id = _request_id(http)
            try:
                sender = Sender(self._engine, "http", _session_id(http), connected=False)
                requests = await self._read(op, _timed(http, visit))
                visit.decoded(requests)
                if isinstance(requests[0], Request):
                    request_id = requests[0].request_id = requests[0].request_id or request_id
                replies = await sender.ask(requests)
                if len(replies) == 1 and (error := replies[0].error) is not None:
                    raise error
                if CONTENT_TYPE in http.headers.get("accept", "") or len(replies) > 1:
                    return Response(visit.frame(replies), media_type=CONTENT_TYPE)
                return Response(visit.document(replies[0]), media_type="application/json")
            except ClientDisconnect:
                visit.refused("disconnected")
                return Response(status_code=499)
            except Exception as error:
                if not isinstance(error, VLAgentsError):
                    logger.exception("%s failed (request %s)", op, request_id)
                    error = VLAgentsError("internal error; the server's log has the details")
                visit.refused(error.code)
                return _problem(error, request_id)

        return handle

    async def _read(self, op: Op, http: HttpRequest) -> list[Request | Reply]:
        kind = http.headers.get("content-type", "").partition(";")[0].strip().lower()
        declared = http.headers.get("content-length", "")
        if declared.isdigit() and int(declared) > self._limits.body_bytes:
            raise MessageTooLarge(f"body: declares {declared} bytes, the limit is {self._limits.body_bytes}")
        if kind == "multipart/form-data":
            request = await self._read_form(op, http)
        elif op == "close" and not kind:
            request = Request("close")
        else:
            body = await self._body(http)
            if kind == CONTENT_TYPE:
                return self._checked(op, await self._decode(body), http)
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
            async with http.form(
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
            text = error.message if isinstance(error, MultiPartException) else error.detail
            raise MalformedMessage(f"form: {text}") from error
        if document is None:
            raise MalformedMessage("form: no part 'obs'; send a JSON document, {} at least")
        if sum(map(len, files.values())) > _INLINE_BYTES:
            return await asyncio.to_thread(request_from_parts, op, document, files, limits)
        return request_from_parts(op, document, files, limits)

    async def _body(self, http: HttpRequest) -> bytes:
        chunks: list[bytes] = []
        size = 0
        async for chunk in http.stream():
            size += len(chunk)
            if size > self._limits.body_bytes:
                raise MessageTooLarge(f"body: over {self._limits.body_bytes} bytes, the limit")
            chunks.append(chunk)
        return b"".join(chunks)

    async def _decode(self, frame: bytes) -> list[Request | Reply]:
        if len(frame) > _INLINE_BYTES:
            return await asyncio.to_thread(decode_requests, frame, self._limits)
        return decode_requests(frame, self._limits)

    async def stream(self, socket: WebSocket) -> None:
        """Sessions that end with the connection; a broken request is answered and leaves them as they were."""
        await socket.accept()
        if len(self._engine.sessions) >= self._engine.sessions.limit:
            full = PolicyUnavailable(f"this replica holds {len(self._engine.sessions)} sessions, its limit")
            await socket.send_bytes(encode_replies([Reply(error=full)]))
            await socket.close(_TRY_AGAIN_LATER)
            return
        sender = Sender(self._engine, "websocket")
        try:
            while True:
                message = await socket.receive()
                if message["type"] == "websocket.disconnect":
                    return
                await socket.send_bytes(await self._reply_to(sender, message.get("bytes")))
        except WebSocketDisconnect:
            return
        finally:
            sender.release()

    async def _reply_to(self, sender: Sender, message: bytes | None) -> bytes:
        if message is None or not is_probe(message):
            visit = Visit(self._engine.stats, "websocket")
            return visit.frame(await self._answer(sender, message, visit))
        try:
            return await self._probed(message)
        except VLAgentsError as error:
            return encode_replies([Reply(error=error)])

    async def _answer(self, sender: Sender, frame: bytes | None, visit: Visit) -> list[Reply]:
        try:
            if frame is None:
                raise MalformedMessage("stream: got a text message, want a binary frame")
            requests = await self._decode(frame)
            visit.decoded(requests)
            return await sender.ask(requests)
        except VLAgentsError as error:
            return [Reply(error=error)]
        except Exception:
            request_id = uuid.uuid4().hex
            logger.exception("stream failed (request %s)", request_id)
            return [Reply(request_id, error=VLAgentsError("internal error; the server's log has the details"))]


def _timed(http: HttpRequest, visit: Visit) -> HttpRequest:
    """The request, whose visit begins when its body is here: how long that took is the network's."""

    async def receive() -> Message:
        message = await http.receive()
        visit.arrived = time.perf_counter()
        return message

    return HttpRequest(http.scope, receive)


def _session_id(http: HttpRequest) -> str:
    session_id = http.headers.get(SESSION_HEADER, "")
    if not _SESSION_ID.fullmatch(session_id):
        raise MalformedMessage(
            f"header {SESSION_HEADER}: got {session_id[:40]!r}, want 1 to 128 visible ASCII characters; "
            f"choose one for each robot or env and send it with every request"
        )
    return session_id


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < 1e9:
        raise MalformedMessage(f"header {DEADLINE_HEADER}: got {text[:40]!r}, want a positive number of milliseconds")
    return value


def _request_id(http: HttpRequest) -> str:
    """The caller's, or the one that Serve gave the request; Serve sends either back as a header."""
    return http.headers.get(REQUEST_ID_HEADER) or uuid.uuid4().hex


def _problem(error: VLAgentsError, request_id: str) -> Response:
    return JSONResponse(problem(error, request_id), status_code=error.status, media_type=PROBLEM_TYPE)


async def _http_problem(http: HttpRequest, error: Exception) -> Response:
    """What the router refuses: an unknown path, or a method that a path does not take."""
    refused = cast(HTTPException, error)
    if refused.status_code == 404:
        return _problem(UnknownApp("no such path; GET /docs lists what there is"), _request_id(http))
    cause = MalformedMessage(f"{refused.detail}; GET /docs lists what there is")
    document = problem(cause, _request_id(http)) | {"status": refused.status_code}
    return JSONResponse(document, status_code=refused.status_code, media_type=PROBLEM_TYPE, headers=refused.headers)
