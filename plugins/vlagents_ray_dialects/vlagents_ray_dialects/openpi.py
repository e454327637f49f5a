"""Serves openpi's and RoboArena's clients over WebSocket: requests and replies are binary maps, and
the server sends the first message.

RoboArena's clients use nearly the same protocol and also connect to the root. A server may have
both dialects: RoboArena's requests contain an `endpoint`, openpi's do not. The first message is
then RoboArena's configuration, which openpi's client reads as metadata.

An error is a text with a request id, after which the connection is closed (1011) except for 429;
openpi's own server sends a traceback.

A batch, `{"batch": [observation, ...]}`, has the form of openpi's pull request 941 (its head
5bdadc8), which was open when this was written: the reply is one map, whose `actions` are stacked.
openpi's own client sends nothing when it is reset; its derivatives send `{"reset": True}`.
"""

from __future__ import annotations

import abc
import time
import uuid
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, Literal

import numpy as np
from pydantic import Field
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    ConfigError,
    MalformedMessage,
    TooManyRequests,
    VLAgentsError,
    shown,
)
from vlagents_ray.protocol.messages import NAME_CHARACTERS, Reply
from vlagents_ray.serve.access.charges import Charge
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting, read_mapping
from vlagents_ray.serve.dialects import base
from vlagents_ray.serve.endpoints.http_messages import public_problem
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import IncomingMessage
from vlagents_ray_dialects.messages import openpi


class MapDialect(base.RouteDialect):
    """A dialect whose messages are maps in openpi's encoding; all such dialects share the
    server's root.
    """

    root = "openpi"

    async def stream(self, socket: WebSocket) -> None:
        """Serve one connection at this dialect's path."""
        await _stream([self], socket)

    def at_root(self, sharing: Sequence[MapDialect]) -> base.Stream:
        """Return the function that serves the root for all dialects that share it."""
        return partial(_stream, sharing)

    @abc.abstractmethod
    def first(self) -> dict[str, Any]:
        """Return the first message to a client, which is sent when the client connects."""

    @abc.abstractmethod
    def speaks(self, message: dict[str, Any]) -> bool:
        """Return whether a client of this dialect sent a message."""

    def begins(self, message: dict[str, Any], connection: MapConnection) -> bytes | str | None:
        """Begin an episode if the message requires it.

        Args:
            message: The message of a client.
            connection: The connection of the client.

        Returns:
            The reply if the message is not an observation; an empty reply is not sent.
        """
        return None

    def batch(self, message: dict[str, Any]) -> list[Any] | None:
        """Return the observations of a message that is a batch; None if it is one observation."""
        return None

    def answer(self, replies: Sequence[Reply], before_ms: float | None, *, batched: bool) -> Any:
        """Return the answer to a message in the client's format.

        Args:
            replies: The reply to each observation of the message.
            before_ms: The server's time for the previous message, ms; None for the first one.
            batched: Whether the message is a batch.
        """
        inference_ms = max(reply.timing["inference_ms"] for reply in replies)
        infer_ms = max(reply.timing["queue_ms"] + reply.timing["inference_ms"] for reply in replies)
        rows = [self.rows(reply) for reply in replies]
        actions = _stacked(rows) if batched else rows[0]

        policy_timing: dict[str, Any] = {"infer_ms": inference_ms}
        if batched:
            policy_timing["batch_size"] = len(rows)
        server_timing = {"infer_ms": infer_ms}
        if before_ms is not None:
            server_timing["prev_total_ms"] = before_ms

        columns = self.mapping.columns(actions) or {"actions": actions}
        return columns | {"policy_timing": policy_timing, "server_timing": server_timing}


def _stacked(chunks: Sequence[np.ndarray]) -> np.ndarray:
    """Stack the chunks of a batch to (B, H, D)."""
    shapes = {chunk.shape for chunk in chunks}
    if len(shapes) > 1:
        raise VLAgentsError(
            "batch: expected chunks of one shape, as the reply is one array, got "
            f"{sorted(shapes)}; send each observation by itself"
        )
    return np.stack(chunks)


class OpenPiDialectConfig(DialectConfig):
    """The settings of the dialect of `openpi-client` over WebSocket."""

    mapping: MappingSetting  # each of openpi's robots has different keys, so there is no default
    metadata: dict[str, Any] = Field(
        default_factory=dict,
        description="further entries of the first message to a client, such as reset_pose",
    )
    answer_reset: bool = Field(
        default=False,
        description='whether {"reset": True} is answered with the same message; only some clients '
        "wait for it",
    )


