"""Serves XPolicyLab's clients over WebSocket, such as RoboDojo: they send `reset` before an
episode, and observations of one environment or of several.

A client of the first generation sends an observation with `infer`, and receives a chunk. A client
of the second generation sends `call`: `update_obs` with an observation, which waits until
`get_action` requests its chunk, and another `update_obs` after each executed row. Only the newest
observation is decoded, and only `get_action` calls the policy.

A client that has lost its connection connects again, and repeats its last message with the same
`message_id`. An answered request for actions is not executed again: its answer is kept for a while.
Clients may number their messages, so an answer is only repeated for the same content in the same
step of the same trial, and never while the client that got it first is still connected.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import uuid
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
from starlette.websockets import WebSocket

from vlagents_ray.errors import (
    InvalidObservation,
    MalformedMessage,
    MessageTooLarge,
    Overloaded,
    PolicyUnavailable,
    TooManyRequests,
    VLAgentsError,
    shown,
)
from vlagents_ray.protocol.messages import PriorityName, Reply
from vlagents_ray.serve.access.api_keys import Identity, current_caller
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects import base
from vlagents_ray.serve.endpoints.client_socket import current_client
from vlagents_ray.serve.endpoints.http_messages import public_problem
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import IncomingMessage
from vlagents_ray_dialects.messages import xpolicylab
from vlagents_ray_dialects.messages.xpolicylab import NO_FRAME, PRESETS, Frame

# Kept answers, for clients that repeat a message soon: their maximum number, and their maximum size
# in bytes.
_KEPT_ANSWERS, _KEPT_BYTES = 256, 16 * 2**20
# The keys in the metadata of replicas that identify the policy of a deployment.
_IDENTITY = ("cluster", "policy", "checkpoint", "config", "program", "version")
# The caller, the ids of evaluation, case and trial with their numbers, and the id of a message.
_MessageKey = tuple[Identity, tuple[Any, ...], str]
_METHODS = ("update_obs", "get_action", "update_obs_batch", "get_action_batch")


class XPolicyLabDialectConfig(DialectConfig):
    """The settings of XPolicyLab's clients."""

    mapping: MappingSetting = "xpolicylab"
    priority: PriorityName = "simulation"


class XPolicyLabDialect(base.RouteDialect):
    """XPolicyLab's protocol, in which the client resets the episodes of all its environments."""

    Config = XPolicyLabDialectConfig
    clients = "XPolicyLab and RoboDojo"
    summary = (
        "Each `env_idx` of a connection is a session; `reset` begins their episodes, as does a new "
        "instruction. An error is an `error` message."
    )
    paths: ClassVar[Mapping[str, str]] = {"WS /xpolicylab": "stream"}
    root = "xpolicylab"
    presets = PRESETS
    config: XPolicyLabDialectConfig

    def __init__(self, name: str, config: DialectConfig, context: base.ReplicaContext) -> None:
        super().__init__(name, config, context)
        self.answers = _AnswersOfActs()

    def at_root(self, sharing: Sequence[XPolicyLabDialect]) -> base.Stream:
        """Serve WebSockets at the server's root; no other dialect has this protocol there."""
        return self.stream

    async def stream(self, socket: WebSocket) -> None:
        """Serve one connection; its sessions end with it."""
        if not await base.accept_or_refuse(socket, self.context):
            return

        connection = _Connection(self)
        try:
            await self.answer_messages(socket, connection.answer)
        finally:
            connection.close()

    def server_instance_id(self) -> str:
        """Return the id of the deployment, which is equal at all its replicas.

        A client ends its evaluation if the id changes, so the id changes with the policy and when
        the server restarts, but not with the replica.
        """
        metadata = self.context.metadata()
        identity = {name: metadata.get(name) for name in _IDENTITY}
        text = json.dumps(identity, sort_keys=True, default=str)
        return hashlib.sha256(text.encode()).hexdigest()[:32]


