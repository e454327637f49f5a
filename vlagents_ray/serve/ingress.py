"""The robots' door: HTTP and WebSocket on one port, as an ASGI application over an engine.

    POST /v1/reset, /v1/act, /v1/close   multipart/form-data, application/json, or one binary frame
    POST /v1/probe                       answered at once, for measuring the link
    WS   /v1/stream                      sessions that end with the connection; binary frames or probes
    GET  /healthz, /v1/metadata, /docs

Errors over HTTP are problem+json with a stable code; over WebSocket they are reply frames.
"""

from __future__ import annotations

import logging
import time
import uuid
from collections.abc import Awaitable, Callable, Sequence
from typing import Any, cast

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import Message
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import MalformedMessage, PolicyUnavailable, UnknownApp, VLAgentsError
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.docs import docs_page
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.problems import problem_response
from vlagents_ray.serve.reading import Requests, request_id, session_id
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire.frames import CONTENT_TYPE, encode_replies
from vlagents_ray.wire.messages import (
    MACHINE_HEADER,
    OPS,
    Limits,
    Op,
    Reply,
    Request,
)
from vlagents_ray.wire.probe import answer, is_probe, probed_frame

logger = logging.getLogger(__name__)

_TRY_AGAIN_LATER = 1013  # a WebSocket close code


def build_ingress(
    engine: Engine,
    metadata: Callable[[], dict[str, Any]],
    limits: Limits,
    near: Callable[[str], Awaitable[dict[str, Any]]] | None = None,
    dialects: Sequence[BaseRoute] = (),
) -> Starlette:
    """The ASGI application of a replica; `near` gives the metadata for a caller on the machine with that boot id.

    `dialects` are the routes of other systems' clients, see `vlagents_ray.serve.dialects`.
    """
    door = _Door(engine, metadata, limits, near)
    return Starlette(
        routes=[
            *(Route(f"/v1/{op}", door.endpoint(op), methods=["POST"]) for op in OPS),
            Route("/v1/probe", door.probe, methods=["POST"]),
            WebSocketRoute("/v1/stream", door.stream),
            Route("/v1/metadata", door.show_metadata),
            Route("/healthz", door.health),
            Route("/docs", door.docs),
            *dialects,
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
        self._requests = Requests(limits)
        self._near = near

    async def health(self, http: HttpRequest) -> Response:
        """Asks for no key, so it tells nothing else."""
        if self._engine.ready:
            return PlainTextResponse("OK\n")
        unready = PolicyUnavailable("the policy is loading, or did not load; GET /v1/metadata says which")
        return problem_response(unready, request_id(http))

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
            return Response(await self._probed(await self._requests.body(http)), media_type="application/octet-stream")
        except ClientDisconnect:
            return Response(status_code=499)
        except VLAgentsError as error:
            return problem_response(error, request_id(http))

    async def _probed(self, message: bytes) -> bytes:
        frame = probed_frame(message)
        return answer(message, () if frame is None else await self._requests.decode(frame))

    def _when_ready(self, http: HttpRequest, answer: Callable[[], Response]) -> Response:
        try:
            self._engine.require_ready()
        except VLAgentsError as error:
            return problem_response(error, request_id(http), 503)
        return answer()

    def endpoint(self, op: Op) -> Callable[[HttpRequest], Awaitable[Response]]:
        """The handler of `POST /v1/<op>`."""

        async def handle(http: HttpRequest) -> Response:
            visit = Visit(self._engine.stats, "http", op)
            name = request_id(http)
            try:
                sender = Sender(self._engine, "http", session_id(http), connected=False)
                requests = await self._requests.read(op, _timed(http, visit))
                visit.decoded(requests)
                if isinstance(requests[0], Request):
                    name = requests[0].request_id = requests[0].request_id or name
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
                    logger.exception("%s failed (request %s)", op, name)
                    error = VLAgentsError("internal error; the server's log has the details")
                visit.refused(error.code)
                return problem_response(error, name)

        return handle

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
            requests = await self._requests.decode(frame)
            visit.decoded(requests)
            return await sender.ask(requests)
        except VLAgentsError as error:
            return [Reply(error=error)]
        except Exception:
            name = uuid.uuid4().hex
            logger.exception("stream failed (request %s)", name)
            return [Reply(name, error=VLAgentsError("internal error; the server's log has the details"))]


def _timed(http: HttpRequest, visit: Visit) -> HttpRequest:
    """The request, whose visit begins when its body is here: how long that took is the network's."""

    async def receive() -> Message:
        message = await http.receive()
        visit.arrived = time.perf_counter()
        return message

    return HttpRequest(http.scope, receive)


async def _http_problem(http: HttpRequest, error: Exception) -> Response:
    """What the router refuses: an unknown path, or a method that a path does not take."""
    refused = cast(HTTPException, error)
    if refused.status_code == 404:
        return problem_response(UnknownApp("no such path; GET /docs lists what there is"), request_id(http))
    cause = MalformedMessage(f"{refused.detail}; GET /docs lists what there is")
    response = problem_response(cause, request_id(http), refused.status_code)
    response.headers.update(refused.headers or {})
    return response