class OpenPiDialect(MapDialect):
    """openpi's protocol: a session begins with the connection, and an episode with each new prompt.

    Each observation of a batch belongs to the session at its index. A batch of another size ends
    the episodes of all these sessions, as the server cannot tell which robot each observation is
    from.
    """

    Config = OpenPiDialectConfig
    clients = "openpi"
    summary = (
        "A session is the connection, or a place in its batches; an episode begins with each new "
        "prompt. An error is a text, then close 1011."
    )
    paths: ClassVar[Mapping[str, str]] = {"WS /openpi": "stream"}
    presets = openpi.PRESETS
    config: OpenPiDialectConfig

    def first(self) -> dict[str, Any]:
        """Return the policy's metadata, and the metadata in the dialect's settings."""
        metadata = self.context.metadata()
        message = {key: metadata.get(key) for key in ("policy", "checkpoint", "version")}
        return message | self.config.metadata

    def speaks(self, message: dict[str, Any]) -> bool:
        return "endpoint" not in message

    def begins(self, message: dict[str, Any], connection: MapConnection) -> bytes | str | None:
        """End the episodes of the connection if the message is a reset, and return its reply."""
        if message.keys() != {"reset"}:
            return None
        if message["reset"] is not True:
            raise MalformedMessage(f"reset: expected true, got {shown(message['reset'])}")
        connection.end_episodes()
        return openpi.encode(message) if self.config.answer_reset else b""

    def batch(self, message: dict[str, Any]) -> list[Any] | None:
        """Return the observations of a batch; None if the message is one observation."""
        if message.keys() != {"batch"}:
            return None
        batch = message["batch"]
        if not isinstance(batch, list) or not batch:
            raise MalformedMessage(
                f"batch: expected a list of one observation or more, got {shown(batch)}"
            )
        return batch


class RoboArenaDialectConfig(DialectConfig):
    """The settings of RoboArena's client. They are the fields of RoboArena's PolicyServerConfig,
    and `bare`. A field that the policy's contract declares must not contradict it.
    """

    mapping: MappingSetting = "roboarena"
    image_resolution: tuple[int, int] | Literal["any"] | None = Field(
        default=None, description="height, width; default: the contract's, or 224, 224"
    )
    needs_wrist_camera: bool | None = Field(
        default=None,
        description="whether the client sends the wrist camera; default: the contract's, or true",
    )
    n_external_cameras: int | None = Field(
        default=None,
        ge=0,
        le=2,
        description="number of external cameras that the client sends; default: the contract's, "
        "or 1",
    )
    needs_stereo_camera: bool = Field(
        default=False, description="whether the client sends both images of stereo cameras"
    )
    needs_session_id: bool = Field(
        default=False, description="whether the client sends the name of its session"
    )
    action_space: (
        Literal["joint_position", "joint_velocity", "cartesian_position", "cartesian_velocity"]
        | None
    ) = Field(
        default=None,
        description="meaning of the actions, for the client; default: the contract's",
    )
    bare: bool = Field(
        default=False,
        description="whether the answer is the array itself, as older clients need it",
    )


# RoboArena's names of action spaces, by the contract's; positions are absolute.
_ACTION_SPACES = {
    "joint": "joint_position",
    "joint_velocity": "joint_velocity",
    "ee_pose": "cartesian_position",
    "ee_velocity": "cartesian_velocity",
}


# The fields of a policy that takes any cameras; these are RoboArena's own defaults.
_DEFAULTS = {
    "image_resolution": [224, 224],
    "needs_wrist_camera": True,
    "n_external_cameras": 1,
}


def _announcement(
    config: RoboArenaDialectConfig, contract: Contract | None
) -> tuple[dict[str, Any], list[str]]:
    """Return the first message to a client, and a sentence for each field of it that contradicts
    the contract or is not known.
    """
    announced = config.model_dump(mode="json", exclude={"mapping", "priority", "bare"})
    declared, faults = _declared(config, contract)
    for name, value in declared.items():
        if announced[name] not in (value, None):
            faults.append(
                f"{name}: expected {value}, as the policy's contract declares, got "
                f"{announced[name]}; leave the setting out"
            )
        announced[name] = value
    for name, value in _DEFAULTS.items():
        if announced[name] is None:
            announced[name] = value
    if announced["image_resolution"] == "any":
        announced["image_resolution"] = None  # as RoboArena's protocol has it
    if announced["action_space"] is None and not faults:
        faults.append(
            "action_space: expected the meaning of the actions, since the policy's contract does "
            f"not declare it, got none; set it to one of {list(_ACTION_SPACES.values())}"
        )
    return announced, faults


