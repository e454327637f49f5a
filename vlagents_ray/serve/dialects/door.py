"""What the doors of all dialects share: who may come in, decoding beside the event loop, errors as they may be told."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from starlette.websockets import WebSocket

from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.interface import Obs
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.conversation import Conversation
from vlagents_ray.serve.dialects.config import Dialect
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.problems import problem_response
from vlagents_ray.serve.reading import INLINE_BYTES
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire.messages import Limits, Reply

T = TypeVar("T")

logger = logging.getLogger(__name__)

POLICY_VIOLATION, INTERNAL_ERROR, TRY_AGAIN_LATER = 1008, 1011, 1013  # WebSocket close codes


@dataclass(frozen=True, slots=True)
class House:
    """The replica that a door belongs to."""

    engine: Engine
    metadata: Callable[[], dict[str, Any]]
    limits: Limits


class Door:
    """One dialect's."""

    def __init__(self, name: str, dialect: Dialect, house: House) -> None:
        self.name = name  # the transport, in statistics
        self.house = house
        self._mapping = dialect.keys()
        self._rank = dialect.rank

    def sender(self, session_id: str = "", counted: bool | None = None) -> Sender:
        """For a connection or, with a session of its own, for a request; `counted`: see `Sender`."""
        return Sender(self.house.engine, self.name, session_id, connected=not session_id, counted=counted)

    def conversation(self, sender: Sender) -> Conversation:
        """A session of that sender's."""
        return Conversation(self.house.engine, sender, self.name, self._rank)

    def visit(self) -> Visit:
        """Of an observation."""
        return Visit(self.house.engine.stats, self.name, "act", self._rank)

    def read(self, theirs: dict[str, Any]) -> tuple[Obs, str | None]:
        """Their observation as ours, and its instruction."""
        return self._mapping.obs(theirs, self.house.limits)

    def rows(self, reply: Reply) -> np.ndarray:
        """The action in the answer to an act as their client means it, (H, D) float32."""
        if reply.act is None:
            raise VLAgentsError("act: answered without an action")
        contract = self.house.engine.contract
        return self._mapping.rows(reply.act.action, None if contract is None else contract.action)


async def decoded(read: Callable[[bytes, Limits], T], data: bytes, limits: Limits) -> T:
    """What `read` makes of a message."""
    if len(data) > INLINE_BYTES:
        return await asyncio.to_thread(read, data, limits)
    return read(data, limits)


def tellable(error: Exception, what: str, request_id: str) -> VLAgentsError:
    """The error as a client may see it; of what nobody foresaw, the log has the details."""
    if isinstance(error, VLAgentsError):
        return error
    logger.error("%s failed (request %s)", what, request_id, exc_info=error)
    return VLAgentsError("internal error; the server's log has the details")


async def admit(socket: WebSocket, house: House) -> bool:
    """Accept a WebSocket; False if it was turned away, as the policy is not ready or the replica full."""
    try:
        house.engine.require_ready()
        sessions = house.engine.sessions
        if len(sessions) >= sessions.limit:
            raise PolicyUnavailable(f"this replica holds {len(sessions)} sessions, its limit")
    except VLAgentsError as error:
        if "websocket.http.response" in (socket.scope.get("extensions") or {}):
            await socket.send_denial_response(problem_response(error, "", PolicyUnavailable.status))
        else:
            await socket.accept()
            await socket.close(TRY_AGAIN_LATER)
        return False
    await socket.accept()
    return True
