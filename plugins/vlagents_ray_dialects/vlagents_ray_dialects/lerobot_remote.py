"""LeRobot's remote inference over Zenoh (`lerobot-rollout --inference.type=remote`): one instance
serves many robots, each in a separate session; LeRobot's own server serves one robot at a time.

The keys of a deployment D, an instance I and a session S:

    lerobot/inference/v1/deployments/D/describe                 query: what the deployment offers
    …/D/instances/I/open                                        query: begin a session
    …/D/instances/I/alive                                       liveliness of the server
    …/D/instances/I/sessions/S/control                          query: reset, invalidate, close
    …/D/instances/I/sessions/S/obs, …/S/act                     observations and their actions
    …/D/instances/I/sessions/S/language/request                 rejected: no policy answers text
    …/D/instances/I/sessions/S/alive                            liveliness of the robot

Zenoh's messages have no field for an API key, and do not name their sender. Each connection to the
port is therefore a Zenoh network without other clients: a client cannot subscribe to, publish to or
query the keys of another. Zenoh's own access rules would apply to all clients alike, and a rule for
`sessions/*/act` also admits a client that subscribes to that expression itself.

If the network is open to anyone but trusted robots, connect both the server and the robots to a
Zenoh router, which has TLS and access rules. Its robots share one network, in which the router's
rules have to keep them apart.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import logging
import math
import socket
import tempfile
import threading
import time
import uuid
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, Field

from vlagents_ray.errors import (
    ConfigError,
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    PolicyFailed,
    PolicyUnavailable,
    VLAgentsError,
    shown,
)
from vlagents_ray.interface import DELAY, LEFTOVER
from vlagents_ray.registry import require
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.access.charges import Account, Charge
from vlagents_ray.serve.config.dialects import KeylessPortConfig, MappingSetting
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.engine.admission import ArrivingBytes, MessageAdmission
from vlagents_ray.serve.token_bucket import TokenBucket
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray_dialects.acceptor import TICK_S, Acceptor
from vlagents_ray_dialects.client_reader import share_of
from vlagents_ray_dialects.forwarding import SHORT_FOLDER, ForwardedConnection
from vlagents_ray_dialects.gateway_sessions import GatewayClient, GatewayClients, internal_error
from vlagents_ray_dialects.messages import lerobot_remote as messages
from vlagents_ray_dialects.messages.lerobot_remote import (
    IDENTITY,
    MERGES,
    Envelope,
    IncompatibleRequest,
    StaleMessage,
    UnsupportedRequest,
)

logger = logging.getLogger(__name__)

_PREFIX = f"lerobot/inference/v{messages.PROTOCOL_VERSION}/deployments"
# Maximum number of observations of a robot that wait, of which the oldest is dropped, and of its
# control messages, of which further ones are rejected.
_WAITING, _WAITING_CONTROLS = 8, 32
# Maximum number of questions of a connection that wait for an answer, and of sessions that it opens
# in a second and at once. LeRobot's client sends one question after the other, and opens one
# session. Opening a session takes about 10 ms.
_QUESTIONS, _OPENS_PER_S, _OPENS_AT_ONCE = 8, 5.0, 10
_ANSWERING = 2  # number of threads that answer questions
_CONTROL_BYTES = 256 * 1024  # maximum size of a message that is no observation
_HANDSHAKE_S = 5.0  # maximum time until the first bytes of a client
_STRANGERS = 64  # maximum number of connections without a session; one more ends the oldest
# Bytes of Zenoh's protocol around a message, which has its key, and around each KiB of a message.
_OVERHEAD_BYTES, _OVERHEAD_SHARE = 1024, 1024
# Number of messages whose fragments Zenoh joins at the same time: a reliable one and another one of
# each of eight priorities.
_JOINED = 16
_NO_ROOM_S = 10.0  # time after which a connection ends if there is no memory for its bytes
_END_S = 3.0  # the time limit for the end of a robot's thread
# LeRobot's names for the modes in which a robot executes chunks: one chunk after another, or
# real-time chunking with a policy that is either guided to the plan or trained to begin with the
# first rows of the plan.
_CHUNK, _GUIDED, _TRAINED = "chunk", "rtc_guided", "rtc_trained"
# Deadlines that a client adds to its own time limits, s; the defaults of LeRobot.
_ACTION_DEADLINE_S, _LANGUAGE_DEADLINE_S = 5.0, 60.0


class Feature(BaseModel, extra="forbid"):
    """One named value of an observation, or the action, as the client's robot describes it."""

    name: str = Field(description="name of the value")
    shape: list[int] = Field(description="its shape")
    dtype: str = Field(default="float32", description="its dtype")
    kind: str = Field(default="tensor", description="tensor, or rgb for an image (H, W, 3) uint8")
    names: list[str] = Field(default_factory=list, description="names of the numbers of a vector")
    semantics: str = Field(description="convention in words, which must equal the client's")

    def to_wire(self) -> dict[str, Any]:
        """Return the feature as LeRobot's `FeatureSpec` has it."""
        return {
            "name": self.name,
            "shape": self.shape,
            "dtype": self.dtype,
            "kind": self.kind,
            "names": self.names,
            "semantics": self.semantics,
        }


class LeRobotRemoteDialectConfig(KeylessPortConfig):
    """The settings of LeRobot's remote inference. LeRobot's client compares each of them with the
    settings of its robot, so use the values of LeRobot's own deployment file.
    """

    mapping: MappingSetting = "lerobot"
    port: int = Field(default=7447, ge=1, le=65535)
    deployment: str = Field(
        default="vlagents_ray",
        description="name of the deployment, which clients give as `--inference.deployment`",
    )
    semantics: str = Field(description="convention of the deployment in words")
    features: list[Feature] = Field(min_length=1, description="values of an observation, in order")
    action: Feature = Field(description="the action of one step, a float32 vector")
    fps: float | None = Field(
        default=None, gt=0, description="rate of the actions, Hz; default: the contract's"
    )
    steps: int | None = Field(
        default=None,
        ge=1,
        description="rows of a chunk that are sent in mode `chunk`; default: the contract's",
    )
    router: str | None = Field(
        default=None,
        description="endpoint of a Zenoh router, such as tls/router:7447, to connect to instead "
        "of listening",
    )
    zenoh_config: Path | None = Field(
        default=None, description="Zenoh's own configuration, with TLS certificates for the router"
    )


