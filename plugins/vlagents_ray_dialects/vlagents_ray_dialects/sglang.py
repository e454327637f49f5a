"""SGLang's `/v1/actions`: actions for one or several observations, by HTTP and by WebSocket.

An error over HTTP has its status and a JSON document, whose `detail` SGLang's clients read.
"""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, ClassVar

from starlette.requests import Request as HttpRequest
from starlette.responses import Response
from starlette.routing import BaseRoute, Route
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.protocol.messages import SESSION_HEADER, Budget, Reply
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects import base
from vlagents_ray.serve.endpoints.http_messages import (
    public_problem,
    request_id,
    session_id,
)
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import IncomingMessage
from vlagents_ray_dialects.messages import sglang
from vlagents_ray_dialects.messages.sglang import JSON, MSGPACK, PRESETS, GenerationRequest


class SGLangDialectConfig(DialectConfig):
    """The settings of the clients of SGLang's actions, and of RLinf's rollout worker."""

    mapping: MappingSetting = "sglang"


class SGLangDialect(base.HttpDialect):
    """SGLang's protocol, in which a request names the sessions of its observations, or none."""

    Config = SGLangDialectConfig
    clients = "SGLang's actions and RLinf"
    summary = (
        "Each of `session_ids` is a session; without them a request is an episode, and a WebSocket "
        "a session. `reset_mask` begins an episode, as does a new instruction. An error has its "
        "status and problem+json."
    )
    paths: ClassVar[Mapping[str, str]] = {
        "POST /v1/actions/generations": "generate",
        "WS /v1/actions/realtime": "stream",
    }
    presets = PRESETS
    config: SGLangDialectConfig

    def routes(self) -> list[BaseRoute]:
        metadata = Route("/v1/actions/metadata", self.metadata)
        return [*super().routes(), metadata, Route("/health", self.health)]

    async def metadata(self, _http: HttpRequest) -> Response:
        """Answer with the inputs and outputs of the policy in SGLang's format."""
        return Response(sglang.encode(self._describe(), JSON), media_type=JSON)

    async def generate(self, http: HttpRequest) -> Response:
        """Answer a request with the actions for its observations."""
        sent, accepted = http.headers.get("content-type", ""), http.headers.get("accept", "")
        body_type = MSGPACK if "msgpack" in sent.lower() else JSON
        answer_type = MSGPACK if "msgpack" in f"{sent}{accepted}".lower() else JSON
        name = request_id(http)

        def read(body: bytes, budget: Budget) -> GenerationRequest:
            """Decode the request in a body."""
            payload = sglang.decode(body, body_type, budget)
            return sglang.read_request(payload, answer_type, budget)

        async def act(request: GenerationRequest, message: IncomingMessage) -> bytes:
            """Return the body with the actions for the observations of a request."""
            if SESSION_HEADER in http.headers and not request.session_names:
                request = replace(request, session_names=[session_id(http)])
            sender = self.sender(request.session_names[0] if request.session_names else "")
            try:
                replies = await self._act(request, message, sender, None, name)
            finally:
                sender.release(for_good=True)
            return self.encoded(
                message, lambda: sglang.encode(self._answer(request, replies, name), answer_type)
            )

        return await self.respond(http, read, act, answer_type)

    async def stream(self, socket: WebSocket) -> None:
        """Serve one connection, whose requests are msgpack; its session ends with it."""
        if not await base.accept_or_refuse(socket, self.context):
            return

        connection = _Connection(self)
        try:
            await socket.send_bytes(sglang.encode(self._describe(), MSGPACK))
            await self.answer_messages(socket, connection.answer)
        except WebSocketDisconnect:
            return
        finally:
            connection.sender.release(for_good=True)

    async def _act(
        self,
        request: GenerationRequest,
        message: IncomingMessage,
        sender: Sender,
        own: base.ImplicitSession | None,
        name: str,
    ) -> list[Reply]:
        """Return the policy's replies to the observations of a request.

        Args:
            request: The request.
            message: The message that contains the request.
            sender: The sender of the message.
            own: The session of a connection, which a single observation without a session name
                uses; None if such an observation gets a session for this request only.
            name: The id of the request.
        """
        if message.charge is not None:
            message.charge.cover(len(request.observations))
        contract = self.context.contract
        # The sizes are checked before the policy acts, if the contract is known.
        if contract is not None:
            sglang.require_sizes(request, contract.chunk, contract.action.dim)
        inputs = [self.read(observation) for observation in request.observations]
        message.decoded_alike(len(inputs))

        sessions = await self._sessions(request, sender, own)
        session_inputs = []
        for session, (obs, instruction), begins in zip(
            sessions, inputs, request.begins_episode, strict=True
        ):
            session_inputs.append(base.SessionObs(session, obs, instruction, begins))
        if not sessions[0].episode.begun:
            self.mapping.warn_of_unread_cameras(request.observations[0], self.name)

        def read(reply: Reply) -> None:
            """Raise an error if the client cannot be sent the action of a reply."""
            sglang.trimmed(self.rows(reply), request)

        return await base.act_together(message, session_inputs, name, read)

    async def _sessions(
        self, request: GenerationRequest, sender: Sender, own: base.ImplicitSession | None
    ) -> list[base.ImplicitSession]:
        """Return the session of each observation of a request."""
        if request.session_names:
            names = request.session_names
            if own is not None:
                # Sessions end with their connection, so another connection means another session.
                names = [f"{own.id}/{name}" for name in names]
            # All names are searched for at once: each search takes a tenth of a second.
            searches = []
            for name, begins in zip(names, request.begins_episode, strict=True):
                searches.append(self.client_session(sender, name, begins=begins))
            return await asyncio.gather(*searches)
        if own is not None and not request.is_batch:
            return [own]
        return [self.session(sender, uuid.uuid4().hex) for _ in request.observations]

    def _answer(
        self, request: GenerationRequest, replies: Sequence[Reply], name: str
    ) -> dict[str, Any]:
        """Return the answer to a request, given the policy's replies to its observations."""
        chunks = [sglang.trimmed(self.rows(reply), request) for reply in replies]
        # The chunk of each robot is cut to the length of the shortest chunk.
        fewest_rows = min(len(chunk) for chunk in chunks)
        chunks = [chunk[:fewest_rows] for chunk in chunks]
        timings = {
            "queue_ms": max(reply.timing["queue_ms"] for reply in replies),
            "inference_ms": max(reply.timing["inference_ms"] for reply in replies),
        }
        return sglang.answer(chunks, request, request.request_id or name, self._model(), timings)

    def _model(self) -> str:
        """Return the name of the policy."""
        return str(self.context.metadata().get("policy"))

    def _describe(self) -> dict[str, Any]:
        """Return the metadata of the policy in SGLang's format."""
        contract = self.context.contract
        camera_keys = [camera.key.rpartition("/")[2] for camera in self.mapping.cameras.values()]
        described: dict[str, Any] = {"action_type": "continuous", "dtype": "float32"}
        if contract is not None:
            if "*" in camera_keys:
                camera_keys = list(contract.cameras or {})
            if contract.chunk is not None:
                described["action_horizon"] = contract.chunk
            if contract.action.dim is not None:
                described["action_dim"] = contract.action.dim
                described["padded_action_dim"] = contract.action.dim
        image_keys = [key for key in camera_keys if key != "*"]
        return {
            "object": "action.metadata",
            "model": self._model(),
            "policy_family": self._model(),
            "input": {"image_keys": image_keys} if image_keys else {},
            "output": described,
            "capabilities": {
                "exact_prefix_cache": False,
                "cuda_graph": False,
                "realtime_websocket": True,
                "openpi_websocket": False,
                "batch_inputs": True,
                "multiple_candidates": False,
            },
        }


