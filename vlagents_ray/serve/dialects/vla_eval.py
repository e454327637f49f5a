"""vla-eval's benchmarks over WebSocket: they say hello, begin episodes, and send an observation a step.

A benchmark executes one action a step, so the rows of a chunk are handed out one by one. One that sends observations
without waiting (its live mode) gets an answer to the newest; those that it has overtaken are not acted on.
"""

from __future__ import annotations

import asyncio
import contextlib
import uuid
from collections import deque
from typing import Any

import numpy as np
from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import MalformedMessage, MessageTooLarge, VLAgentsError
from vlagents_ray.serve.conversation import Conversation
from vlagents_ray.serve.dialects.config import VlaEval
from vlagents_ray.serve.dialects.door import POLICY_VIOLATION, Door, House, admit, decoded, tellable
from vlagents_ray.wire import vla_eval as wire

_WAITING = 16  # messages of a client that does not wait for answers


class VlaEvalDoor(Door):
    """Its episodes are the client's."""

    def __init__(self, dialect: VlaEval, house: House) -> None:
        super().__init__("vla_eval", dialect, house)
        self._execute = dialect.execute
        self._observation_params = dialect.observation_params

    async def stream(self, socket: WebSocket) -> None:
        """One connection, and its session with it."""
        if not await admit(socket, self.house):
            return
        sender = self.sender()
        episode = _Episode(self.conversation(sender))
        inbox = _Inbox()
        reading = asyncio.ensure_future(inbox.fill(socket, self.house))
        try:
            while (message := await inbox.next()) is not None:
                answer = await self._answer(message, episode)
                if answer is not None:
                    await socket.send_bytes(wire.encode(answer))
            if inbox.overrun:
                await socket.close(POLICY_VIOLATION)
        except WebSocketDisconnect:
            return
        finally:
            sender.release(for_good=True)
            reading.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await reading

    async def _answer(self, message: wire.Message | VLAgentsError, episode: _Episode) -> wire.Message | None:
        if isinstance(message, VLAgentsError):
            return _error(message, 0, uuid.uuid4().hex)
        if message.kind == "hello":
            return self._hello(message)
        if message.kind in ("episode_start", "episode_end"):
            episode.end()
            return None
        if message.kind != "observation":
            return None  # what a client says of its own errors
        return await self._act(message, episode)

    def _hello(self, message: wire.Message) -> wire.Message:
        version = message.payload.get("protocol_version")
        if type(version) is not int or version != wire.PROTOCOL_VERSION:
            error = MalformedMessage(f"protocol_version: got {str(version)[:20]}, want {wire.PROTOCOL_VERSION}")
            return _error(error, message.seq, uuid.uuid4().hex)
        known = self.house.metadata()
        payload: dict[str, Any] = {
            "harness_version": f"vlagents-ray {known.get('version')}",
            "protocol_version": wire.PROTOCOL_VERSION,
            "model_server": known.get("policy"),
            "capabilities": {},
        }
        if self._observation_params:
            payload["observation_params"] = self._observation_params
        return wire.Message("hello", payload, message.seq)

    async def _act(self, message: wire.Message, episode: _Episode) -> wire.Message:
        visit = self.visit()
        request_id = uuid.uuid4().hex
        try:
            obs, instruction = self.read(message.payload)
            if not episode.rows or episode.conversation.stale(instruction):
                visit.decoded_one()
                reply = await episode.conversation.act(obs, instruction, request_id)
                rows = visit.written(reply, lambda: self.rows(reply))
                episode.rows = list(rows[: self._execute])
            return wire.Message("action", {"actions": episode.rows.pop(0)}, message.seq)
        except Exception as error:  # noqa: BLE001 - it is told
            told = tellable(error, self.name, request_id)
            visit.refused(told.code)
            return _error(told, message.seq, request_id)


class _Episode:
    """Of one connection."""

    def __init__(self, conversation: Conversation) -> None:
        self.conversation = conversation
        self.rows: list[np.ndarray] = []  # of the last chunk, each (D,), not handed out yet

    def end(self) -> None:
        """The next observation begins another."""
        self.rows = []
        self.conversation.begin_again()


class _Inbox:
    """What a client has sent and nobody has looked at; an observation takes the place of the one before it."""

    def __init__(self) -> None:
        self._messages: deque[wire.Message | VLAgentsError | None] = deque()
        self._there = asyncio.Event()
        self.overrun = False  # it was closed, as far more came than was waited for

    async def next(self) -> wire.Message | VLAgentsError | None:
        """The oldest, or the error in place of one that cannot be read; None when the client has gone."""
        while not self._messages:
            self._there.clear()
            await self._there.wait()
        return self._messages.popleft()

    async def fill(self, socket: WebSocket, house: House) -> None:
        """Take in what comes, until the client goes or sends far more than it waits for."""
        try:
            while (event := await socket.receive())["type"] != "websocket.disconnect":
                if len(self._messages) >= _WAITING:
                    self.overrun = True
                    self._put(MessageTooLarge(f"{_WAITING} messages wait for answers; send no more than that at once"))
                    return
                self._put(await self._read(event.get("bytes"), house))
        finally:
            self._put(None)

    @staticmethod
    async def _read(data: bytes | None, house: House) -> wire.Message | VLAgentsError:
        try:
            if data is None:
                raise MalformedMessage("message: got text, want a binary map")
            return await decoded(wire.decode, data, house.limits)
        except Exception as error:  # noqa: BLE001 - it is told
            return tellable(error, "vla_eval", "of an unreadable message")

    def _put(self, message: wire.Message | VLAgentsError | None) -> None:
        last = self._messages[-1] if self._messages else None
        if _is_observation(last) and _is_observation(message):
            self._messages.pop()
        self._messages.append(message)
        self._there.set()


def _is_observation(message: wire.Message | VLAgentsError | None) -> bool:
    return isinstance(message, wire.Message) and message.kind == "observation"


def _error(error: VLAgentsError, seq: int, request_id: str) -> wire.Message:
    return wire.Message("error", {"error": f"{error} (request {request_id})", "code": error.code}, seq)
