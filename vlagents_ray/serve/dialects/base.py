"""The base classes of all dialects, which are other systems' protocols.

A dialect is an `HttpDialect` for plain requests over HTTP, a `RouteDialect` for WebSockets and
anything else on the server's own port, or a `PortDialect` for a protocol that needs its own port.
CONTRIBUTING.md lists the steps to add a dialect. A third-party package registers its dialect with
an entry point in the group `vlagents_ray.dialects`, or a deployment file names the class, as
`my_package:MyDialect`.

The following is a complete dialect, for clients that post `{"q": [...], "task": "..."}` and read a
list of numbers::

    from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
    from vlagents_ray.serve.dialects.base import HttpDialect
    from vlagents_ray.wire import json_numpy


    class PlainConfig(DialectConfig):
        mapping: MappingSetting = {"state": {"joints": "q"}, "instruction": "task"}


    class PlainDialect(HttpDialect):
        Config = PlainConfig
        clients = "the example"
        paths = {"POST /plain": "act"}

        async def act(self, http):
            return await self.answer(http, self.decode, self.encode)

        @staticmethod
        def decode(data, budget):
            return json_numpy.loads(data, budget.limits)

        @staticmethod
        def encode(rows):
            return json_numpy.dumps(rows[0].tolist()).encode()

`tests/serve/dialects/test_third_party.py` runs this example.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
import logging
import socket
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
from starlette.requests import ClientDisconnect
from starlette.requests import Request as HttpRequest
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Match, Route, WebSocketRoute
from starlette.types import Scope
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConfigError,
    InvalidObservation,
    MalformedMessage,
    PolicyUnavailable,
    UnknownSession,
    VLAgentsError,
)
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import (
    DEFAULT_LIMITS,
    SESSION_HEADER,
    Budget,
    MessageLimits,
    Op,
    PriorityName,
    Reply,
    Request,
)
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import Identity, NoKey, caller_name, current_caller
from vlagents_ray.serve.access.charges import Charge, current_charge
from vlagents_ray.serve.config.dialects import (
    DialectArgs,
    DialectConfig,
    KeylessPortConfig,
    PortConfig,
    read_mapping,
)
from vlagents_ray.serve.endpoints import answers
from vlagents_ray.serve.endpoints.charged_messages import ChargedMessages
from vlagents_ray.serve.endpoints.client_socket import current_client
from vlagents_ray.serve.endpoints.http_messages import (
    LONG_BYTES,
    problem_response,
    public_problem,
    read_body,
    request_id,
    session_id,
)
from vlagents_ray.serve.engine.admission import Admission, MessageAdmission
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender, message_admission, settle
from vlagents_ray.serve.ports import LOOPBACK
from vlagents_ray.serve.requests import IncomingMessage

T = TypeVar("T")
Stream = Callable[[WebSocket], Awaitable[None]]
Check = Callable[[str | None], Identity]
"""Returns the owner of a client's API key, or raises `Unauthorized` or `Forbidden`. The argument is
None if the client has sent no key.
"""

logger = logging.getLogger(__name__)

Connect = Callable[[str | None, PriorityName | None], RemoteAgent]
"""Connects to the application for one client, with its API key (None without a key) and the highest
priority that the key allows (None for any priority).
"""

# WebSocket close codes
POLICY_VIOLATION, INTERNAL_ERROR, SERVICE_RESTART, TRY_AGAIN_LATER = 1008, 1011, 1012, 1013
_OUR_NAMES = "vlagents"  # preset for clients without a mapping


@dataclass(frozen=True, slots=True)
class ReplicaContext:
    """The replica that runs the dialects of the server's own port."""

    engine: Engine
    metadata: Callable[[], dict[str, Any]]
    limits: MessageLimits

    @property
    def contract(self) -> Contract | None:
        """The contract of the policy; None until the policy is loaded."""
        return self.engine.contract


@dataclass(frozen=True, slots=True)
class GatewayContext:
    """The gateway, a separate process that runs the dialects with their own port."""

    app: str
    connect: Connect  # connects one client to the application
    limits: MessageLimits
    sessions: int  # maximum number of clients of one dialect
    idle_s: float  # time without a message after which a client's sessions end
    contract: Contract | None
    check: Check | NoKey  # function that checks a client's key; or the reason why no key is needed
    admission: Admission = field(default_factory=lambda: Admission(DEFAULT_LIMITS.in_flight_bytes))
    # Whether a chunk of the policy continues the plan that a robot executes.
    continues_plans: bool = False
    longest_prefix: int = 0  # maximum number of rows of that plan with which a chunk may begin


