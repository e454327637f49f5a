"""Serves vla-eval's benchmarks over WebSocket: they send "hello", the beginning and the end of each
episode, and an observation per step.

A benchmark executes one action per step, so each reply contains one row of a chunk. A benchmark
that sends observations without waiting (its live mode) receives a reply to the newest one; older
observations are dropped.
"""

from __future__ import annotations

import asyncio
import contextlib
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

from pydantic import Field
from starlette.routing import BaseRoute, Route
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.chunking.buffer import ChunkBuffer
from vlagents_ray.contract import Contract
from vlagents_ray.errors import (
    MalformedMessage,
    MessageTooLarge,
    VLAgentsError,
    shown,
)
from vlagents_ray.protocol.messages import PriorityName
from vlagents_ray.serve.config.dialects import DialectConfig, MappingSetting
from vlagents_ray.serve.dialects import base
from vlagents_ray.serve.endpoints.charged_messages import ChargedMessages
from vlagents_ray.serve.endpoints.http_messages import public_problem
from vlagents_ray.serve.engine.admission import MessageAdmission
from vlagents_ray_dialects.messages import vla_eval
from vlagents_ray_dialects.messages.vla_eval import PRESETS

# Maximum number of waiting messages of a client that sends without waiting for replies.
_WAITING = 16


class VlaEvalDialectConfig(DialectConfig):
    """The settings of vla-eval's benchmarks."""

    mapping: MappingSetting = "vla-eval"
    priority: PriorityName = "simulation"
    execute: int | None = Field(
        default=None, ge=1, description="number of executed rows of each chunk; null: all"
    )
    observation_params: dict[str, Any] = Field(
        default_factory=dict,
        description="parameters that are requested from benchmarks, such as send_state: true",
    )


class VlaEvalDialect(base.RouteDialect):
    """vla-eval's protocol, in which the client reports the begin and the end of each episode."""

    Config = VlaEvalDialectConfig
    clients = "vla-eval"
    summary = (
        "A session is the connection, whose client reports the begin and end of episodes. An error "
        "is an `error` message."
    )
    paths: ClassVar[Mapping[str, str]] = {"WS /vla-eval": "stream"}
    root = "vla_eval"
    presets = PRESETS
    config: VlaEvalDialectConfig

    def routes(self) -> list[BaseRoute]:
        return [*super().routes(), Route("/health", self.health)]

    def at_root(self, sharing: Sequence[VlaEvalDialect]) -> base.Stream:
        return self.stream

    async def stream(self, socket: WebSocket) -> None:
        """Serve one connection; its session ends with it."""
        if not await base.accept_or_refuse(socket, self.context):
            return

        sender = self.sender()
        session = self.session(sender)
        chunk = ChunkBuffer()  # the rows of the chunk that are not sent yet
        inbox = _Inbox()
        messages = self.messages(socket)
        reading = asyncio.ensure_future(inbox.fill(messages, self))
        try:
            async with messages:
                while True:
                    received = await inbox.next()
                    if received is None:
                        break
                    answer = await self._answer(received, session, chunk)
                    if answer is not None:
                        await socket.send_bytes(vla_eval.encode(answer))

                if inbox.end is not None:
                    await socket.close(base.POLICY_VIOLATION, inbox.end)
        except WebSocketDisconnect:
            return
        finally:
            sender.release(for_good=True)
            reading.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await reading

    async def _answer(
        self, received: _Received, session: base.ImplicitSession, chunk: ChunkBuffer
    ) -> vla_eval.VlaEvalMessage | None:
        """Return the answer to a message; None if the client expects none."""
        message = received.message
        if isinstance(message, VLAgentsError):
            return _error(message, 0, uuid.uuid4().hex)
        if message.kind == "hello":
            return self._hello(message)
        if message.kind in ("episode_start", "episode_end"):
            chunk.drop()
            session.episode.end()
            return None
        if message.kind != "observation":
            return None  # the client has reported an error
        return await self._act(message, received.admission, session, chunk)

    def _hello(self, message: vla_eval.VlaEvalMessage) -> vla_eval.VlaEvalMessage:
        """Return the answer to "hello"."""
        version = message.payload.get("protocol_version")
        if type(version) is not int or version != vla_eval.PROTOCOL_VERSION:
            error = MalformedMessage(
                f"protocol_version: expected {vla_eval.PROTOCOL_VERSION}, got {shown(version, 20)}"
            )
            return _error(error, message.seq, uuid.uuid4().hex)

        metadata = self.context.metadata()
        payload: dict[str, Any] = {
            "harness_version": f"vlagents-ray {metadata.get('version')}",
            "protocol_version": vla_eval.PROTOCOL_VERSION,
            "model_server": metadata.get("policy"),
            "capabilities": {},
        }
        if self.config.observation_params:
            payload["observation_params"] = self.config.observation_params
        # The client compares them with those of its benchmark.
        contract = self.context.contract
        if contract is not None:
            payload |= self._specs(contract)
        return vla_eval.VlaEvalMessage("hello", payload, message.seq)

    def _specs(self, contract: Contract) -> dict[str, Any]:
        """Return the specifications of actions and observations that the contract declares."""
        action = contract.action
        opens_and_closes = None
        if self.mapping.action_gripper:
            gripper = self.mapping.action_gripper[0]
            opens_and_closes = gripper.open, gripper.closed
        elif action.gripper_open is not None and action.gripper_closed is not None:
            opens_and_closes = action.gripper_open, action.gripper_closed
        specs = {
            "action_spec": vla_eval.action_spec(action, opens_and_closes),
            "observation_spec": vla_eval.observation_spec(contract),
        }
        return {name: spec for name, spec in specs.items() if spec}

    async def _act(
        self,
        message: vla_eval.VlaEvalMessage,
        admission: MessageAdmission,
        session: base.ImplicitSession,
        chunk: ChunkBuffer,
    ) -> vla_eval.VlaEvalMessage:
        """Return the action for an observation, or an error."""
        incoming = self.arrived(admission.charge)
        request_id = uuid.uuid4().hex
        try:
            # Some benchmarks render only the observations for which a chunk is computed, so the
            # observations for its other rows are not read.
            text = self.mapping.read_instruction(
                message.payload, self.context.limits, self.context.contract
            )
            if chunk.next is None or session.episode.begins(text):
                payload = await admission.decoded(partial(vla_eval.decode_images, message.payload))
                obs, instruction = self.read(payload)
                if not session.episode.begun:
                    self.mapping.warn_of_unread_cameras(payload, self.name)

                incoming.decoded_alike()
                reply = await session.act(incoming, obs, instruction, request_id)
                rows = self.encoded(incoming, lambda: self.rows(reply))
                chunk.replace(rows[: self.config.execute])

            actions = {"actions": chunk.take().action}
            return vla_eval.VlaEvalMessage("action", actions, message.seq)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            problem = public_problem(error, self.name, request_id)
            self.record_failure(incoming, problem)
            return _error(problem, message.seq, request_id)
        finally:
            admission.release()


