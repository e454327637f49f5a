"""Serves LeRobot's asynchronous inference over gRPC: a session for each connection of a robot
client.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from vlagents_ray.errors import (
    InvalidInput,
    MalformedMessage,
    MessageTooLarge,
    NotReset,
    PolicyUnavailable,
    VLAgentsError,
)
from vlagents_ray.interface import Obs
from vlagents_ray.registry import require
from vlagents_ray.serve.access.api_keys import NoKey
from vlagents_ray.serve.config.dialects import KeylessPortConfig, MappingSetting
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.wire.mapping import KeyMapping
from vlagents_ray_dialects.acceptor import Acceptor
from vlagents_ray_dialects.gateway_sessions import GatewayClient, GatewayClients, internal_error
from vlagents_ray_dialects.http2_front import Http2Front
from vlagents_ray_dialects.messages import lerobot
from vlagents_ray_dialects.messages.lerobot import (
    PRESETS,
    PolicyInstructions,
    RobotObservation,
    TransferState,
)

logger = logging.getLogger(__name__)

# The time for which a request for actions waits for an observation, as in LeRobot's own server.
_WAIT_S = 2.0
# The rate of the actions' timestamps if the policy's contract has none, as in LeRobot's own server.
_HZ = 30.0
_UPLOAD_S = 30.0  # maximum time from the first piece of an observation to the last
_END_S = 3.0  # maximum time for the answers to requests when the dialect ends
# Maximum number of concurrent requests of one client; LeRobot's client sends at most two.
_REQUESTS = 4
_HEARTBEAT_MS = 10_000  # the period of gRPC's pings, and their time limit
# Maximum number of characters of an error, which gRPC sends in a header of at most 8 KiB.
_DETAILS = 500
# The names of gRPC's status codes by HTTP status. Clients repeat a request after UNAVAILABLE or
# DEADLINE_EXCEEDED.
_STATUS = {
    400: "INVALID_ARGUMENT",
    403: "PERMISSION_DENIED",
    404: "NOT_FOUND",
    409: "FAILED_PRECONDITION",
    413: "RESOURCE_EXHAUSTED",
    422: "INVALID_ARGUMENT",
    429: "RESOURCE_EXHAUSTED",
    503: "UNAVAILABLE",
    504: "DEADLINE_EXCEEDED",
}


@dataclass(slots=True)
class _Waiting:
    """An observation that the policy has not received yet."""

    observation: RobotObservation
    robot: PolicyInstructions
    obs: Obs  # the same observation, under the policy's names for cameras and state
    instruction: str | None
    admission: MessageAdmission


class LeRobotConnection(GatewayClient):
    """One client since its `Ready`. Its requests arrive on several threads; only one thread at a
    time uses the session.

    Args:
        context: The context of the gateway.
        mapping: The mapping of the client's names.
        checkpoint: The checkpoint that the client must name; None accepts any.
    """

    def __init__(
        self, context: GatewayContext, mapping: KeyMapping, checkpoint: str | None
    ) -> None:
        super().__init__(context)
        self._mapping = mapping
        self._checkpoint = checkpoint
        # The protocol has no key, which the deployment has accepted.
        self.sessions.show(NoKey.OPEN, None)

        self._robot: PolicyInstructions | None = None
        self._acted = -1  # the time step of the last observation that the policy received
        self._waiting: _Waiting | None = None
        self._arrival = threading.Condition()
        self._acting = threading.Lock()
        self._ended = False

    @contextmanager
    def request(self) -> Iterator[LeRobotConnection]:
        """Count a request as unanswered within the context, and yield the client."""
        with self._arrival:
            self._unanswered += 1
        try:
            yield self
        finally:
            with self._arrival:
                self._unanswered -= 1
                self._used = time.monotonic()

    def set_up(self, robot: PolicyInstructions) -> None:
        """Set the policy instructions of the client.

        Raises:
            InvalidInput: The policy instructions name another checkpoint than the deployment.
        """
        if self._checkpoint not in (None, robot.checkpoint):
            raise InvalidInput(
                f"pretrained_name_or_path: expected {self._checkpoint!r}, the checkpoint of this "
                f"server, got {robot.checkpoint[:80]!r}; start the client with the first"
            )
        logger.info(
            "lerobot: a client of %r %r begins", robot.policy_type[:80], robot.checkpoint[:80]
        )
        self._robot = robot

    def observe(self, data: bytes, admission: MessageAdmission) -> None:
        """Store an observation for the next request of actions, in place of an earlier one that the
        policy has not received yet.

        An observation is ignored if the policy has already received one of the same time step,
        unless the client has no action left.

        Args:
            data: The pickle with the observation.
            admission: The admission of the pickle, which is released when the observation is
                dropped or the policy has answered.

        Raises:
            NotReset: The client has sent no policy instructions.
        """
        if self._robot is None:
            raise NotReset(
                "SendPolicyInstructions: expected one after Ready, got none; start the client again"
            )

        admission.begin("act")
        observation = lerobot.read_observation(data, admission)
        if observation.timestep <= self._acted and not observation.must_go:
            return

        theirs = lerobot.frame(observation, self._robot)
        obs, instruction = self._mapping.obs(theirs, self._context.limits, self._context.contract)
        if not self.sessions.begun:
            self._mapping.warn_of_unread_cameras(theirs, "lerobot")

        waiting = _Waiting(observation, self._robot, obs, instruction, admission)
        with self._arrival:
            replaced, self._waiting = self._waiting, waiting
            self._arrival.notify()
        if replaced is not None:
            replaced.admission.release()

    def actions(self) -> bytes | None:
        """Return the pickled actions for the newest observation; None if no observation arrives
        within two seconds.
        """
        deadline = time.monotonic() + _WAIT_S
        if not self._acting.acquire(timeout=_WAIT_S):
            return None
        try:
            with self._arrival:
                self._arrival.wait_for(
                    lambda: self._waiting or self._ended, deadline - time.monotonic()
                )
                waiting, self._waiting = self._waiting, None
            return None if waiting is None or self._ended else self._act(waiting)
        finally:
            self._acting.release()
            if self._ended:
                self.end()

    def end(self) -> None:
        """Drop the waiting observation, and end the session, after the current action if there is
        one.
        """
        with self._arrival:
            self._ended = True
            self._waiting = None
            self._arrival.notify_all()
        if self._acting.acquire(blocking=False):
            try:
                self.sessions.close()
            except Exception:
                logger.exception("lerobot: a session did not end")
            finally:
                self._acting.release()

    def _act(self, waiting: _Waiting) -> bytes:
        """Return the pickled actions for an observation."""
        contract = self._context.contract
        observation = waiting.observation
        last_acted = self._acted
        self._acted = max(last_acted, observation.timestep)
        try:
            act = self.sessions.act(waiting.admission.charge, waiting.obs, waiting.instruction)
        except BaseException:
            # The client's next observation of this time step must reach the policy.
            self._acted = last_acted
            raise
        finally:
            waiting.admission.release()

        spec = None if contract is None else contract.action
        rows: np.ndarray = self._mapping.rows(act.action, spec)
        chunk = rows[: waiting.robot.actions_per_chunk]
        hz = (contract and contract.control_hz) or _HZ
        return lerobot.write_chunk(chunk, observation.timestamp, observation.timestep, 1 / hz)


class LeRobotDialectConfig(KeylessPortConfig):
    """The settings of LeRobot's asynchronous inference, the protocol of its `RobotClient`."""

    mapping: MappingSetting = "lerobot"
    port: int = Field(default=8080, ge=1, le=65535)
    checkpoint: str | None = Field(
        default=None,
        description="The `pretrained_name_or_path` that clients must name. null: any, as clients "
        "use the policy of the deployment.",
    )