class _Connection:
    """A WebSocket of a client, with its session.

    Args:
        dialect: The dialect.
    """

    def __init__(self, dialect: SGLangDialect) -> None:
        self.sender: Sender = dialect.sender()
        self._dialect = dialect
        self._session = dialect.session(self.sender)
        self._before_ms: float | None = None  # the server's time for the previous message, ms

    async def answer(
        self, socket: WebSocket, data: bytes | None, admission: MessageAdmission
    ) -> bool:
        """Answer one message; return False if the connection was closed.

        Args:
            socket: The connection.
            data: The message; None for a text.
            admission: The admission of the message, which is released at the end.
        """
        dialect = self._dialect
        message = dialect.arrived(admission.charge)
        name = uuid.uuid4().hex

        def read(body: bytes, budget: Budget) -> GenerationRequest:
            """Decode the request in a message."""
            return sglang.read_request(sglang.decode(body, MSGPACK, budget), MSGPACK, budget)

        try:
            request = await base.decoded(read, data, admission)
            replies = await dialect._act(request, message, self.sender, self._session, name)
            answer = dialect.encoded(
                message, partial(self._encoded, request, replies, message, name)
            )
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            problem = public_problem(error, dialect.name, name)
            dialect.record_failure(message, problem)
            text = f"{problem} (request {name})"
            await socket.send_bytes(sglang.encode({"error": text}, MSGPACK))
            await base.close_after_error(socket, problem)
            return False
        finally:
            admission.release()

        await socket.send_bytes(answer)
        self._before_ms = (time.perf_counter() - message.arrived) * 1e3
        return True

    def _encoded(
        self,
        request: GenerationRequest,
        replies: Sequence[Reply],
        message: IncomingMessage,
        name: str,
    ) -> bytes:
        """Return the answer to a request, with the server's times in the format of SGLang's
        WebSocket.
        """
        body = self._dialect._answer(request, replies, name)
        body["server_timing"] = {"infer_ms": (time.perf_counter() - message.arrived) * 1e3}
        if self._before_ms is not None:
            body["server_timing"]["prev_total_ms"] = self._before_ms
        return sglang.encode(body, MSGPACK)