class LeRobotRemoteDialect(PortDialect):
    """LeRobot's remote inference: in mode `chunk`, with appended and aligned chunks, and, where the
    policy can, in one of the modes `rtc_guided` and `rtc_trained`.
    """

    Config = LeRobotRemoteDialectConfig
    clients = "LeRobot's remote inference"
    summary = (
        "A session is what `open` has begun; an episode begins with `reset` and each new task. "
        "Many robots share one instance. Mode `chunk`, and `rtc_guided` or `rtc_trained` if the "
        "policy continues plans."
    )
    scheme = "zenoh"
    requires = ("zenoh", "msgpack")
    config: LeRobotRemoteDialectConfig

    def __init__(
        self, name: str, config: LeRobotRemoteDialectConfig, context: GatewayContext
    ) -> None:
        super().__init__(name, config, context)
        self.offer = Offer(config, context)
        self.offer.require_fit(self.mapping)
        self.robots: GatewayClients[str, RobotSession] = GatewayClients(context)
        self.questions = ThreadPoolExecutor(_ANSWERING, f"{name}-questions")
        self._closing = threading.Event()
        # Either the clients of the port, or the network of the router.
        self._acceptor: Acceptor | None = None
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._numbers = itertools.count()
        self._lock = threading.Lock()  # guards the next field
        self._connections: dict[RobotConnection, None] = {}  # the oldest first
        self._router: RobotNetwork | None = None
        self._checks: threading.Thread | None = None

    @property
    def is_stopping(self) -> bool:
        """Whether no more sessions are opened, since the server is stopping."""
        return self._closing.is_set()

    def serve(self, listener: socket.socket) -> None:
        """Accept the connections of the port, or connect to the router."""
        require("zenoh")
        if self.config.router is None:
            self._folder = tempfile.TemporaryDirectory(prefix="vlr-", dir=SHORT_FOLDER)
            self._acceptor = Acceptor(self.name, listener, self._add, self.robots.forget_quiet)
            return
        listener.close()
        self._router = RobotNetwork(self, {"mode": "client", "connect": [self.config.router]})
        self._checks = threading.Thread(target=self._check, name=self.name, daemon=True)
        self._checks.start()

    def alive(self) -> bool:
        if self._acceptor is not None:
            return self._acceptor.alive()
        return self._checks is not None and self._checks.is_alive()

    def close(self) -> None:
        """Begin no more sessions, end all of them after their current actions, and disconnect."""
        self._closing.set()
        if self._acceptor is not None:
            self._acceptor.close()
        for robot in self.robots.end_all():
            robot.join()
        self.questions.shutdown(wait=False, cancel_futures=True)
        if self._checks is not None:
            self._checks.join()
        if self._router is not None:
            self._router.close()

        with self._lock:
            connections = list(self._connections)
        for connection in connections:
            connection.disconnect()
        deadline = time.monotonic() + _END_S
        for connection in connections:
            connection.wait_answered(deadline)
            connection.end()
        for connection in connections:
            connection.thread.join(max(0.0, deadline - time.monotonic()))
        if self._folder is not None:
            self._folder.cleanup()

    def new_path(self) -> str:
        """Return a new path for the socket of a connection's network."""
        if self._folder is None:
            raise TypeError("a connection without a port: call serve() first")
        return f"{self._folder.name}/{next(self._numbers)}"

    def remove(self, connection: RobotConnection) -> None:
        """Remove a connection that has ended."""
        with self._lock:
            self._connections.pop(connection, None)

    def _add(self, client: socket.socket) -> None:
        """Forward a connection. If too many connections have no session, end the oldest of
        them.
        """
        connection = RobotConnection(self, client)
        with self._lock:
            strangers = [
                earlier
                for earlier in self._connections
                if earlier.is_open and not earlier.has_session
            ]
            self._connections[connection] = None
        if len(strangers) >= _STRANGERS:
            strangers[0].end()
        connection.thread.start()

    def _check(self) -> None:
        """End the sessions of disconnected robots, until the dialect is closed."""
        while not self._closing.wait(TICK_S):
            self.robots.forget_quiet()