def _declared(
    config: RoboArenaDialectConfig, contract: Contract | None
) -> tuple[dict[str, Any], list[str]]:
    """Return the fields of the first message that the contract declares, and a sentence for each
    property of the policy that the message cannot express.
    """
    declared: dict[str, Any] = {}
    faults: list[str] = []
    if contract is None:
        return declared, faults

    action = contract.action
    if action.space is not None:
        space = _ACTION_SPACES.get(action.space)
        if space is None or (action.delta and "velocity" not in space):
            kind = "relative" if action.delta else "absolute"
            faults.append(
                "action_space: expected an action that RoboArena's protocol has a name for, got "
                f"{kind} actions of the space {action.space!r}; serve this policy to other clients"
            )
        else:
            declared["action_space"] = space

    if contract.cameras is not None:
        mapping = config.keys() or read_mapping("roboarena")
        keys = {name: camera.key for name, camera in mapping.cameras.items()}
        wrist = [name for name in contract.cameras if "wrist" in keys.get(name, name)]
        declared["needs_wrist_camera"] = bool(wrist)
        external = len(contract.cameras) - len(wrist)
        declared["n_external_cameras"] = external
        if external > 2 or len(wrist) > 1:
            faults.append(
                "cameras: expected up to two external cameras and one wrist camera, which "
                f"RoboArena's clients have, got {list(contract.cameras)}"
            )
        sizes = set()
        for camera in contract.cameras.values():
            if camera.height is not None and camera.width is not None:
                sizes.add((camera.height, camera.width))
        if len(sizes) == 1:
            declared["image_resolution"] = list(sizes.pop())
        elif sizes:
            faults.append(
                "image_resolution: expected one size for all cameras, which RoboArena's protocol "
                f"announces, got {sorted(sizes)}"
            )
    return declared, faults


class RoboArenaDialect(MapDialect):
    """RoboArena's protocol: an episode ends with `reset`, or with another `session_id`."""

    Config = RoboArenaDialectConfig
    clients = "RoboArena"
    summary = (
        "A session is the connection; `reset` or a new `session_id` begins an episode. An error is "
        "a text, then close 1011."
    )
    paths: ClassVar[Mapping[str, str]] = {"WS /roboarena": "stream"}
    presets = openpi.ROBOARENA
    config: RoboArenaDialectConfig

    @classmethod
    def lacks(cls, config: DialectConfig, contract: Contract | None) -> list[str]:
        """Return a sentence for each input that these clients never send, and for each field of the
        first message that contradicts the contract or is not known.
        """
        if not isinstance(config, RoboArenaDialectConfig):
            raise TypeError(f"config: expected RoboArena's settings, got {type(config).__name__}")
        return super().lacks(config, contract) + _announcement(config, contract)[1]

    def first(self) -> dict[str, Any]:
        announced, faults = _announcement(self.config, self.context.contract)
        if faults:  # the contract became known when the policy was loaded
            raise ConfigError("; ".join(faults))
        return announced

    def speaks(self, message: dict[str, Any]) -> bool:
        return "endpoint" in message

    def begins(self, message: dict[str, Any], connection: MapConnection) -> bytes | str | None:
        """End the episode at a reset or another `session_id`; return the reply to a reset."""
        endpoint = message.get("endpoint", "infer")
        if not isinstance(endpoint, str) or endpoint not in ("infer", "reset"):
            raise MalformedMessage(f"endpoint: expected 'infer' or 'reset', got {shown(endpoint)}")
        if endpoint == "reset":
            connection.end_episodes()
            return "reset successful"

        session_id = message.get("session_id")
        if session_id is not None:
            # The client sends a text, or an array with one text.
            if isinstance(session_id, np.ndarray) and session_id.size == 1:
                session_id = session_id.item()
            episode = shown(session_id, NAME_CHARACTERS)
            if connection.episode not in (None, episode):
                connection.end_episodes()
            connection.episode = episode
        return None

    def answer(self, replies: Sequence[Reply], before_ms: float | None, *, batched: bool) -> Any:
        """Encode the reply as a map, or as the array itself for older clients."""
        if self.config.bare:
            return self.rows(replies[0])
        return super().answer(replies, before_ms, batched=batched)