@dataclass(slots=True)
class _Received:
    """A received message, whose images are not decoded yet, or the error of a rejected message."""

    message: vla_eval.VlaEvalMessage | VLAgentsError
    admission: MessageAdmission

    @property
    def is_observation(self) -> bool:
        """Whether the message is an observation."""
        if isinstance(self.message, VLAgentsError):
            return False
        return self.message.kind == "observation"


class _Inbox:
    """The unprocessed messages of a client; an observation replaces an observation directly before
    it.
    """

    def __init__(self) -> None:
        self._messages: deque[_Received | None] = deque()
        self._arrival = asyncio.Event()
        self.end: str | None = None  # the reason why the server ends the connection

    async def next(self) -> _Received | None:
        """Wait for the oldest message, and return it; None if the client has disconnected."""
        while not self._messages:
            self._arrival.clear()
            await self._arrival.wait()
        return self._messages.popleft()

    async def fill(self, messages: ChargedMessages, dialect: VlaEvalDialect) -> None:
        """Receive messages until the client disconnects, or too many of its messages wait for
        replies.
        """
        try:
            async for received in messages:
                admission = dialect.admission(received.charge, received.size)
                if len(self._messages) >= _WAITING:
                    self.end = (
                        f"{_WAITING} messages wait for answers; send no more than that at once"
                    )
                    self._put(_Received(MessageTooLarge(self.end), admission))
                    return

                self._put(await self._read(received.data, admission))
        finally:
            self._put(None)

    @staticmethod
    async def _read(data: bytes | None, admission: MessageAdmission) -> _Received:
        """Decode a message."""
        try:
            message = await base.decoded(
                lambda data, budget: vla_eval.decode(data, budget.limits), data, admission
            )
            return _Received(message, admission)
        except Exception as error:  # noqa: BLE001 - the error is the reply to the client
            problem = public_problem(error, "vla_eval", "of an unreadable message")
            return _Received(problem, admission)

    def _put(self, received: _Received | None) -> None:
        """Add a message; if it and the last message are observations, it replaces that message.
        None ends the inbox.
        """
        is_observation = received is not None and received.is_observation
        last = self._messages[-1] if self._messages else None
        if is_observation and last is not None and last.is_observation:
            self._messages.pop()
        self._messages.append(received)
        self._arrival.set()


def _error(error: VLAgentsError, seq: int, request_id: str) -> vla_eval.VlaEvalMessage:
    """Return the message with an error."""
    payload = {"error": f"{error} (request {request_id})", "code": error.code}
    return vla_eval.VlaEvalMessage("error", payload, seq)