class LeRobotDialect(PortDialect):
    """LeRobot's gRPC service; gRPC's threads process the requests, which arrive through an
    `Http2Front`.
    """

    Config = LeRobotDialectConfig
    clients = "LeRobot"
    summary = (
        "A session is the connection, until it is idle or ends; an episode begins with `Ready` and "
        "with each new task. The newest observation is acted on. Pickles are read as data: "
        "numbers, texts and numpy arrays."
    )
    scheme = "grpc"
    requires = ("grpc",)
    presets: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    config: LeRobotDialectConfig

    def __init__(self, name: str, config: LeRobotDialectConfig, context: GatewayContext) -> None:
        super().__init__(name, config, context)
        self._clients: GatewayClients[str, LeRobotConnection] = GatewayClients(context)
        # The time at which the reception of each observation began, s, by gRPC's context.
        self._uploads: dict[Any, float] = {}
        self._server: Any = None
        self._front: Http2Front | None = None
        self._acceptor: Acceptor | None = None
        self._closing = threading.Event()

    def serve(self, listener: socket.socket) -> None:
        """Start gRPC's server, and accept the connections of clients at `listener`."""
        grpc = require("grpc")

        # The methods read and write plain bytes.
        unary = grpc.unary_unary_rpc_method_handler
        stream = grpc.stream_unary_rpc_method_handler
        methods = {
            "Ready": unary(partial(self._answer, grpc, self._ready)),
            "SendPolicyInstructions": unary(partial(self._answer, grpc, self._set_up)),
            "SendObservations": stream(partial(self._answer, grpc, self._observe)),
            "GetActions": unary(partial(self._answer, grpc, self._act)),
        }

        max_requests = _REQUESTS * self.context.sessions
        self._server = grpc.server(
            ThreadPoolExecutor(max_requests, "lerobot-client"),
            handlers=[grpc.method_handlers_generic_handler(lerobot.SERVICE, methods)],
            options=[
                ("grpc.max_concurrent_streams", _REQUESTS),
                ("grpc.max_connection_idle_ms", int(1e3 * self.context.idle_s)),
                ("grpc.server_handshake_timeout_ms", _HEARTBEAT_MS),
                ("grpc.keepalive_time_ms", _HEARTBEAT_MS),
                ("grpc.keepalive_timeout_ms", _HEARTBEAT_MS),
                # gRPC would decompress a compressed message regardless of its size.
                ("grpc.compression_enabled_algorithms_bitset", 1),
            ],
            maximum_concurrent_rpcs=max_requests,
        )

        self._front = Http2Front(
            self.name, lambda peer: self._clients.get(peer) is not None, self._clients.end
        )
        self._server.add_insecure_port(self._front.address)
        self._server.start()
        self._acceptor = Acceptor(self.name, listener, self._front.add, self._check_clients)

    def alive(self) -> bool:
        return self._acceptor is not None and self._acceptor.alive()

    def close(self) -> None:
        """Reject further requests, answer those that have arrived, and end all sessions."""
        self._closing.set()
        if self._acceptor is not None:
            self._acceptor.close()

        # gRPC's server ends the requests that remain after `_END_S`.
        stopped = None if self._server is None else self._server.stop(_END_S)
        self._clients.end_all()
        if stopped is not None:
            stopped.wait()
        if self._front is not None:
            self._front.close()

    def _answer(
        self, grpc: Any, method: Callable[[Any, Any], bytes | None], request: Any, context: Any
    ) -> bytes:
        """Return the reply to a request, or end the request with gRPC's status for the error."""
        try:
            return method(request, context) or lerobot.EMPTY
        except VLAgentsError as error:
            status, text = _STATUS.get(error.status, "INTERNAL"), f"{error.code}: {error}"
        except Exception as error:  # noqa: BLE001 - logged, and answered
            if isinstance(error, grpc.RpcError):  # the client has disconnected
                return lerobot.EMPTY
            status, text = "INTERNAL", internal_error("lerobot")
        context.abort(getattr(grpc.StatusCode, status), text[:_DETAILS])
        raise AssertionError  # abort raises

    def _ready(self, _: bytes, context: Any) -> None:
        """Handle `Ready`: add a client."""
        if self._closing.is_set():
            raise _stopping()
        make = partial(LeRobotConnection, self.context, self.mapping, self.config.checkpoint)
        self._clients.add(context.peer(), make)

    def _set_up(self, message: bytes, context: Any) -> None:
        """Handle `SendPolicyInstructions`."""
        with self._request(context) as client:
            data = lerobot.read_data(message)
            if data is None:
                raise MalformedMessage("policy instructions: expected them, got none")
            client.set_up(lerobot.read_instructions(data, self.context.limits))

    def _observe(self, messages: Iterator[bytes], context: Any) -> None:
        """Handle `SendObservations`, a stream of messages with one observation."""
        with self._request(context) as client:
            robot = self.config.priority == "robot"
            admission = MessageAdmission(
                self.context.admission,
                self.context.limits,
                client.sessions.account.charge(),
                robot=robot,
                inline=False,
                share=self._share_of(context),
            )
            self._uploads[context] = time.monotonic()
            try:
                data = _joined(messages, admission)
            finally:
                del self._uploads[context]
            client.observe(data, admission)

    def _act(self, _: bytes, context: Any) -> bytes | None:
        """Handle `GetActions`; return None if there is no observation."""
        with self._request(context) as client:
            actions = client.actions()
        if actions is None and self._closing.is_set():
            raise _stopping()
        return None if actions is None else lerobot.write_data(actions)

    def _share_of(self, context: Any) -> str:
        """Return the name under which the bytes in flight of a client without a key are counted."""
        return "address unknown" if self._front is None else self._front.share_of(context.peer())

    def _request(self, context: Any) -> AbstractContextManager[LeRobotConnection]:
        """Return the context of a request, with its client, identified by its connection."""
        client = self._clients.get(context.peer())
        if client is None:
            raise NotReset(
                "Ready: expected one over this connection, got none, or it was idle for too long; "
                "start the client again"
            )
        return client.request()

    def _check_clients(self) -> None:
        """Remove idle clients, and cancel observations that take too long to arrive."""
        self._clients.forget_quiet()
        earliest_begin = time.monotonic() - _UPLOAD_S
        for context, begun in list(self._uploads.items()):
            if begun < earliest_begin:
                context.cancel()


def _stopping() -> PolicyUnavailable:
    """Return the error of a request that arrives while the server stops."""
    return PolicyUnavailable("the server is stopping; connect again")


def _joined(messages: Iterator[bytes], admission: MessageAdmission) -> bytes:
    """Return a pickle that arrives in several messages; each message is counted when it arrives."""
    pieces: list[memoryview] = []
    size = 0
    limit = admission.limits.body_bytes
    for message in messages:
        state, data = lerobot.read_observation_part(message)
        if state is TransferState.BEGIN and pieces:
            raise MalformedMessage("observation: begins twice")
        size += len(data)
        if size > limit:
            raise MessageTooLarge(
                f"observation: more than {limit} bytes; send smaller images, or raise `limits`"
            )
        admission.receive(len(data))
        pieces.append(data)
        if state is TransferState.END:
            return b"".join(pieces)
    raise MalformedMessage("observation: ended before its last part")