class MapConnection:
    """The state of one dialect on a connection, with the sessions of the client.

    Args:
        dialect: The dialect.
    """

    def __init__(self, dialect: MapDialect) -> None:
        self.dialect = dialect
        self.sender: Sender = dialect.sender()
        self.session: base.ImplicitSession = dialect.session(self.sender)
        self.episode: str | None = None  # the client's name for the current episode
        self._batched: list[base.ImplicitSession] = []  # the sessions by their index in a batch
        self._before_ms: float | None = None  # the server's time for the previous message, ms

    def end_episodes(self) -> None:
        """Make the next observation of each session begin an episode."""
        for session in (self.session, *self._batched):
            session.episode.end()

    async def answer(
        self, message: dict[str, Any], incoming: IncomingMessage, charge: Charge, request_id: str
    ) -> bytes | str:
        """Return the answer to one message.

        Args:
            message: The message.
            incoming: The undecoded message, for the metrics.
            charge: The charge of the message.
            request_id: The id of the request.
        """
        dialect = self.dialect
        answer = dialect.begins(message, self)
        if answer is not None:
            return answer

        batch = dialect.batch(message)
        observations = [message] if batch is None else batch
        charge.cover(len(observations))
        inputs = [dialect.read(observation) for observation in observations]

        sessions = [self.session] if batch is None else await self._of_batch(len(batch), charge)
        if not sessions[0].episode.begun:
            dialect.mapping.warn_of_unread_cameras(observations[0], dialect.name)
        session_inputs = []
        for session, (obs, instruction) in zip(sessions, inputs, strict=True):
            session_inputs.append(base.SessionObs(session, obs, instruction))

        incoming.decoded_alike(len(observations))
        replies = await base.act_together(incoming, session_inputs, request_id, dialect.rows)

        before_ms, batched = self._before_ms, batch is not None

        def write() -> bytes:
            """Encode the answer."""
            return openpi.encode(dialect.answer(replies, before_ms, batched=batched))

        data: bytes = dialect.encoded(incoming, write)
        self._before_ms = (time.perf_counter() - incoming.arrived) * 1e3
        return data

    async def _of_batch(self, number: int, charge: Charge) -> list[base.ImplicitSession]:
        """Return the sessions of a batch of this size, in order; a change of the size ends the
        episodes.
        """
        if number != len(self._batched):
            surplus, self._batched = self._batched[number:], self._batched[:number]
            for session in surplus:
                await session.close(charge)
            for session in self._batched:
                session.episode.end()
            while len(self._batched) < number:
                self._batched.append(self.dialect.session(self.sender, uuid.uuid4().hex))
        return self._batched


async def _stream(dialects: Sequence[MapDialect], socket: WebSocket) -> None:
    """Serve a connection at a path of these dialects; the last dialect sends the first message."""
    if not await base.accept_or_refuse(socket, dialects[0].context):
        return

    connections: dict[str, MapConnection] = {}
    try:
        await socket.send_bytes(openpi.encode(dialects[-1].first()))
        async with dialects[0].messages(socket) as messages:
            async for message in messages:
                admission = dialects[0].admission(message.charge, message.size)
                if not await _answer(dialects, socket, message.data, admission, connections):
                    return
    except WebSocketDisconnect:
        return
    finally:
        for connection in connections.values():
            connection.sender.release(for_good=True)


async def _answer(
    dialects: Sequence[MapDialect],
    socket: WebSocket,
    data: bytes | None,
    admission: MessageAdmission,
    connections: dict[str, MapConnection],
) -> bool:
    """Answer one message; return False if the connection was closed.

    Args:
        dialects: The dialects that share the path.
        socket: The connection.
        data: The message.
        admission: The admission of the message, which is released at the end.
        connections: The state of each dialect on this connection, by name.
    """
    charge = admission.charge
    incoming = dialects[0].arrived(charge)
    request_id = uuid.uuid4().hex
    try:
        message = await base.decoded(
            lambda data, budget: openpi.decode(data, budget.limits), data, admission
        )

        dialect = _dialect_of(message, dialects)
        arrived = incoming.arrived
        incoming = dialect.arrived(charge)
        incoming.arrived = arrived
        if dialect.name not in connections:
            connections[dialect.name] = MapConnection(dialect)
        connection = connections[dialect.name]
        answer = await connection.answer(message, incoming, charge, request_id)
    except Exception as error:  # noqa: BLE001 - the error is the reply to the client
        problem = public_problem(error, incoming.transport, request_id)
        dialects[0].record_failure(incoming, problem)
        await socket.send_text(f"{problem} (request {request_id})")

        # The connection stays open, as the policy has not received the message.
        if isinstance(problem, TooManyRequests):
            return True

        await base.close_after_error(socket, problem)
        return False
    finally:
        admission.release()

    if isinstance(answer, str):
        await socket.send_text(answer)
    elif answer:
        await socket.send_bytes(answer)
    return True


def _dialect_of(message: dict[str, Any], dialects: Sequence[MapDialect]) -> MapDialect:
    """Return the dialect of a message, by default the first dialect."""
    for dialect in dialects:
        if dialect.speaks(message):
            return dialect
    return dialects[0]