@dataclass(eq=False, slots=True)
class _KeptAnswer:
    """The answer to a message of one connection.

    Attributes:
        connection: The connection on which the message arrived.
        digest: The digest of the message's content without an observation.
        observed: The digest of the observations of the act.
        over: Completed when the message is answered or has failed.
        data: The answer; None until the message is answered.
    """

    connection: _Connection
    digest: bytes
    observed: bytes
    over: asyncio.Future[None]
    data: bytes | None = None

    def answers(self, connection: _Connection, digest: bytes, observed: bytes) -> bool:
        """Return whether this is the answer to a message of a connection with such content.

        A client that has connected again may have no observation: it repeats only its last message.
        """
        if digest != self.digest or (observed and observed != self.observed):
            return False
        return self.connection is connection or self.connection.has_ended


class _AnswersOfActs:
    """The newest answers to requests for actions, for clients that repeat a message after a lost
    connection.

    The names in a message are chosen by its client, and two clients may choose equal names. A
    client therefore gets only the answers of its own connection, or of a connection of the same
    caller that has ended, and only to a message with the same content.
    """

    def __init__(self) -> None:
        # The newest answer is the last.
        self._answers: OrderedDict[tuple[_MessageKey, _Connection], _KeptAnswer] = OrderedDict()
        # The connections that have used a name.
        self._connections: dict[_MessageKey, dict[_Connection, None]] = {}
        self._bytes = 0

    async def answer_once(
        self,
        connection: _Connection,
        frame: Frame,
        observed: bytes,
        act: Callable[[], Awaitable[bytes]],
    ) -> bytes:
        """Return the answer to a message: the answer of `act`, or the kept answer if the message
        was answered before.

        A message that is repeated while it is being answered waits for that answer. If the first
        message was not answered, as its client had disconnected before the act began, the act is
        executed now.

        Args:
            connection: The connection on which the message arrived.
            frame: The message.
            observed: The digest of the observations on which it acts; empty if there are none.
            act: Executes the message.

        Raises:
            MalformedMessage: The connection has used the id for another message.
        """
        key = (current_caller(), tuple(frame.labels.values()), frame.message_id)
        other = {name: value for name, value in frame.payload.items() if name != "observation"}
        digest = xpolicylab.digest(other)
        kept = self._find(key, connection, digest, observed)
        while kept is not None:
            await asyncio.shield(kept.over)
            if kept.data is not None:
                return kept.data
            kept = self._find(key, connection, digest, observed)

        over: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        answer = _KeptAnswer(connection, digest, observed, over)
        self._answers[key, connection] = answer
        self._connections.setdefault(key, {})[connection] = None
        try:
            answer.data = await act()
        except BaseException:
            self._forget(key, connection)
            raise
        finally:
            over.set_result(None)

        if self._answers.get((key, connection)) is answer:  # not forgotten by a reset meanwhile
            self._bytes += len(answer.data)
            self._answers.move_to_end((key, connection))
            self._forget_oldest()
        return answer.data

    def forget_evaluation(self, connection: _Connection, evaluation: str) -> None:
        """Forget the answers of an evaluation that a client begins again, except those of other
        connected clients.
        """
        caller = current_caller()
        for key, sender in list(self._answers):
            is_of_client = sender is connection or sender.has_ended
            if is_of_client and key[0] == caller and key[1][0] == evaluation:
                self._forget(key, sender)

    def _find(
        self, key: _MessageKey, connection: _Connection, digest: bytes, observed: bytes
    ) -> _KeptAnswer | None:
        """Return the answer to a repeated message; None if the message is new."""
        own = self._answers.get((key, connection))
        if own is not None:
            if own.answers(connection, digest, observed):
                return own
            raise MalformedMessage(
                f"message_id: expected a new id for each message of a step, got {key[2]!r} for two "
                "different messages; count up, or draw random ids"
            )
        for sender in self._connections.get(key, ()):
            kept = self._answers[key, sender]
            if kept.answers(connection, digest, observed):
                return kept
        return None

    def _forget_oldest(self) -> None:
        """Forget the oldest answers if there are too many."""
        for (key, sender), answer in list(self._answers.items()):
            if len(self._answers) <= _KEPT_ANSWERS and self._bytes <= _KEPT_BYTES:
                return
            if answer.data is not None:
                self._forget(key, sender)

    def _forget(self, key: _MessageKey, connection: _Connection) -> None:
        """Forget an answer, if it is still kept."""
        answer = self._answers.pop((key, connection), None)
        if answer is None:
            return
        self._bytes -= len(answer.data or b"")
        del self._connections[key][connection]
        if not self._connections[key]:
            del self._connections[key]