class RobotConnection(ForwardedConnection):
    """One connection to the port, which is a Zenoh network without other clients.

    Args:
        dialect: The dialect.
        client: The connection.
    """

    def __init__(self, dialect: LeRobotRemoteDialect, client: socket.socket) -> None:
        super().__init__(dialect.name, client)
        self._dialect = dialect
        self._share = share_of(client)  # the name of the client's share of the bytes in flight
        self._network: RobotNetwork | None = None
        is_robot = dialect.config.priority == "robot"
        self._counting = threading.Lock()  # guards the two following values
        self._incomplete = 0  # bytes that arrived and belong to no message that Zenoh has delivered
        self._most_incomplete = _JOINED * _most_bytes(dialect.context)
        self._arriving = ArrivingBytes(dialect.context.admission, self._share, is_robot, self.end)

    @property
    def has_session(self) -> bool:
        """Whether the client has a session."""
        return self._network is not None and self._network.has_session

    def greet(self) -> tuple[str, bytes]:
        """Read the beginning of Zenoh's handshake, and open the client's network."""
        deadline = time.monotonic() + _HANDSHAKE_S
        head = b""
        while len(head) < messages.HEAD_BYTES:
            received = self.read(messages.HEAD_BYTES - len(head), deadline)
            if not received:
                raise ConnectionResetError("the client disconnected")
            head += received
        messages.check_head(head)

        path = self._dialect.new_path()
        settings = {"mode": "peer", "listen": [f"unixsock-stream/{path}"]}
        self._network = RobotNetwork(self._dialect, settings, self)
        return path, head

    def admit(self, data: bytes) -> bool:
        """Count bytes as in flight until Zenoh delivers the message to which they belong. Without
        room for them, the client's oldest observation is dropped, or the client has to wait.
        """
        with self._counting:
            self._incomplete = min(self._incomplete + len(data), self._most_incomplete)
            is_small = self._incomplete <= 2 * _CONTROL_BYTES
        if not is_small and not self.has_session:
            raise MessageTooLarge(
                f"expected at most {2 * _CONTROL_BYTES} bytes before a session is opened"
            )
        deadline = time.monotonic() + _NO_ROOM_S
        while True:
            try:
                with self._counting:
                    self._arriving.resize(self._incomplete)
            except Overloaded:
                if self._network is not None and self._network.drop_observation():
                    continue
                if time.monotonic() > deadline:
                    raise
                if self._ended.wait(0.01):
                    return False
            else:
                return self.is_open

    def delivered(self, size: int) -> None:
        """Stop counting the bytes of a message of `size` bytes, which Zenoh has delivered."""
        with self._counting:
            size += _OVERHEAD_BYTES + size // _OVERHEAD_SHARE
            self._incomplete = max(0, self._incomplete - size)
            with contextlib.suppress(Overloaded):  # the number has become smaller
                self._arriving.resize(self._incomplete)

    @property
    def share(self) -> str:
        """The name of the client's share of the bytes in flight."""
        return self._share

    def disconnect(self) -> None:
        """Leave the client's network, so that the client learns that the server stops."""
        if self._network is not None:
            self._network.close()

    def closed(self) -> None:
        """End the session of the client."""
        self.disconnect()
        with self._counting:
            self._incomplete = 0
            self._arriving.release()
        self._dialect.remove(self)