class Dialect(abc.ABC):
    """A dialect that is enabled in a deployment; its two kinds are `RouteDialect` and
    `PortDialect`.

    Its name in the deployment is also the transport in statistics.
    """

    Config: ClassVar[type[DialectConfig]] = DialectConfig
    clients: ClassVar[str]  # the system whose clients the dialect serves, as named in `/docs`
    summary: ClassVar[str] = ""  # text of `/docs` about sessions, episodes and errors
    # Modules of optional packages, without which a deployment is rejected.
    requires: ClassVar[Sequence[str]] = ()
    # Mappings that deployment files may name.
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = {}

    def __init__(
        self, name: str, config: DialectConfig, context: ReplicaContext | GatewayContext
    ) -> None:
        self.name = name
        self.config = config
        self.context = context
        self.mapping = config.keys() or read_mapping(_OUR_NAMES)

    @classmethod
    def lacks(cls, config: DialectConfig, contract: Contract | None) -> list[str]:
        """Return a sentence, which includes the remedy, for each input of the policy that these
        clients never send.
        """
        mapping = config.keys()
        return [] if mapping is None else mapping.lacks(contract)

    @classmethod
    @abc.abstractmethod
    def places(cls, config: DialectConfig) -> dict[str, Any]:
        """Return the `paths` or the `address` at which clients connect, for the metadata."""

    def read(self, theirs: Any) -> tuple[Obs, str | None]:
        """Convert a client's observation, a map, to `Obs`. Return it and its instruction, which is
        None if there is none.
        """
        if not isinstance(theirs, dict):
            raise MalformedMessage(f"observation: expected a map, got {type(theirs).__name__}")
        return self.mapping.obs(theirs, self.context.limits, self.context.contract)

    def rows(self, reply: Reply) -> np.ndarray:
        """Return the action in the reply to an act, (H, D) float32, in the client's gripper
        convention.
        """
        if reply.act is None:
            raise VLAgentsError("act: expected an action in the reply, got none")
        contract = self.context.contract
        return self.mapping.rows(reply.act.action, None if contract is None else contract.action)


class RouteDialect(Dialect):
    """A dialect over HTTP or WebSocket, on the server's own port, in each replica."""

    # Name of the method that serves each path, such as "POST /act" or "WS /openpi".
    paths: ClassVar[Mapping[str, str]]
    root: ClassVar[str] = ""  # protocol at the server's root, if its clients connect there
    context: ReplicaContext

    @classmethod
    def places(cls, config: DialectConfig) -> dict[str, Any]:  # noqa: ARG003 - overrides
        """Return the `paths` at which clients connect."""
        return {"paths": list(cls.paths)}

    def routes(self) -> list[BaseRoute]:
        """Return the routes of the dialect's paths, without the root."""
        routes: list[BaseRoute] = []
        for method_and_path, name in self.paths.items():
            method, path = method_and_path.split()
            handler = getattr(self, name)
            if method == "WS":
                routes.append(WebSocketRoute(path, handler))
            else:
                routes.append(Route(path, handler, methods=[method]))
        return routes

    async def health(self, _http: HttpRequest) -> Response:
        """Return whether the policy is ready, as the servers of other systems do at `/health`."""
        try:
            self.context.engine.health.require_ready()
        except VLAgentsError as error:
            return problem_response(error, "", PolicyUnavailable.status)
        return JSONResponse({"status": "ok"})

    def at_root(self, sharing: Sequence[Any]) -> Stream:
        """Serve WebSockets at the server's root for all dialects with this protocol there.
        `sharing` lists them, beginning with this dialect.
        """
        raise NotImplementedError(f"{self.name} declares a root but does not serve it")

    def sender(self, session_id: str = "") -> Sender:
        """Return the sender of a connection or, given a session's name, of a request."""
        return Sender(
            self.context.engine,
            self.name,
            session_id,
            caller=current_caller(),
            has_left=current_client(),
            connected=not session_id,
        )

    def session(self, sender: Sender, name: str = "") -> ImplicitSession:
        """Return a session of `sender`, for which the client need not send a reset. Without a
        `name`, it is the sender's own session.
        """
        return ImplicitSession(self.context.engine, sender, self.config.priority, name)

    def messages(self, socket: WebSocket) -> ChargedMessages:
        """Return the messages of an accepted WebSocket, which are charged to the client's key.
        Decoding a message requires its `admission`.
        """
        return ChargedMessages(socket, current_caller())

    async def answer_messages(
        self,
        socket: WebSocket,
        answer: Callable[[WebSocket, bytes | None, MessageAdmission], Awaitable[bool]],
    ) -> None:
        """Answer the messages of an accepted WebSocket one after another, until the client leaves.

        Args:
            socket: The WebSocket.
            answer: Answers a message, which is None for a text message, and returns whether the
                connection continues.
        """
        with contextlib.suppress(WebSocketDisconnect):
            async with self.messages(socket) as messages:
                async for received in messages:
                    admission = self.admission(received.charge, received.size)
                    if not await answer(socket, received.data, admission):
                        return

    def admission(self, charge: Charge, size: int = 0) -> MessageAdmission:
        """Return the admission of a message of `size` bytes, which is the budget for decoding
        it.
        """
        return message_admission(
            self.context.engine, charge, self.context.limits, size, self.config.priority
        )

    def arrived(self, charge: Charge) -> IncomingMessage:
        """Create the `IncomingMessage` of an observation that has just arrived."""
        return IncomingMessage(self.name, "act", self.config.priority, charge)

    def encoded(self, message: IncomingMessage, encode: Callable[[], T]) -> T:
        """Encode the replies of a message with `encode`, which completes their `timing`, and record
        them for the metrics.
        """
        data = answers.timed(message, encode)
        self.context.engine.stats.record(message)
        return data

    def record_failure(self, message: IncomingMessage, error: VLAgentsError) -> None:
        """Record a message that gets an error for the metrics."""
        self.context.engine.stats.record_failure(message, error.code)