class _UpdateMessage:
    """A message with the newest observations of environments.

    The message counts as in flight until none of its observations waits for an act any more.

    Args:
        admission: The admission of the message.
        waiting: The number of observations in the message.
    """

    def __init__(self, admission: MessageAdmission, waiting: int) -> None:
        self.admission = admission
        self._waiting = waiting

    def drop(self) -> None:
        """Drop one of the observations."""
        self._waiting -= 1
        if not self._waiting:
            self.admission.release()


@dataclass(frozen=True, slots=True)
class _Observation:
    """An observation whose images are not decoded yet, and the message that contained it."""

    content: dict[str, Any]
    message: _UpdateMessage


@dataclass(slots=True)
class _Environment:
    """An environment of a client: its session, and the observation that waits for an act."""

    session: base.ImplicitSession
    observation: _Observation | None = None

    def update(self, observation: _Observation | None) -> None:
        """Replace the observation."""
        if self.observation is not None:
            self.observation.message.drop()
        self.observation = observation


class _Connection:
    """A WebSocket of a client, with its environments.

    Args:
        dialect: The dialect.
    """

    def __init__(self, dialect: XPolicyLabDialect) -> None:
        self._dialect = dialect
        self._sender: Sender = dialect.sender()
        self._environments: dict[int, _Environment] = {}
        self._updated: list[int] = []  # the environments of the last update
        self._has_left = current_client()
        self._is_closed = False

    @property
    def has_ended(self) -> bool:
        """Whether the client has closed the connection."""
        return self._is_closed or (self._has_left is not None and self._has_left())

    def close(self) -> None:
        """End the sessions."""
        self._is_closed = True
        self._drop_observations()
        self._sender.release(for_good=True)

    async def answer(
        self, socket: WebSocket, data: bytes | None, admission: MessageAdmission
    ) -> bool:
        """Answer one message; return False if the connection was closed.

        Args:
            socket: The connection.
            data: The message; None for a text.
            admission: The admission of the message, which is released unless its observations
                wait.
        """
        dialect = self._dialect
        message = dialect.arrived(admission.charge)
        request_id = uuid.uuid4().hex
        frame = NO_FRAME
        try:
            frame = await base.decoded(xpolicylab.decode, data, admission)
            frame.require_valid()
            if frame.kind == xpolicylab.CLOSE:
                await socket.close()
                return False
            answer = await self._answer(frame, message, admission, request_id)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            problem = public_problem(error, dialect.name, request_id)
            dialect.record_failure(message, problem)
            return await self._report(socket, frame, problem, request_id)
        finally:
            if not self._waits(admission):
                admission.release()

        await socket.send_bytes(answer)
        return True

    async def _report(
        self, socket: WebSocket, frame: Frame, problem: VLAgentsError, request_id: str
    ) -> bool:
        """Send an error, or end the connection so that the client repeats its message. Return
        whether the connection stays open.
        """
        # A client repeats an unanswered message once, over a new connection.
        if isinstance(problem, PolicyUnavailable):
            await base.close_after_error(socket, problem)
            return False

        await socket.send_bytes(xpolicylab.error_answer(frame, problem, request_id))
        # The message was not read, so the client does not know which one this error answers.
        if frame is NO_FRAME and isinstance(problem, TooManyRequests | Overloaded):
            await socket.close(base.TRY_AGAIN_LATER, str(problem)[:120])
            return False
        return True

    async def _answer(
        self, frame: Frame, message: IncomingMessage, admission: MessageAdmission, request_id: str
    ) -> bytes:
        """Return the answer to a message."""
        payload: dict[str, Any] = {"ok": True}
        if frame.kind == "hello":
            payload["server"] = "vlagents-ray"
            payload["server_instance_id"] = self._dialect.server_instance_id()
        elif frame.kind == "reset":
            self._begin_episodes()
            self._dialect.answers.forget_evaluation(self, frame.labels["evaluation_id"])
        elif frame.kind == "infer":
            return await self._infer(frame, message, admission, request_id)
        elif frame.kind == "call":
            return await self._call(frame, message, admission, request_id)
        return xpolicylab.answer(frame, payload)

    def _begin_episodes(self) -> None:
        """Begin the episode of each environment with its next observation."""
        self._drop_observations()
        for environment in self._environments.values():
            environment.session.episode.end()

    def _drop_observations(self) -> None:
        """Drop the observations that wait for an act."""
        self._updated = []
        for environment in self._environments.values():
            environment.update(None)

    def _waits(self, admission: MessageAdmission) -> bool:
        """Return whether an observation of a message waits for an act."""
        return any(
            environment.observation is not None
            and environment.observation.message.admission is admission
            for environment in self._environments.values()
        )

    async def _infer(
        self, frame: Frame, message: IncomingMessage, admission: MessageAdmission, request_id: str
    ) -> bytes:
        """Answer an observation with its chunk."""
        observation = xpolicylab.require_observation(frame.payload.get("observation"))
        index = xpolicylab.environment_of(observation)
        self._update([index], [observation], admission)
        try:
            return await self._act([index], frame, message, request_id)
        finally:
            self._environments[index].update(None)

    async def _call(
        self, frame: Frame, message: IncomingMessage, admission: MessageAdmission, request_id: str
    ) -> bytes:
        """Answer the call of a method."""
        method, value = frame.payload.get("func_name"), frame.payload.get("obs")
        if not isinstance(method, str) or method not in _METHODS:  # the argument may be an array
            raise MalformedMessage(
                f"func_name: expected one of {list(_METHODS)}, got {shown(method)}; this server "
                "has no other methods of a policy"
            )
        if method == "get_action":
            return await self._act(self._updated[-1:], frame, message, request_id)
        if method == "get_action_batch":
            return await self._act(self._indices(value), frame, message, request_id)

        if method == "update_obs":
            observations = [xpolicylab.require_observation(value)]
        else:
            observations = xpolicylab.batch_of(value, self._dialect.context.limits.requests)
        indices = []
        for position, observation in enumerate(observations):
            indices.append(xpolicylab.environment_of(observation, position))
        self._update(indices, observations, admission)
        return xpolicylab.answer(frame, {"ok": True, "latency_ms": 0.0})

    def _indices(self, value: Any) -> list[int]:
        """Return the environments that `get_action_batch` names, by default the environments of the
        last update.
        """
        if value is None:
            return self._updated
        values = value.tolist() if hasattr(value, "tolist") else value
        if not isinstance(values, list):
            raise MalformedMessage(f"obs: expected a list of env_idx, got {shown(value)}")
        return [xpolicylab.environment_index(item) for item in values]

    def _update(
        self,
        indices: list[int],
        observations: Sequence[dict[str, Any]],
        admission: MessageAdmission,
    ) -> None:
        """Keep the newest observations of environments until their acts.

        Raises:
            MalformedMessage: An environment has two observations.
            MessageTooLarge: The connection has too many environments.
        """
        if len(set(indices)) != len(indices):
            raise MalformedMessage(f"env_idx: expected each index only once, got {shown(indices)}")
        most = self._dialect.context.limits.requests
        number = len(self._environments.keys() | set(indices))
        if number > most:
            raise MessageTooLarge(
                f"env_idx: expected at most {most} environments of a connection, got {number}; "
                "connect again"
            )

        message = _UpdateMessage(admission, len(observations))
        for index, observation in zip(indices, observations, strict=True):
            environment = self._environments.get(index)
            if environment is None:
                session = self._dialect.session(self._sender, uuid.uuid4().hex)
                environment = self._environments[index] = _Environment(session)
            environment.update(_Observation(observation, message))
        self._updated = indices

    async def _act(
        self, indices: list[int], frame: Frame, message: IncomingMessage, request_id: str
    ) -> bytes:
        """Answer with the chunks of environments; a repeated message gets its first answer."""
        act = partial(self._act_together, indices, frame, message, request_id)
        answers = self._dialect.answers
        answer = await answers.answer_once(self, frame, self._observed(indices), act)
        for index in indices:
            environment = self._environments.get(index)
            if environment is not None:
                environment.update(None)
        return answer

    async def _act_together(
        self, indices: list[int], frame: Frame, message: IncomingMessage, request_id: str
    ) -> bytes:
        """Return the answer with the chunks of environments, whose requests are queued together."""
        dialect = self._dialect
        environments = self._waiting(indices)
        if message.charge is not None:
            message.charge.cover(len(environments))

        contents = await _decoded([observation for _, observation in environments])
        session_inputs = []
        for (session, _), content in zip(environments, contents, strict=True):
            if not session.episode.begun:
                dialect.mapping.warn_of_unread_cameras(content, dialect.name)
            obs, instruction = dialect.read(content)
            session_inputs.append(base.SessionObs(session, obs, instruction))
        message.decoded_alike(len(session_inputs))

        replies = await base.act_together(message, session_inputs, request_id, self._columns)
        return dialect.encoded(message, partial(self._chunks, frame, replies))

    def _observed(self, indices: list[int]) -> bytes:
        """Return the digest of the observations of environments that wait for an act; empty if
        there are none.
        """
        contents = {}
        for index in indices:
            environment = self._environments.get(index)
            if environment is not None and environment.observation is not None:
                contents[str(index)] = environment.observation.content
        return xpolicylab.digest(contents) if contents else b""

    def _waiting(self, indices: list[int]) -> list[tuple[base.ImplicitSession, _Observation]]:
        """Return the sessions of environments, with the observations that wait for an act.

        Raises:
            InvalidObservation: No environment is named, or a named environment has no observation.
            MalformedMessage: An environment is named twice.
        """
        if len(set(indices)) != len(indices):
            raise MalformedMessage(f"env_idx: expected each index only once, got {shown(indices)}")

        waiting = []
        missing = [] if indices else ["any environment"]
        for index in indices:
            environment = self._environments.get(index)
            if environment is None or environment.observation is None:
                missing.append(f"environment {index}")
            else:
                waiting.append((environment.session, environment.observation))
        if missing:
            raise InvalidObservation(
                f"get_action: expected an observation of {missing[0]} over this connection, after "
                "its last act, got none; send update_obs or update_obs_batch first"
            )
        return waiting

    def _columns(self, reply: Reply) -> Mapping[str, np.ndarray]:
        """Return the columns of the action in a reply by the client's names."""
        rows = self._dialect.rows(reply)
        return self._dialect.mapping.columns(rows) or {"actions": rows}

    def _chunks(self, frame: Frame, replies: Sequence[Reply]) -> bytes:
        """Return the answer with the chunk of each environment."""
        chunks = [xpolicylab.action_maps(self._columns(reply)) for reply in replies]

        latency_ms = 0.0
        for reply in replies:
            latency_ms = max(latency_ms, reply.timing["queue_ms"] + reply.timing["inference_ms"])
        if frame.kind == "infer":
            return xpolicylab.answer(frame, {"actions": chunks[0], "latency_ms": latency_ms})
        is_batch = frame.payload.get("func_name") == "get_action_batch"
        result = chunks if is_batch else chunks[0]
        return xpolicylab.answer(frame, {"ok": True, "result": result, "latency_ms": latency_ms})


async def _decoded(observations: Sequence[_Observation]) -> list[dict[str, Any]]:
    """Decode the images of observations; the images of one message share its budget."""
    by_message: dict[_UpdateMessage, list[int]] = {}
    for position, observation in enumerate(observations):
        by_message.setdefault(observation.message, []).append(position)

    contents: list[dict[str, Any]] = [{}] * len(observations)
    for message, positions in by_message.items():
        encoded = [observations[position].content for position in positions]
        read = partial(xpolicylab.read_observations, encoded)
        decoded = await message.admission.decoded(read)
        for position, content in zip(positions, decoded, strict=True):
            contents[position] = content
    return contents
