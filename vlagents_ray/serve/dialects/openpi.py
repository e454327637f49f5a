"""openpi's clients over WebSocket: a binary map each way, the server speaks first.

RoboArena's (`roboarena.py`) speak much the same and connect to the root as well. Both may be on: RoboArena's requests
name an `endpoint`, openpi's do not. What is said first is then RoboArena's configuration, which openpi's client takes
as metadata.

An error is a text with a request id, and the end of the connection (1011); theirs sends a traceback.
"""

from __future__ import annotations

import abc
import time
import uuid
from collections.abc import Sequence
from typing import Any

from starlette.websockets import WebSocket, WebSocketDisconnect

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.conversation import Conversation
from vlagents_ray.serve.dialects.config import OpenPi
from vlagents_ray.serve.dialects.door import INTERNAL_ERROR, Door, House, admit, decoded, tellable
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire import openpi as wire
from vlagents_ray.wire.messages import Reply


class MapDoor(Door, abc.ABC):
    """A dialect of maps, in openpi's encoding."""

    @abc.abstractmethod
    def first(self) -> dict[str, Any]:
        """What a client is told when it connects."""

    @abc.abstractmethod
    def speaks(self, message: dict[str, Any]) -> bool:
        """Is it one of its client's?"""

    def begins(self, message: dict[str, Any], talk: Talk) -> str | None:
        """Notice what begins an episode; the answer, if the message is no observation."""
        return None

    def answer(self, reply: Reply, before_ms: float | None) -> Any:
        """What its client reads; `before_ms` is what the server took for the observation before."""
        infer_ms = reply.timing["queue_ms"] + reply.timing["inference_ms"]
        server = {"infer_ms": infer_ms} | ({} if before_ms is None else {"prev_total_ms": before_ms})
        return {
            "actions": self.rows(reply),
            "policy_timing": {"infer_ms": reply.timing["inference_ms"]},
            "server_timing": server,
        }


class OpenPiDoor(MapDoor):
    """Its session begins with the connection, and again with each new prompt."""

    def __init__(self, dialect: OpenPi, house: House) -> None:
        super().__init__("openpi", dialect, house)
        self._added = dialect.metadata

    def first(self) -> dict[str, Any]:
        known = self.house.metadata()
        return {key: known.get(key) for key in ("policy", "checkpoint", "version")} | self._added

    def speaks(self, message: dict[str, Any]) -> bool:
        return "endpoint" not in message


class Talk:
    """One connection's with one door."""

    def __init__(self, door: MapDoor) -> None:
        self.door = door
        self.sender: Sender = door.sender()
        self.conversation: Conversation = door.conversation(self.sender)
        self.episode: str | None = None  # as the client names it
        self._before_ms: float | None = None

    async def answer(self, message: dict[str, Any], visit: Visit, request_id: str) -> bytes | str:
        """To one message."""
        if (said := self.door.begins(message, self)) is not None:
            return said
        obs, prompt = self.door.read(message)
        visit.decoded_one()
        reply = await self.conversation.act(obs, prompt, request_id)
        data = visit.written(reply, lambda: wire.encode(self.door.answer(reply, self._before_ms)))
        self._before_ms = (time.perf_counter() - visit.arrived) * 1e3
        return data


class MapRoot:
    """A path at which these doors are; the last one speaks first."""

    def __init__(self, doors: Sequence[MapDoor], house: House) -> None:
        self._doors = doors
        self._house = house

    async def stream(self, socket: WebSocket) -> None:
        """One connection, and its sessions with it."""
        if not await admit(socket, self._house):
            return
        talks: dict[str, Talk] = {}
        try:
            await socket.send_bytes(wire.encode(self._doors[-1].first()))
            while True:
                event = await socket.receive()
                if event["type"] == "websocket.disconnect":
                    return
                if not await self._answer(socket, event.get("bytes"), talks):
                    return
        except WebSocketDisconnect:
            return
        finally:
            for talk in talks.values():
                talk.sender.release(for_good=True)

    async def _answer(self, socket: WebSocket, data: bytes | None, talks: dict[str, Talk]) -> bool:
        """Answer one message; False if that was the end."""
        visit, request_id = self._doors[0].visit(), uuid.uuid4().hex
        try:
            if data is None:
                raise MalformedMessage("message: got text, want a binary map")
            message = await decoded(wire.decode, data, self._house.limits)
            door = next((door for door in self._doors if door.speaks(message)), self._doors[0])
            arrived, visit = visit.arrived, door.visit()
            visit.arrived = arrived
            talk = talks.get(door.name) or talks.setdefault(door.name, Talk(door))
            answer = await talk.answer(message, visit, request_id)
        except Exception as error:  # noqa: BLE001 - it is told
            told = tellable(error, visit.transport, request_id)
            visit.refused(told.code)
            await socket.send_text(f"{told} (request {request_id})")
            await socket.close(INTERNAL_ERROR, "Internal server error.")
            return False
        if isinstance(answer, str):
            await socket.send_text(answer)
        else:
            await socket.send_bytes(answer)
        return True