class PortDialect(Dialect):
    """A dialect with its own port, on threads of the gateway."""

    Config: ClassVar[type[DialectConfig]] = PortConfig
    scheme: ClassVar[str] = "tcp"  # URL scheme of the address in the metadata
    context: GatewayContext

    def __init__(self, name: str, config: PortConfig, context: GatewayContext) -> None:
        super().__init__(name, config, context)
        if isinstance(config, KeylessPortConfig) and not (
            isinstance(context.check, NoKey) or config.without_key
        ):
            raise ConfigError(
                f"dialects.{name}: expected a protocol with API keys, since the server requires "
                "keys, got a protocol without keys; remove the dialect, or accept all clients "
                "that reach its port, with without_key: true"
            )

    @classmethod
    def places(cls, config: DialectConfig) -> dict[str, Any]:
        """Return the `address` at which clients connect."""
        host = getattr(config, "host", None)
        port = getattr(config, "port", None)
        return {"address": f"{cls.scheme}://{host or LOOPBACK}:{port}"}

    @abc.abstractmethod
    def serve(self, listener: socket.socket) -> None:
        """Start to accept clients, and return.

        The socket `listener` is bound to the port and does not listen yet; the dialect must close
        it.
        """

    @abc.abstractmethod
    def alive(self) -> bool:
        """Return whether the dialect still accepts clients; if not, the gateway is replaced."""

    @abc.abstractmethod
    def close(self) -> None:
        """Stop accepting clients, and end all sessions."""


class Root(WebSocketRoute):
    """The application's root, with or without a slash at its end: `ws://host:port`,
    `ws://host:port/app`.
    """

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Match a WebSocket at the root."""
        path = scope.get("path", "").removeprefix(scope.get("root_path", ""))
        if scope["type"] == "websocket" and path in ("", "/"):
            return Match.FULL, {"endpoint": self.endpoint, "path_params": {}}
        return Match.NONE, {}


def dialect_routes(args: DialectArgs, context: ReplicaContext) -> list[BaseRoute]:
    """Return the routes of the dialects on the server's own port."""
    gateways = args.gateways()
    dialects: dict[str, RouteDialect] = {}
    routes: list[BaseRoute] = []
    for name, config in args.on().items():
        if name not in gateways:
            dialects[name] = dialect_class(name)(name, config, context)
            routes += dialects[name].routes()

    sharing = [dialects[name] for name in args.at_root()]
    if sharing:
        routes.append(Root("/", sharing[0].at_root(sharing)))
    return routes


async def decoded(
    read: Callable[[bytes, Budget], T], data: bytes | None, admission: MessageAdmission
) -> T:
    """Decode a message with `read`, unless it is rejected.

    `data` is None for a text message of a WebSocket, which is rejected.
    """
    admission.begin_message()
    if data is None:
        raise MalformedMessage("message: expected a binary message with a map, got text")
    admission.begin("act")
    return await admission.decoded(partial(read, data), long=len(data) > LONG_BYTES)


