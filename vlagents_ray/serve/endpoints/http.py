"""The HTTP endpoint: HTTP and WebSocket on one port, as an ASGI application over an engine.

    POST /v1/reset, /v1/act, /v1/close   multipart/form-data, application/json, or one binary frame
    WS   /v1/stream                      binary frames or probes; sessions end with the connection
    GET  /healthz, /v1/metadata, /docs

Errors over HTTP are problem+json with a stable code; over WebSocket they are reply frames.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast

from starlette.applications import Starlette
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import JSONResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import MalformedMessage, PolicyUnavailable, UnknownApp, VLAgentsError
from vlagents_ray.protocol import messages
from vlagents_ray.protocol.frames import encode_replies
from vlagents_ray.protocol.json_messages import plain_values
from vlagents_ray.serve.access.api_keys import current_caller
from vlagents_ray.serve.access.charges import current_charge
from vlagents_ray.serve.endpoints import http_messages
from vlagents_ray.serve.endpoints.asgi_websocket import SCOPE_KEY as WEBSOCKET
from vlagents_ray.serve.endpoints.asgi_websocket import AsgiWebSocket
from vlagents_ray.serve.endpoints.charged_messages import ChargedMessage, ChargedMessages
from vlagents_ray.serve.endpoints.client_socket import current_client
from vlagents_ray.serve.endpoints.docs_page import STYLE, docs_page
from vlagents_ray.serve.endpoints.request_stream import RequestStream, StreamForms
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender, message_admission
from vlagents_ray.serve.requests import IncomingMessage

_TRY_AGAIN_LATER = 1013  # WebSocket close code
_HEALTH_S = 1.5  # `/healthz` replies within this time
_NO_PATH = "no such path; GET /docs lists what there is"


def build_http_app(
    engine: Engine,
    metadata: Callable[[], dict[str, Any]],
    limits: messages.MessageLimits,
    machine_metadata: Callable[[str], Awaitable[dict[str, Any]]] | None = None,
    more: Sequence[BaseRoute] = (),
    direct: messages.StreamAddress | None = None,
) -> Starlette:
    """Build the ASGI application of a replica.

    It must run behind a `vlagents_ray.serve.endpoints.access_middleware.AccessMiddleware`, which
    identifies the caller of each request: without one, requests fail.

    Args:
        metadata: Returns the document of `GET /v1/metadata`.
        machine_metadata: Returns the metadata for a caller on the machine with the given boot id.
        more: The routes of dialects and of parts, see `vlagents_ray.serve.dialects` and
            `vlagents_ray.serve.replica.part`.
        direct: The replica's own port, whose address is in the answers to reset and act; None if
            clients of this application may not use it.
    """
    server = _HttpEndpoint(engine, metadata, limits, machine_metadata, direct)

    app = Starlette(
        routes=[
            *(Route(f"/v1/{op}", server.endpoint(op), methods=["POST"]) for op in messages.OPS),
            WebSocketRoute("/v1/stream", server.stream),
            Route("/v1/metadata", server.show_metadata),
            Route("/healthz", server.health),
            Route("/docs", server.docs),
            *more,
        ],
        exception_handlers={
            HTTPException: _http_problem,
            VLAgentsError: http_messages.answer_error,
        },
    )
    app.router.redirect_slashes = False  # many clients drop the body of a redirected POST
    app.router.default = partial(_refuse_path, app.router.default)
    return app


@dataclass(frozen=True, slots=True)
class _HttpEndpoint:
    engine: Engine
    metadata: Callable[[], dict[str, Any]]
    limits: messages.MessageLimits
    machine_metadata: Callable[[str], Awaitable[dict[str, Any]]] | None
    direct: messages.StreamAddress | None

    async def health(self, http: HttpRequest) -> Response:
        """Reply whether the policy is ready, or which step of loading it has reached. This path
        needs no key, so the reply contains nothing else.
        """
        try:
            ready = await asyncio.wait_for(
                asyncio.to_thread(lambda: self.engine.health.ready), _HEALTH_S
            )
        except asyncio.TimeoutError:  # the policy's own check hangs
            ready = False
        if ready:
            return PlainTextResponse("OK\n")

        step = self.engine.model.step
        suffix = f" ({step})" if step else ""
        loading = f"the policy is loading{suffix}"
        unready = PolicyUnavailable(f"{loading}, or did not load; GET /v1/metadata says which")
        return http_messages.problem_response(unready, http_messages.request_id(http))

    async def show_metadata(self, http: HttpRequest) -> Response:
        """Reply with the metadata, or with the metadata for a caller on the machine that the
        request names.
        """
        machine = http.headers.get(messages.MACHINE_HEADER)
        if machine and self.machine_metadata is not None and self.engine.health.ready:
            return JSONResponse(plain_values(await self.machine_metadata(machine)))
        return self._when_ready(http, lambda: JSONResponse(plain_values(self.metadata())))

    async def docs(self, http: HttpRequest) -> Response:
        """Reply with the page that describes this server to its clients."""
        return self._when_ready(
            http, lambda: http_messages.html_response(docs_page(self.metadata()), styles=[STYLE])
        )

    def _when_ready(self, http: HttpRequest, answer: Callable[[], Response]) -> Response:
        try:
            self.engine.health.require_ready()
        except VLAgentsError as error:
            return http_messages.problem_response(error, http_messages.request_id(http), 503)
        return answer()

    def endpoint(self, op: messages.Op) -> Callable[[HttpRequest], Awaitable[Response]]:
        """Return the handler of `POST /v1/<op>`."""

        stats = self.engine.stats

        async def handle(http: HttpRequest) -> Response:
            """Decode the requests of the body, submit them, and reply with the answers."""
            charge = current_charge()
            incoming = IncomingMessage("http", op, charge=charge)
            request_id = http_messages.request_id(http)
            headers = http_messages.headers_of(http.scope)
            try:
                session_id = http_messages.session_id(http)
                sender = Sender(
                    self.engine,
                    "http",
                    session_id,
                    caller=current_caller(),
                    has_left=current_client(),
                    connected=False,
                    # A JSON document cannot request a reconnection. If a replica joins, HAProxy's
                    # hash of the session leads such a client to it.
                    can_move=http_messages.accepts_frames(headers),
                )
                priority = headers.get(messages.PRIORITY_HEADER, "robot")
                admission = message_admission(self.engine, charge, self.limits, priority=priority)

                decoded = await http_messages.read_requests(
                    op, _timed(http, incoming), admission, request_id
                )
                incoming.decoded(decoded)
                if decoded.requests:
                    request_id = decoded.requests[0].request_id

                await sender.ask(incoming, decoded, admission)
                response = http_messages.response_to(incoming, headers)
                if self.direct is not None and op != "close":
                    http_messages.add_link(response, self.direct, op, headers)
                stats.record(incoming)
            except ClientDisconnect:
                stats.record_failure(incoming, "disconnected")
                return Response(status_code=499)
            except Exception as failure:  # noqa: BLE001 - the error is the reply to the client
                problem = http_messages.public_problem(failure, op, request_id)
                stats.record_failure(incoming, problem.code)
                return http_messages.problem_response(problem, request_id)
            return response

        return handle

    async def stream(self, socket: WebSocket) -> None:
        """Serve one WebSocket, whose sessions end with it; a malformed request gets an error and
        affects no session.
        """
        if len(self.engine.sessions) >= self.engine.sessions.limit:
            full = self.engine.sessions.full()
            await socket.accept()
            await socket.send_bytes(encode_replies([messages.Reply(error=full)]))
            await socket.close(_TRY_AGAIN_LATER, str(full)[:120])
            return

        websocket: AsgiWebSocket | None = socket.scope.get(WEBSOCKET)
        if websocket is None:
            await self._stream_forwarded(socket)
            return
        caller = current_caller()
        await websocket.serve(
            lambda connection: RequestStream(connection, self.engine, self.limits, caller)
        )

    async def _stream_forwarded(self, socket: WebSocket) -> None:
        """Serve a WebSocket whose messages another process forwards."""
        caller = current_caller()
        sender = Sender(
            self.engine, "websocket", caller=caller, has_left=current_client(), can_move=True
        )
        forms = StreamForms(self.limits)
        await socket.accept()
        try:
            async with ChargedMessages(socket, caller) as arriving:
                async for message in arriving:
                    await socket.send_bytes(await self._answer(sender, forms, message))
        except WebSocketDisconnect:
            return
        finally:
            sender.release()

    async def _answer(self, sender: Sender, forms: StreamForms, message: ChargedMessage) -> bytes:
        """Return the answer to a message of a forwarded WebSocket, or to a probe."""
        frame, charge = message
        incoming = sender.message(charge)
        admission = message_admission(self.engine, charge, self.limits, message.size)
        if frame is not None and messages.is_probe(frame):
            try:
                messages.read_probe(frame, admission)
                return messages.probe_answer(len(frame))
            except VLAgentsError as error:
                return encode_replies([messages.Reply(error=error)])

        try:
            admission.begin_message()
            if frame is None:
                raise MalformedMessage("stream: expected a binary message, got a text")
            decoded = await admission.decoded(partial(forms.decode, frame))
            incoming.decoded(decoded)
            await sender.ask(incoming, decoded, admission)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            request_id = "" if isinstance(error, VLAgentsError) else uuid.uuid4().hex
            problem = http_messages.public_problem(error, "stream", request_id)
            incoming.refuse(problem, request_id)
        data = forms.encode(incoming)
        self.engine.stats.record(incoming)
        return data


def _timed(http: HttpRequest, incoming: IncomingMessage) -> HttpRequest:
    """Return a request whose times start when its body has arrived, so that the upload counts as
    network time.
    """

    async def receive() -> Message:
        message = await http.receive()
        incoming.arrived = time.perf_counter()
        return message

    return HttpRequest(http.scope, receive)


async def _refuse_path(refuse_http: ASGIApp, scope: Scope, receive: Receive, send: Send) -> None:
    """Reject an unknown path: Starlette would reject a WebSocket with 403, which means an
    invalid key.
    """
    if scope["type"] == "websocket":
        await http_messages.deny(WebSocket(scope, receive, send), UnknownApp(_NO_PATH))
    else:
        await refuse_http(scope, receive, send)


async def _http_problem(http: HttpRequest, error: Exception) -> Response:
    """Reply to a request that the router rejects: an unknown path, or an unsupported method."""
    refused = cast(HTTPException, error)
    if refused.status_code == 404:
        return http_messages.problem_response(UnknownApp(_NO_PATH), http_messages.request_id(http))
    cause = MalformedMessage(f"{refused.detail}; GET /docs lists what there is")
    response = http_messages.problem_response(
        cause, http_messages.request_id(http), refused.status_code
    )
    response.headers.update(refused.headers or {})
    return response