class RobotNetwork:
    """A Zenoh network, and the sessions of its robots: one robot for each connection to the port,
    and all robots that use the same router.

    Args:
        dialect: The dialect.
        settings: The mode and the endpoints of Zenoh's session.
        connection: The connection to the port; None for a router.
    """

    def __init__(
        self,
        dialect: LeRobotRemoteDialect,
        settings: Mapping[str, Any],
        connection: RobotConnection | None = None,
    ) -> None:
        self.dialect = dialect
        self.connection = connection
        self._account = Account(NoKey.OPEN)
        self._lock = threading.Lock()  # guards the following values
        self._robots: dict[str, RobotSession] = {}
        self._waiting = 0  # number of questions without an answer
        self._is_closed = False
        robots = 1 if connection is not None else dialect.context.sessions
        self._most_waiting = _QUESTIONS * robots
        self._openings = TokenBucket(
            _OPENS_PER_S * robots, time.monotonic(), _OPENS_AT_ONCE * robots
        )
        self.zenoh = self._connect(settings)

        offer = dialect.offer
        self._declared = [
            self._answer_at(f"{offer.key}/describe", self._describe),
            self._answer_at(f"{offer.instance_key}/open", self._open),
            self.zenoh.liveliness().declare_token(f"{offer.instance_key}/alive"),
        ]

    @property
    def has_session(self) -> bool:
        """Whether a robot has a session."""
        return bool(self._robots)

    def close(self) -> None:
        """End the sessions after their current actions, and disconnect."""
        with self._lock:
            is_closed, self._is_closed = self._is_closed, True
            robots = list(self._robots)
        if is_closed:
            return
        for session_id in robots:
            self._end(session_id)
        self.zenoh.close()

    def admission(self, charge: Charge, share: str) -> MessageAdmission:
        """Return the admission of a message that has arrived; `share` is the name of a robot's
        share of the bytes in flight if its address is not known.
        """
        context = self.dialect.context
        return MessageAdmission(
            context.admission,
            context.limits,
            charge,
            robot=self.dialect.config.priority == "robot",
            inline=False,
            share=share if self.connection is None else self.connection.share,
        )

    def payload_of(self, message: Any, key: str, limit: int, *, is_query: bool) -> Any:
        """Return the payload of a message that has arrived; None if it has none.

        Args:
            message: The query or the sample.
            key: The key at which the server answers or receives the message.
            limit: Maximum number of bytes.
            is_query: Whether the message is a query.

        Raises:
            MalformedMessage: The message is for several keys, or has a part that no client of
                LeRobot sends.
            MessageTooLarge: The message is too large.
        """
        payload = message.payload
        size = 0 if payload is None else len(payload)
        if self.connection is not None:
            self.connection.delivered(size)
        if str(message.key_expr) != key:
            raise MalformedMessage("key: expected the key of one server or session, got wildcards")
        if message.attachment is not None or (is_query and str(message.parameters)):
            raise MalformedMessage(
                "message: expected a payload alone, got an attachment or parameters"
            )
        if size > limit:
            raise MessageTooLarge(f"message: expected at most {limit} bytes, got {size}")
        return payload

    def drop_observation(self) -> bool:
        """Drop the oldest observation of a robot that waits; return False if there is none."""
        with self._lock:
            robots = list(self._robots.values())
        return any(robot.drop_observation() for robot in robots)

    def forget(self, session_id: str) -> None:
        """Forget a session that has ended."""
        with self._lock:
            self._robots.pop(session_id, None)
        self.dialect.robots.remove(session_id)

    def _end(self, session_id: str) -> None:
        """End a session after its current action."""
        with self._lock:
            robot = self._robots.pop(session_id, None)
        self.dialect.robots.remove(session_id)
        if robot is not None:
            robot.end()

    def _connect(self, settings: Mapping[str, Any]) -> Any:
        """Open Zenoh's session."""
        zenoh = require("zenoh")
        path = self.dialect.config.zenoh_config
        config = zenoh.Config() if path is None else zenoh.Config.from_file(str(path))
        all_settings: dict[str, Any] = {
            "mode": settings["mode"],
            "connect/endpoints": settings.get("connect", []),
            "listen/endpoints": settings.get("listen", []),
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "transport/shared_memory/enabled": False,
            "transport/link/rx/max_message_size": _most_bytes(self.dialect.context),
        }
        for setting, value in all_settings.items():
            config.insert_json5(setting, json.dumps(value))
        return zenoh.open(config)

    def _answer_at(self, key: str, answer: Callable[[Envelope], Envelope]) -> Any:
        """Answer the questions at a key."""
        arrive = partial(self._arrive, key, answer)
        return self.zenoh.declare_queryable(key, direct(arrive), complete=True)

    def _arrive(self, key: str, answer: Callable[[Envelope], Envelope], query: Any) -> None:
        """Let a thread answer a question, since this is Zenoh's thread."""
        admission = self.admission(self._account.charge(), "questions")
        try:
            payload = self.payload_of(query, key, _CONTROL_BYTES, is_query=True)
            with self._lock:
                is_opening = answer == self._open
                is_fast = is_opening and self._openings.take(time.monotonic()) > 0
                if is_fast or self._waiting >= self._most_waiting:
                    raise Overloaded("too many questions at once; ask again in a second")
                admission.receive(0 if payload is None else len(payload))
                self._waiting += 1
            data = b"" if payload is None else payload.to_bytes()
            self.dialect.questions.submit(self._answer, key, answer, query, data, admission)
        except VLAgentsError as error:
            admission.release()
            reply(query, key, Envelope("error", body=messages.error_body(error)))
        except RuntimeError:  # the dialect has been closed
            admission.release()
            query.drop()

    def _answer(
        self,
        key: str,
        answer: Callable[[Envelope], Envelope],
        query: Any,
        data: bytes,
        admission: MessageAdmission,
    ) -> None:
        """Answer a question."""
        request = Envelope("error")
        try:
            admission.begin_message()
            request = messages.decode(data, self.dialect.context.limits)
            response = answer(request)
        except VLAgentsError as error:
            response = request.reply("error", messages.error_body(error))
        except Exception:  # noqa: BLE001 - logged, and answered
            internal = VLAgentsError(internal_error(self.dialect.name))
            response = request.reply("error", messages.error_body(internal))
        finally:
            admission.release()
            with self._lock:
                self._waiting -= 1
        reply(query, key, response)

    def _describe(self, request: Envelope) -> Envelope:
        """Return the descriptor of the deployment."""
        offer = self.dialect.offer
        return Envelope(
            "descriptor",
            offer.instance_id,
            request_id=request.request_id,
            body=offer.descriptor(),
        )

    def _open(self, request: Envelope) -> Envelope:
        """Begin the session that a client requests, and return the answer with its id.

        A client that asks again gets a new session. The earlier session of its connection ends.
        """
        dialect = self.dialect
        if dialect.is_stopping:
            raise StaleMessage("open: the server is stopping; connect again")
        if not request.request_id:
            raise MalformedMessage("request_id: expected an id of the request, got none")
        if request.instance_id != dialect.offer.instance_id:
            raise StaleMessage(
                "instance_id: expected the id in the server's description, got another one; the "
                "server was started again: connect again"
            )
        terms = dialect.offer.accept(request.body)
        if self.connection is not None:
            for earlier in list(self._robots):
                self._end(earlier)

        session_id = uuid.uuid4().hex
        robot = dialect.robots.add(session_id, partial(RobotSession, self, session_id, terms))
        with self._lock:
            is_closed = self._is_closed
            if not is_closed:
                self._robots[session_id] = robot
        if is_closed:
            dialect.robots.remove(session_id)
            raise StaleMessage("open: the client has disconnected")
        robot.declare()
        body = {**dialect.offer.descriptor(), **terms}
        return Envelope(
            "accepted", dialect.offer.instance_id, session_id, 0, request.request_id, body
        )