async def accept_or_refuse(websocket: WebSocket, context: ReplicaContext) -> bool:
    """Accept a WebSocket; return False if it was rejected, because the policy is not ready or the
    replica is full.
    """
    try:
        context.engine.health.require_ready()
        sessions = context.engine.sessions
        if len(sessions) >= sessions.limit:
            raise sessions.full()
    except VLAgentsError as error:
        if "websocket.http.response" in (websocket.scope.get("extensions") or {}):
            await websocket.send_denial_response(
                problem_response(error, "", PolicyUnavailable.status)
            )
        else:
            await websocket.accept()
            await websocket.close(TRY_AGAIN_LATER, str(error)[:120])
        return False
    await websocket.accept()
    return True


async def close_after_error(websocket: WebSocket, error: VLAgentsError) -> None:
    """Close a WebSocket after an error was sent to its client, which must then connect again."""
    if isinstance(error, PolicyUnavailable):
        await websocket.close(SERVICE_RESTART, str(error)[:120])
    else:
        await websocket.close(INTERNAL_ERROR, "Internal server error.")


class ImplicitEpisode:
    """Decides when an episode begins in a protocol without reset: at the first observation and each
    new instruction.

    An observation without an instruction keeps the previous instruction.
    """

    def __init__(self) -> None:
        self.instruction: str | None = None  # instruction of the last reset
        self.begun = False  # whether the episode has had an observation

    def begins(self, instruction: str | None) -> bool:
        """Return whether an observation with the given instruction begins an episode."""
        return not self.begun or (instruction is not None and instruction != self.instruction)

    def opening(self, instruction: str | None, contract: Contract | None) -> str | None:
        """Return the instruction for the reset; raise `InvalidObservation` if the policy needs an
        instruction, and there is none.
        """
        instruction = self.instruction if instruction is None else instruction
        if instruction is None and contract is not None and contract.instruction:
            raise InvalidObservation(
                "instruction: expected one, as the policy needs it, got none; send it with the "
                "observation"
            )
        return instruction

    def began(self, instruction: str | None) -> None:
        """Record that the session was reset with the given instruction."""
        self.begun = True
        self.instruction = instruction

    def end(self) -> None:
        """Make the next observation begin an episode."""
        self.begun = False


class ImplicitSession:
    """A session of a client on the server's own port. Not thread-safe.

    Its name is unique in the replica, or empty for the sender's own session.
    """

    def __init__(self, engine: Engine, sender: Sender, priority: PriorityName, name: str) -> None:
        self.episode = ImplicitEpisode()
        self._engine = engine
        self._sender = sender
        self._priority = priority
        self._name = name

    async def act(
        self, message: IncomingMessage, obs: Obs, instruction: str | None, request_id: str
    ) -> Reply:
        """Return the policy's reply to an observation; see `act_together`."""
        (reply,) = await act_together(message, [SessionObs(self, obs, instruction)], request_id)
        return reply

    async def close(self, charge: Charge) -> None:
        """End the session for a message of the client; `charge` is the charge of that message."""
        request = self._request("close", None, None, "")
        await self._sender.ask(self._sender.message(charge, "close"), Decoded([request], {}))

    @property
    def id(self) -> str:
        """The session's id in the engine."""
        return self._sender.id_of(self._name) if self._name else self._sender.session_id

    def _request(
        self, op: Op, obs: Obs | None, instruction: str | None, request_id: str
    ) -> Request:
        return Request(
            op, obs, instruction, session=self._name, priority=self._priority, request_id=request_id
        )


class SessionObs(NamedTuple):
    """An observation of a session, and its instruction, which is None if there is none.

    `begins` is whether the client begins an episode with it; otherwise the session's
    `ImplicitEpisode` decides.
    """

    session: ImplicitSession
    obs: Obs
    instruction: str | None
    begins: bool = False


