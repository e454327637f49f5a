"""openpi's clients over WebSocket: requests and replies are binary maps, and the server sends the first message.

RoboArena's clients (`roboarena/`) use nearly the same protocol and also connect to the root. Both dialects may be on:
RoboArena's requests name an `endpoint`, openpi's do not. The first message is then RoboArena's configuration, which
openpi's client takes for metadata.

An error is a text with a request id, after which the connection is closed (1011) except for 429; openpi's own server
sends a traceback.
"""

from __future__ import annotations

import abc
import asyncio
import time
import uuid
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

from pydantic import Field
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import MalformedMessage, TooManyRequests
from vlagents_ray.protocol.messages import Reply
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects.base import (
    INTERNAL_ERROR,
    RouteDialect,
    Stream,
    accept_or_refuse,
    decoded,
    public_problem,
)
from vlagents_ray.serve.dialects.implicit_session import ImplicitSession
from vlagents_ray.serve.dialects.openpi import codec
from vlagents_ray.serve.dialects.openpi.presets import PRESETS
from vlagents_ray.serve.engine.dispatch import Dispatcher
from vlagents_ray.serve.engine.metrics_buffer import RequestTrace


class MapDialect(RouteDialect):
    """A dialect whose messages are maps in openpi's encoding; all such dialects share the server's root."""

    root = "openpi"

    async def stream(self, socket: WebSocket) -> None:
        """Serve one connection at this dialect's path."""
        await MapEndpoint([self]).stream(socket)

    def at_root(self, sharing: Sequence[MapDialect]) -> Stream:
        return MapEndpoint(sharing).stream

    @abc.abstractmethod
    def first(self) -> dict[str, Any]:
        """Return the message that a client gets when it connects."""

    @abc.abstractmethod
    def speaks(self, message: dict[str, Any]) -> bool:
        """Return whether a message comes from a client of this dialect."""

    def begins(self, message: dict[str, Any], connection: MapConnection) -> str | None:
        """Begin an episode if the message requires it; return the reply if the message is not an observation."""
        return None

    def answer(self, reply: Reply, before_ms: float | None) -> Any:
        """Return the reply in the client's format; `before_ms` is the server's time for the previous observation."""
        infer_ms = reply.timing["queue_ms"] + reply.timing["inference_ms"]
        server = {"infer_ms": infer_ms} | ({} if before_ms is None else {"prev_total_ms": before_ms})
        return {
            "actions": self.rows(reply),
            "policy_timing": {"infer_ms": reply.timing["inference_ms"]},
            "server_timing": server,
        }


class OpenPiDialectConfig(DialectConfig):
    """The settings of `openpi-client`, over WebSocket."""

    mapping: MappingSetting  # each of openpi's robots has different keys, so there is no default
    metadata: dict[str, Any] = Field(
        default_factory=dict, description="added to what the client is sent first, such as reset_pose"
    )


class OpenPiDialect(MapDialect):
    """openpi's protocol: a session begins with the connection, and an episode with each new prompt."""

    Config = OpenPiDialectConfig
    clients = "openpi"
    summary = (
        "A session is the connection; an episode begins with each new prompt. An error is a text, then close 1011."
    )
    paths: ClassVar[Mapping[str, str]] = {"WS /openpi": "stream"}
    presets = PRESETS
    config: OpenPiDialectConfig

    def first(self) -> dict[str, Any]:
        known = self.context.metadata()
        return {key: known.get(key) for key in ("policy", "checkpoint", "version")} | self.config.metadata

    def speaks(self, message: dict[str, Any]) -> bool:
        return "endpoint" not in message


class MapConnection:
    """The state of one dialect on a connection, with its session."""

    def __init__(self, dialect: MapDialect) -> None:
        self.dialect = dialect
        self.sender: Dispatcher = dialect.sender()
        self.session: ImplicitSession = dialect.session(self.sender)
        self.episode: str | None = None  # the client's name of the episode
        self._before_ms: float | None = None

    async def answer(self, message: dict[str, Any], trace: RequestTrace, request_id: str) -> bytes | str:
        """Return the reply to one message."""
        if (answer := self.dialect.begins(message, self)) is not None:
            return answer
        obs, prompt = self.dialect.read(message)
        if not self.session.episode.begun:
            self.dialect.mapping.warn_of_unread_cameras(message, self.dialect.name)
        trace.decoded_alike()
        reply = await self.session.act(obs, prompt, request_id)
        data = trace.written(reply, lambda: codec.encode(self.dialect.answer(reply, self._before_ms)))
        self._before_ms = (time.perf_counter() - trace.arrived) * 1e3
        return data


class MapEndpoint:
    """A path at which clients of these dialects connect; the last dialect sends the first message."""

    def __init__(self, dialects: Sequence[MapDialect]) -> None:
        self._dialects = dialects
        self._context = dialects[0].context

    async def stream(self, socket: WebSocket) -> None:
        """Serve one connection; its sessions end with it."""
        if not await accept_or_refuse(socket, self._context):
            return
        connections: dict[str, MapConnection] = {}
        gate = self._dialects[0].gate()
        try:
            await socket.send_bytes(codec.encode(self._dialects[-1].first()))
            while True:
                event = await socket.receive()
                if event["type"] == "websocket.disconnect":
                    return
                if not await self._answer(socket, event.get("bytes"), connections, gate):
                    return
        except WebSocketDisconnect:
            return
        finally:
            for connection in connections.values():
                connection.sender.release(for_good=True)

    async def _answer(
        self, socket: WebSocket, data: bytes | None, connections: dict[str, MapConnection], gate: Dispatcher
    ) -> bool:
        """Reply to one message; return False if the connection was closed."""
        trace, request_id = self._dialects[0].trace(), uuid.uuid4().hex
        admission = gate.admission(self._context.limits, 0 if data is None else len(data), self._dialects[0].rank)
        try:
            if data is None:
                raise MalformedMessage("message: got text, want a binary map")
            message = await decoded(lambda data, budget: codec.decode(data, budget.limits), data, admission)
            dialect = next((dialect for dialect in self._dialects if dialect.speaks(message)), self._dialects[0])
            arrived, trace = trace.arrived, dialect.trace()
            trace.arrived = arrived
            connection = connections.get(dialect.name) or connections.setdefault(dialect.name, MapConnection(dialect))
            answer = await connection.answer(message, trace, request_id)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            problem = public_problem(error, trace.transport, request_id)
            trace.refused(problem.code)
            await socket.send_text(f"{problem} (request {request_id})")
            if isinstance(problem, TooManyRequests):  # the connection stays open, as the message was not read
                await asyncio.sleep(gate.throttled_s())
                return True
            await socket.close(INTERNAL_ERROR, "Internal server error.")
            return False
        finally:
            admission.release()
        if isinstance(answer, str):
            await socket.send_text(answer)
        else:
            await socket.send_bytes(answer)
        return True