class Offer:
    """The descriptor of a deployment in LeRobot's format: what the deployment offers to each robot.

    Args:
        config: The settings of the dialect.
        context: The context of the gateway, with the policy's contract.

    Raises:
        ConfigError: The settings and the contract lack a value, or contradict each other.
    """

    def __init__(self, config: LeRobotRemoteDialectConfig, context: GatewayContext) -> None:
        if not messages.is_segment(config.deployment):
            raise ConfigError(
                "deployment: expected 1 to 128 letters, digits, '_', '.' and '-', got "
                f"{config.deployment!r}"
            )
        contract = context.contract
        chunk = None if contract is None else contract.chunk
        steps = config.steps or chunk
        hz = config.fps
        if hz is None and contract is not None:
            hz = contract.control_hz
        if steps is None or hz is None:
            missing = "steps" if steps is None else "fps"
            raise ConfigError(f"{missing}: expected a value, as the policy's contract has none")
        if chunk is not None and steps > chunk:
            raise ConfigError(
                f"steps: expected at most {chunk}, the rows of the policy's chunks, got {steps}"
            )
        dim = None if contract is None else contract.action.dim
        if config.action.dtype != "float32" or config.action.shape != [
            dim or config.action.shape[0]
        ]:
            raise ConfigError(
                f"action: expected a float32 vector of {dim} numbers, as the policy returns, got "
                f"{config.action.dtype} {config.action.shape}"
            )

        self._config = config
        self._context = context
        self.execution_steps = int(steps)  # rows of an answer in mode `chunk`
        self.prediction_steps = int(chunk or steps)  # rows of an answer in the other modes
        self.width = config.action.shape[0]
        self.longest_prefix = context.longest_prefix
        self.modes = [_CHUNK]
        if context.continues_plans:
            self.modes.append(_TRAINED if self.longest_prefix else _GUIDED)
        self._interval_s = 1 / float(hz)
        self.instance_id = uuid.uuid4().hex
        self.key = f"{_PREFIX}/{config.deployment}"
        self.instance_key = f"{self.key}/instances/{self.instance_id}"
        # LeRobot's clients end their rollout if this identity changes, so it stays the same when
        # weights are pushed.
        self.artifact = config.deployment

    def require_fit(self, mapping: KeyMapping) -> None:
        """Raise `ConfigError` if the mapping cannot read an observation of these features."""
        context = self._context
        features: dict[str, Any] = {"task": "a task"}
        for feature in self._config.features:
            features[feature.name] = np.zeros(feature.shape, feature.dtype)
        try:
            obs, _ = mapping.obs(features, context.limits, context.contract)
        except VLAgentsError as error:
            raise ConfigError(f"features: the mapping cannot read them: {error}") from error
        needed = context.contract
        for kind, names, values in (
            ("camera", needed and needed.cameras, obs.cameras),
            ("state", needed and needed.state, obs.state),
        ):
            missing = [name for name in names or () if name not in values]
            if missing:
                raise ConfigError(
                    f"features: expected the {kind} {missing}, which the policy needs, got "
                    f"{sorted(values)}; add the feature, or change the mapping"
                )

    def descriptor(self) -> dict[str, Any]:
        """Return the body of the message `descriptor`."""
        config = self._config
        return {
            "deployment": config.deployment,
            "instance_id": self.instance_id,
            "artifact_identity": self.artifact,
            "software": {"name": "vlagents-ray"},
            "semantics": config.semantics,
            "capabilities": {
                "modes": self.modes,
                "prediction_steps": self.prediction_steps,
                "execution_steps": self.execution_steps,
                "action_interval": self._interval_s,
                "features": [feature.to_wire() for feature in config.features],
                "action_feature": config.action.to_wire(),
                "language": False,
                "training_max_delay": self.longest_prefix if _TRAINED in self.modes else 0,
                # The policy reads the whole plan, and decides itself how strongly each row guides
                # it.
                "rtc_horizon": self.prediction_steps if len(self.modes) > 1 else 0,
                "current_observation_only": True,
                "retains_session_state": True,
                "action_representation": "canonical",
            },
            "execution_contracts": list(MERGES),
            # The robot blends the rows of chunks, and its user chooses the components; clients with
            # `chunk_blending_v1` read this list.
            "blendable_components": config.action.names,
            "ready": True,
            "available": True,
            "failure": None,
            "session": {},
            "session_status": "idle",
            "limits": {
                "action_deadline_s": _ACTION_DEADLINE_S,
                "language_deadline_s": _LANGUAGE_DEADLINE_S,
                "idle_timeout_s": self._context.idle_s,
                "max_input_chars": 4096,
                "max_output_chars": 8192,
                "codec": {},
                "inflight_inference": 1,
            },
        }

    def accept(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return what is added to the descriptor in the answer to a request for a session.

        Args:
            body: The body of the request.

        Raises:
            IncompatibleRequest: The client's robot differs from the robot of the deployment.
            UnsupportedRequest: The client requests something that the deployment does not offer.
        """
        descriptor = self.descriptor()
        capabilities = descriptor["capabilities"]
        for name, expected in (
            ("expected_artifact", self.artifact),
            ("features", capabilities["features"]),
            ("action_feature", capabilities["action_feature"]),
            ("semantics", self._config.semantics),
        ):
            if not messages.equals(body.get(name), expected):
                raise IncompatibleRequest(
                    f"{name}: expected {shown(expected, 400)}, got {shown(body.get(name), 400)}"
                )
        interval = body.get("action_interval")
        if not isinstance(interval, float) or not math.isclose(
            interval, self._interval_s, rel_tol=1e-6
        ):
            raise IncompatibleRequest(
                f"action_interval: expected {self._interval_s:g} s, got {shown(interval)}"
            )
        mode, encoding = body.get("mode"), body.get("encoding")
        if not isinstance(mode, str) or mode not in self.modes:
            raise UnsupportedRequest(
                f"mode: expected one of {self.modes}, which the policy can, got {shown(mode)}"
            )
        if not isinstance(encoding, str) or encoding not in ("raw", "jpeg"):
            raise UnsupportedRequest(f"encoding: expected raw or jpeg, got {shown(encoding)}")
        return {"mode": mode, **self._merging(body)}

    def _merging(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return the accepted settings for merging chunks in a request for a session."""
        required = body.get("required_capabilities", [])
        if not isinstance(required, list) or not all(
            isinstance(name, str) and name in MERGES for name in required
        ):
            raise UnsupportedRequest(
                f"required_capabilities: expected only {list(MERGES)}, got {shown(required)}"
            )
        settings = body.get("chunk_settings", {})
        if not isinstance(settings, dict):
            raise MalformedMessage(f"chunk_settings: expected a map, got {shown(settings)}")
        is_aligned = messages.equals(settings.get("chunk_merge"), "aligned")
        if is_aligned != bool(required):
            raise IncompatibleRequest(
                "chunk_settings: expected chunk_merge 'aligned' together with its name in "
                f"required_capabilities, got {shown(settings)} with {shown(required)}"
            )
        if is_aligned and body.get("mode") != _CHUNK:
            raise IncompatibleRequest(
                "chunk_settings: expected chunk_merge 'append' in the modes of real-time "
                "chunking, got 'aligned'"
            )
        return {"chunk_settings": settings} if settings else {}


@dataclass(eq=False, slots=True)
class _Arrived:
    """A message of a robot that waits for its answer.

    Attributes:
        kind: `control`, `obs` or `language`.
        data: The message.
        admission: Counts the message as in flight until it is answered or dropped.
        query: Zenoh's query, which a control message is.
    """

    kind: str
    data: bytes
    admission: MessageAdmission
    query: Any


class RobotSession(GatewayClient):
    """One robot, whose messages are answered in their order on a separate thread.

    Args:
        network: The network of the robot.
        session_id: The id of the session in the protocol.
        terms: The settings of the session, as `Offer.accept` returns them.
    """

    def __init__(self, network: RobotNetwork, session_id: str, terms: Mapping[str, Any]) -> None:
        dialect = network.dialect
        super().__init__(dialect.context)
        # The protocol has no key, which the deployment has accepted.
        self.sessions.show(NoKey.OPEN, None)
        self._network = network
        self._dialect = dialect
        self._session_id = session_id
        self._zenoh = network.zenoh
        self._mode: str = terms["mode"]
        self._is_aligned = terms.get("chunk_settings", {}).get("chunk_merge") == "aligned"
        self._key = f"{dialect.offer.instance_key}/sessions/{session_id}"
        self._generation = 0
        self._last_sequence = -1
        self._is_ready = False  # whether the client has reset the session
        # Whether the robot's liveliness token is present; None if this is not known yet.
        self._is_present: bool | None = None
        self._absent_since = time.monotonic()
        self._inbox: deque[_Arrived] = deque()
        self._changed = threading.Condition()  # guards the inbox
        self._declared: list[Any] = []
        self._ended = threading.Event()
        self._sending = threading.Lock()  # guards the two following values
        self._asked: Envelope | None = None  # the observation that is being answered
        self._is_silent = False  # whether no more answers are sent
        self._thread = threading.Thread(target=self._run, name=f"{dialect.name}-robot", daemon=True)

    def declare(self) -> None:
        """Declare the keys of the session, and begin to answer."""
        session = self._zenoh
        arrive = {
            suffix: direct(partial(self._arrive, kind, f"{self._key}/{suffix}"))
            for suffix, kind in (
                ("control", "control"),
                ("obs", "obs"),
                ("language/request", "language"),
            )
        }
        try:
            self._declared.append(
                session.declare_queryable(
                    f"{self._key}/control", arrive.pop("control"), complete=True
                )
            )
            for suffix, handler in arrive.items():
                self._declared.append(session.declare_subscriber(f"{self._key}/{suffix}", handler))
            self._declared.append(
                session.liveliness().declare_subscriber(
                    f"{self._key}/alive", direct(self._see), history=True
                )
            )
        finally:
            self._thread.start()  # it also undoes the declarations

    def quiet_s(self, now: float) -> float:
        """Return the time for which the robot has been disconnected, s; a connected robot may be
        silent.
        """
        return 0.0 if self._is_present else now - self._absent_since

    def end(self) -> None:
        """End the session after the current action."""
        self._ended.set()
        with self._changed:
            self._changed.notify_all()

    def join(self) -> None:
        """Wait until the session has ended; if an action takes too long, send an error to the
        robot.
        """
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(_END_S)
        with self._sending:
            if self._asked is not None and not self._is_silent:
                stopping = PolicyUnavailable("the server is stopping; connect again")
                answer = self._asked.reply("error", messages.error_body(stopping))
                self._put("act", messages.encode(answer))
            self._is_silent = True

    def _see(self, sample: Any) -> None:
        """Record whether the robot is connected."""
        zenoh = require("zenoh")
        self._is_present = sample.kind == zenoh.SampleKind.PUT
        self._absent_since = time.monotonic()

    def _arrive(self, kind: str, key: str, message: Any) -> None:
        """Keep a message until the robot's thread answers it; called on Zenoh's thread.

        If there is no room, the oldest observation is dropped, as Zenoh does under load. A control
        message is never dropped, but may be answered with an error.
        """
        is_control = kind == "control"
        admission = self._network.admission(self.sessions.account.charge(), self._session_id)
        try:
            limit = self._context.limits.body_bytes if kind == "obs" else _CONTROL_BYTES
            payload = self._network.payload_of(message, key, limit, is_query=is_control)
            with self._changed:
                self._make_room(kind)
                self._receive(admission, 0 if payload is None else len(payload))
                data = b"" if payload is None else payload.to_bytes()
                query = message if is_control else None
                self._inbox.append(_Arrived(kind, data, admission, query))
                self._changed.notify_all()
        except VLAgentsError as error:
            admission.release()
            if is_control:
                reply(message, key, Envelope("error", body=messages.error_body(error)))
            else:
                logger.info("lerobot_remote: dropped a message of a robot: %s", error)

    def _make_room(self, kind: str) -> None:
        """Make room for one more message in the inbox; the caller holds the lock.

        Raises:
            Overloaded: Too many control messages wait.
        """
        if self._ended.is_set():
            raise StaleMessage("session: expected an open session, got one that has ended")
        is_control = kind == "control"
        waiting = [item for item in self._inbox if (item.kind == "control") == is_control]
        if is_control and len(waiting) >= _WAITING_CONTROLS:
            raise Overloaded("too many control messages wait; send one after the other")
        if not is_control and len(waiting) >= _WAITING:
            self._drop(waiting[0])

    def _receive(self, admission: MessageAdmission, size: int) -> None:
        """Count a message as in flight; drop the oldest observations if there is no room for it.

        Raises:
            Overloaded: No observation is left, and there is still no room.
        """
        while True:
            try:
                admission.receive(size)
            except Overloaded:
                if not self.drop_observation():
                    raise
            else:
                return

    def drop_observation(self) -> bool:
        """Drop the oldest observation that waits; return False if there is none."""
        with self._changed:
            for item in self._inbox:
                if item.kind != "control":
                    self._drop(item)
                    return True
        return False

    def _drop(self, item: _Arrived) -> None:
        """Drop a message that waits; the caller holds the lock."""
        self._inbox.remove(item)
        item.admission.release()
        logger.info("lerobot_remote: a robot sends faster than it is answered")

    def _run(self) -> None:
        """Answer the messages of the robot until its session ends."""
        try:
            while True:
                with self._changed:
                    self._changed.wait_for(lambda: self._ended.is_set() or bool(self._inbox))
                    if self._ended.is_set():
                        break
                    item = self._inbox.popleft()
                self._unanswered += 1
                try:
                    self._answer(item)
                finally:
                    self._unanswered -= 1
                    self._used = time.monotonic()
        except Exception:
            logger.exception("lerobot_remote: a session failed")
        finally:
            self._ended.set()
            self._network.forget(self._session_id)
            self._refuse_waiting()
            # The client may have disconnected, which has ended the declarations.
            with contextlib.suppress(require("zenoh").ZError):
                for declared in self._declared:
                    declared.undeclare()
            self.sessions.close()

    def _refuse_waiting(self) -> None:
        """Answer the control messages that still wait with an error, and drop all others."""
        with self._changed:
            waiting = list(self._inbox)
            self._inbox.clear()
        ended = StaleMessage("session: expected an open session, got one that has ended")
        for item in waiting:
            item.admission.release()
            if item.query is not None:
                answer = Envelope("error", body=messages.error_body(ended))
                reply(item.query, f"{self._key}/control", answer)

    def _answer(self, item: _Arrived) -> None:
        """Answer one message."""
        handle = {"control": self._control, "obs": self._act, "language": self._refuse_language}
        request: Envelope | None = None
        admission = item.admission
        try:
            admission.begin_message()
            request = messages.decode(item.data, self._context.limits)
            self._require_current(request)
            answer = handle[item.kind](request, admission)
        except VLAgentsError as error:
            answer = (request or Envelope("error")).reply("error", messages.error_body(error))
        except Exception:  # noqa: BLE001 - logged, and answered
            internal = VLAgentsError(internal_error(self._dialect.name))
            answer = (request or Envelope("error")).reply("error", messages.error_body(internal))
        finally:
            admission.release()

        if item.query is not None:
            reply(item.query, f"{self._key}/control", answer)
            return
        with self._sending:
            self._asked = None
            if not self._is_silent:
                suffix = "act" if item.kind == "obs" else "language/result"
                self._put(suffix, messages.encode(answer))

    def _put(self, suffix: str, data: bytes) -> None:
        """Publish a message at a key of the session."""
        zenoh = require("zenoh")
        with contextlib.suppress(zenoh.ZError):  # the client has disconnected
            self._zenoh.put(
                f"{self._key}/{suffix}", data, congestion_control=zenoh.CongestionControl.DROP
            )

    def _require_current(self, request: Envelope) -> None:
        """Raise `StaleMessage` if a message belongs to another instance or session.

        The error contains no id, since an id is what a client of the session knows.
        """
        expected = self._dialect.offer.instance_id, self._session_id
        if (request.instance_id, request.session_id) != expected:
            raise StaleMessage(
                "instance and session: expected those in the message's key, got others; open a "
                "session again"
            )

    def _control(self, request: Envelope, _admission: MessageAdmission) -> Envelope:
        """Reset, invalidate or close the session."""
        operation = request.body.get("operation")
        operations = ("reset", "invalidate", "close", "status")
        if not isinstance(operation, str) or operation not in operations:
            raise MalformedMessage(
                "operation: expected reset, invalidate, close or status, got "
                f"{shown(operation, 40)}"
            )
        if operation != "close" and request.generation < self._generation:
            raise StaleMessage(
                f"generation: expected at least {self._generation}, got {request.generation}"
            )
        if operation in ("reset", "invalidate"):
            self._generation = request.generation
        if operation == "reset":
            self._is_ready = True
            self.sessions.restart()
        if operation == "close":
            self._ended.set()
        body: dict[str, Any] = {"operation": operation, "applied_generation": request.generation}
        if operation == "status":
            body["session"] = {"owner": self._session_id, "client_present": self._is_present}
        return request.reply("ack", body)

    def _act(self, request: Envelope, admission: MessageAdmission) -> Envelope:
        """Answer an observation with a chunk of actions."""
        body = request.body
        if request.message_type != "observation":
            raise MalformedMessage(
                f"message_type: expected observation, got {request.message_type}"
            )
        if not self._is_ready:
            raise StaleMessage(
                "observation: expected a reset of the session before it, got none; send `reset`"
            )
        if request.generation != self._generation:
            raise StaleMessage(
                f"generation: expected {self._generation}, that of the last reset or "
                f"invalidation, got {request.generation}"
            )
        sequence = body.get("sequence")
        if type(sequence) is not int or sequence <= self._last_sequence:
            raise StaleMessage(
                f"sequence: expected more than {self._last_sequence}, got {shown(sequence)}"
            )
        if not messages.equals(body.get("artifact_identity"), self._dialect.offer.artifact):
            raise IncompatibleRequest(
                f"artifact_identity: expected {self._dialect.offer.artifact!r}, got "
                f"{shown(body.get('artifact_identity'))}"
            )
        plan = self._plan(body)
        if self._is_aligned:
            _require_cursors(body)

        admission.begin("act")
        observation = self._observation(body, admission)
        obs, instruction = self._dialect.mapping.obs(
            observation, self._context.limits, self._context.contract
        )
        if not self.sessions.begun:
            self._dialect.mapping.warn_of_unread_cameras(observation, self._dialect.name)
        self._last_sequence = sequence
        with self._sending:
            self._asked = request
        begun = time.perf_counter()
        obs = replace(obs, info={**obs.info, **plan})
        act = self.sessions.act(admission.charge, obs, instruction)

        offer, contract = self._dialect.offer, self._context.contract
        is_chunk = self._mode == _CHUNK
        steps = offer.execution_steps if is_chunk else offer.prediction_steps
        rows = np.atleast_2d(np.asarray(act.action, np.float32))
        if len(rows) < steps or rows.shape[1] != offer.width:
            raise PolicyFailed(
                f"action: expected ({steps}, {offer.width}), as the deployment offers, got "
                f"{rows.shape}"
            )
        rows = rows[:steps]
        spec = None if contract is None else contract.action
        echoed = [*IDENTITY, "observation_cursor", "cursor"]
        answer = {name: body[name] for name in echoed if name in body}
        answer |= {
            "canonical_actions": self._dialect.mapping.rows(rows, spec),
            # The client keeps these rows for the next request without reading them. They are in
            # the units of the policy, in which the policy reads a plan.
            "model_actions": None if is_chunk else rows,
            "execution_steps": steps,
            "server_durations": {"act_s": time.perf_counter() - begun},
        }
        return request.reply("action", answer)

    def _plan(self, body: Mapping[str, Any]) -> dict[str, Any]:
        """Return the plan that the robot executes as `Obs.info`; empty in mode `chunk`.

        Raises:
            MalformedMessage: The plan has another shape, or the delay another value than the
                deployment offers.
        """
        if self._mode == _CHUNK:
            return {}
        offer = self._dialect.offer
        plan = _continuation(body, "model_continuation", offer)
        canonical = _continuation(body, "canonical_continuation", offer)
        if plan is not None and canonical is not None and len(plan) != len(canonical):
            raise MalformedMessage(
                f"canonical_continuation: expected {len(plan)} rows, as model_continuation has, "
                f"got {len(canonical)}"
            )
        longest = offer.prediction_steps
        if plan is None:
            longest = 0
        elif self._mode == _TRAINED:
            longest = min(offer.longest_prefix, len(plan))
        delay = body.get("delay")
        if type(delay) is not int or not 0 <= delay <= longest:
            raise MalformedMessage(
                f"delay: expected 0 to {longest} ticks in mode {self._mode} with a plan of "
                f"{0 if plan is None else len(plan)} rows, got {shown(delay)}"
            )
        return {} if plan is None else {LEFTOVER: plan, DELAY: min(delay, len(plan))}

    def _observation(self, body: Mapping[str, Any], admission: MessageAdmission) -> dict[str, Any]:
        """Return the features of an observation, decoded and checked, with its task."""
        features = body.get("features")
        if not isinstance(features, dict):
            raise MalformedMessage(f"features: expected a map, got {type(features).__name__}")
        expected = self._dialect.config.features
        if features.keys() != {feature.name for feature in expected}:
            raise IncompatibleRequest(
                f"features: expected {[feature.name for feature in expected]}, got "
                f"{shown(sorted(features))}"
            )
        decoded = messages.decode_images(features, admission)
        for feature in expected:
            _require_feature(feature, decoded[feature.name])
        task = body.get("task")
        if not isinstance(task, str):
            raise MalformedMessage(f"task: expected a text, got {shown(task)}")
        return {**decoded, "task": task}

    @staticmethod
    def _refuse_language(_request: Envelope, _admission: MessageAdmission) -> Envelope:
        """Reject a request for text, since no policy here answers in text."""
        raise UnsupportedRequest("language: this deployment answers with actions only")


def _most_bytes(context: GatewayContext) -> int:
    """Return the number of bytes of the largest message, with the bytes around it."""
    return context.limits.body_bytes + _OVERHEAD_BYTES


def direct(function: Callable[[Any], None]) -> Any:
    """Return a handler that Zenoh calls on its own thread, without a queue."""
    return require("zenoh").handlers.Callback(function, indirect=False)


def reply(query: Any, key: str, answer: Envelope) -> None:
    """Answer a query at a key, and end it; until the end, the client waits for further replies.

    The answer to a query with wildcards does not contain the key.
    """
    data = messages.encode(answer)
    with contextlib.suppress(require("zenoh").ZError):  # the client has disconnected
        if str(query.key_expr) == key:
            query.reply(key, data)
        else:
            query.reply_err(data)
        query.drop()


def _continuation(body: Mapping[str, Any], name: str, offer: Offer) -> np.ndarray | None:
    """Return a plan in an observation, (H, D) float32, with at most as many rows as a chunk; None
    if the robot has no plan.
    """
    plan = body.get(name)
    if plan is None:
        return None
    if (
        not isinstance(plan, np.ndarray)
        or plan.dtype.name != "float32"
        or plan.ndim != 2
        or plan.shape[1] != offer.width
        or len(plan) > offer.prediction_steps
    ):
        raise MalformedMessage(
            f"{name}: expected (up to {offer.prediction_steps}, {offer.width}) float32, got "
            f"{shown(plan)}"
        )
    return plan


def _require_cursors(body: Mapping[str, Any]) -> None:
    """Raise `MalformedMessage` if an observation has no valid position at which its chunk is
    merged.
    """
    observed, requested = body.get("observation_cursor"), body.get("cursor")
    if (
        type(observed) is not int
        or type(requested) is not int
        or not 0 <= observed <= requested < 2**63
    ):
        raise MalformedMessage(
            "observation_cursor, cursor: expected two numbers of executed actions, the first not "
            f"above the second, got {shown(observed)} and {shown(requested)}"
        )


def _require_feature(feature: Feature, value: Any) -> None:
    """Raise `IncompatibleRequest` if the shape or type of a feature differs from the
    deployment's.
    """
    shape: Sequence[int] | None = getattr(value, "shape", None)
    if shape is None or list(shape) != feature.shape or value.dtype.name != feature.dtype:
        raise IncompatibleRequest(
            f"{feature.name}: expected {feature.dtype} {feature.shape}, got {shown(value)}"
        )