async def act_together(
    message: IncomingMessage,
    observations: Sequence[SessionObs],
    request_id: str,
    read: Callable[[Reply], object] | None = None,
) -> list[Reply]:
    """Return the policy's reply to each observation in a client's message, whose acts are queued
    together: all of them, or none.

    A session whose episode begins is reset first. A session that was removed because it was idle is
    reset again. That is safe, since the policy has not received the observation.

    If an observation is rejected, the sessions that the message has begun end. If the policy has
    acted on some of several observations, the episodes of all of them end, so that a repeated
    message begins them again, and no session is a step ahead of its client.

    Args:
        message: The client's message.
        observations: The observations, each of another session.
        request_id: The id of the message, for the log.
        read: Raises an error if the client cannot be sent the action of a reply.

    Raises:
        TooManyRequests: The client's key is over its rate; the policy has received nothing.
        PolicyUnavailable: There is no room for all new sessions; the policy has received nothing.
        VLAgentsError: The first error among the replies.
    """
    charge = message.charge
    if charge is None:
        raise TypeError(
            "message.charge: expected the charge to the client's key, got None; create the message "
            "with `RouteDialect.arrived`"
        )
    charge.cover(len(observations))

    engine = observations[0].session._engine
    new_ids = [session.id for session, *_ in observations if session.id not in engine.sessions]
    beginning = [
        session_obs
        for session_obs in observations
        if session_obs.begins or session_obs.session.episode.begins(session_obs.instruction)
    ]
    ending: Sequence[SessionObs] = beginning  # their episodes end if there is an error
    try:
        observations[0].session._sender.require_room(new_ids)
        if len(observations) > 1:
            model = engine.model.require_loaded()
            for session, obs, instruction, _ in observations:
                model.check(session._request("act", obs, instruction, request_id))
        await _reset(beginning, charge, request_id)

        # Until all replies are known, the policy may have acted on any of the observations.
        ending = beginning if len(observations) == 1 else observations
        replies = await _act(message, observations, charge, request_id)
        if all(reply.error is not None for reply in replies):
            ending = beginning
        raise_first(reply.error for reply in replies)
        if read is not None:
            for reply in replies:
                read(reply)
    except BaseException:
        for session_obs in ending:
            session_obs.session.episode.end()
        observations[0].session._sender.discard(new_ids)
        raise
    return replies


async def _act(
    message: IncomingMessage, observations: Sequence[SessionObs], charge: Charge, request_id: str
) -> list[Reply]:
    """Return the reply to each observation; sessions that were forgotten are reset again."""
    replies = await _ask(message, "act", observations, [None] * len(observations), request_id)

    forgotten = [
        index for index, reply in enumerate(replies) if isinstance(reply.error, UnknownSession)
    ]
    if forgotten:
        logger.info(
            "%s: a session was forgotten; it begins again (request %s)",
            message.transport,
            request_id,
        )
        again = [observations[index] for index in forgotten]
        await _reset(again, charge, request_id)
        acts = observations[0].session._sender.message(charge)
        repeated = await _ask(acts, "act", again, [None] * len(again), request_id)
        for index, reply in zip(forgotten, repeated, strict=True):
            replies[index] = reply
    return replies


async def _reset(observations: Sequence[SessionObs], charge: Charge, request_id: str) -> None:
    """Reset the sessions of these observations, which are the first observations of their episodes.
    `charge` is the charge of the client's message.
    """
    if not observations:
        return

    openings = []
    for session, _, instruction, _ in observations:
        openings.append(session.episode.opening(instruction, session._engine.contract))
    for session, *_ in observations:
        session.episode.end()

    first = observations[0].session
    resets = first._sender.message(charge, "reset", first._priority)
    resets.decoded_alike(len(observations))
    replies = await _ask(resets, "reset", observations, openings, request_id)
    answers.timed(resets, lambda: None)
    first._engine.stats.record(resets)

    for (session, *_), opening, reply in zip(observations, openings, replies, strict=True):
        if reply.error is None:
            session.episode.began(opening)
    raise_first(reply.error for reply in replies)


async def _ask(
    message: IncomingMessage,
    op: Op,
    observations: Sequence[SessionObs],
    instructions: Sequence[str | None],
    request_id: str,
) -> list[Reply]:
    """Send one request for each observation, all together. If there are several requests, each id
    ends with a number.
    """
    requests = []
    pairs = zip(observations, instructions, strict=True)
    for index, ((session, obs, *_), instruction) in enumerate(pairs):
        name = request_id if len(observations) == 1 else f"{request_id}-{index}"
        requests.append(session._request(op, obs, instruction, name))
    return await observations[0].session._sender.ask(message, Decoded(requests, {}))


def raise_first(results: Iterable[object]) -> None:
    """Raise the first error among the results."""
    for result in results:
        if isinstance(result, Exception):
            raise result


class HttpDialect(RouteDialect):
    """A dialect of HTTP requests.

    A request without the header `x-session-id` is an episode of one step. With the header, the
    request belongs to that session. A new instruction begins a new episode in the session; so does
    the first observation after a request to a path that `end_episode` serves. The response to an
    error has the error's status and a problem+json document.
    """

    def __init__(self, name: str, config: DialectConfig, context: ReplicaContext) -> None:
        super().__init__(name, config, context)
        # Episodes by caller and session id in the engine. A new key with the name of a revoked key
        # continues the sessions of that name, but its caller differs.
        self._episodes: dict[tuple[Identity, str], ImplicitEpisode] = {}

    async def answer(
        self,
        http: HttpRequest,
        read: Callable[[bytes, Budget], Any],
        write: Callable[[np.ndarray], bytes],
        media_type: str = "application/json",
    ) -> Response:
        """Answer a request with one observation.

        Args:
            http: The request.
            read: Decodes the body to the client's observation, within a budget; may run on another
                thread.
            write: Encodes the action, (H, D) float32 in the client's convention, as the body of
                the reply.
            media_type: The media type of the reply.
        """
        name = request_id(http)

        async def act(theirs: Any, message: IncomingMessage) -> bytes:
            """Return the body with the action for an observation."""
            obs, instruction = self.read(theirs)
            message.decoded_alike()

            if SESSION_HEADER in http.headers:
                session_name = session_id(http)
                session = await self.client_session(self.sender(session_name), session_name)
                if not session.episode.begun:
                    self.mapping.warn_of_unread_cameras(theirs, self.name)
                reply = await session.act(message, obs, instruction, name)
            else:
                self.mapping.warn_of_unread_cameras(theirs, self.name)
                sender = self.sender()
                try:
                    reply = await self.session(sender).act(message, obs, instruction, name)
                finally:
                    sender.release(for_good=True)
            return self.encoded(message, lambda: write(self.rows(reply)))

        return await self.respond(http, read, act, media_type)

    async def respond(
        self,
        http: HttpRequest,
        read: Callable[[bytes, Budget], T],
        act: Callable[[T, IncomingMessage], Awaitable[bytes]],
        media_type: str,
    ) -> Response:
        """Charge and read a request, and return the response with its answer or its error.

        Args:
            http: The request.
            read: Decodes the body, within a budget; may run on another thread.
            act: Returns the body of the answer, from the result of `read`.
            media_type: The media type of the answer.
        """
        charge = current_charge()
        message = self.arrived(charge)
        admission = self.admission(charge)
        try:
            self.context.engine.health.require_ready()
            body = await read_body(http, admission)
            message.arrive()
            answer = await act(await decoded(read, body, admission), message)
            return Response(answer, media_type=media_type)
        except ClientDisconnect:
            self.context.engine.stats.record_failure(message, "disconnected")
            return Response(status_code=499)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            name = request_id(http)
            problem = public_problem(error, self.name, name)
            self.record_failure(message, problem)
            return problem_response(problem, name)
        finally:
            admission.release()

    async def end_episode(self, http: HttpRequest) -> Response:
        """Answer `{}`, and make the next observation of the session in the header begin an
        episode.
        """
        session_name = session_id(http)
        session = await self.client_session(self.sender(session_name), session_name)
        session.episode.end()
        return Response(b"{}", media_type="application/json")

    async def client_session(
        self, sender: Sender, name: str, *, begins: bool = False
    ) -> ImplicitSession:
        """Return the session that a client calls `name`, for its current request; the session's
        episode exists as long as the session exists in an engine.

        Args:
            sender: The sender of that request, which may use another connection than earlier
                requests.
            name: The client's name of the session.
            begins: Whether the request begins an episode, so that no other replica is searched for
                the session.
        """
        sessions = self.context.engine.sessions
        if len(self._episodes) > 2 * len(sessions) + 16:
            # Sessions that the engine no longer has are forgotten.
            self._episodes = {
                key: episode for key, episode in self._episodes.items() if key[1] in sessions
            }

        session = self.session(sender, name)
        engine_id = sender.id_of(name)
        key = (current_caller(), engine_id)
        if key not in self._episodes or engine_id not in sessions:
            finder = self.context.engine.finder
            # If this replica does not have the session, another replica may have served it.
            if finder is not None and engine_id not in sessions and not begins:
                over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
                if finder.fetch(engine_id, partial(settle, over, None), caller_name()):
                    await over
            if sessions.versions_of([engine_id]):
                session.episode.began(sessions.get(engine_id).instruction)
            self._episodes[key] = session.episode
        session.episode = self._episodes[key]
        return session
