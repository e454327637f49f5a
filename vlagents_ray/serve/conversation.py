"""A session for a client whose protocol has no reset: it begins by itself, and again with each new instruction."""

from __future__ import annotations

import logging

from vlagents_ray.errors import InvalidObservation, UnknownSession
from vlagents_ray.interface import Obs
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.stats import Visit
from vlagents_ray.wire.messages import Op, RankName, Reply, Request

logger = logging.getLogger(__name__)


class Conversation:
    """One session of `sender`'s. Not for concurrent calls."""

    def __init__(self, engine: Engine, sender: Sender, transport: str, rank: RankName = "robot") -> None:
        self._engine = engine
        self._sender = sender
        self._transport = transport
        self._rank: RankName = rank
        self._begun = False
        self._instruction: str | None = None

    def begin_again(self) -> None:
        """An episode begins with the next observation."""
        self._begun = False

    def stale(self, instruction: str | None) -> bool:
        """Will `act` with that instruction begin an episode?"""
        return not self._begun or (instruction is not None and instruction != self._instruction)

    async def act(self, obs: Obs, instruction: str | None, request_id: str) -> Reply:
        """The policy's action, before which the session is reset if this is its first observation or a new instruction.

        No instruction means the one before. A session that was forgotten, as it was idle for long, begins
        again: nobody has acted on this observation. Raises whatever a request can be answered with.
        """
        if self.stale(instruction):
            await self._reset(obs, instruction, request_id)
        try:
            return await self._ask("act", obs, None, request_id)
        except UnknownSession:
            logger.info("%s: a session was forgotten; it begins again (request %s)", self._transport, request_id)
            await self._reset(obs, instruction, request_id)
            return await self._ask("act", obs, None, request_id)

    async def _reset(self, obs: Obs, instruction: str | None, request_id: str) -> None:
        contract = self._engine.contract
        instruction = self._instruction if instruction is None else instruction
        if instruction is None and contract is not None and contract.instruction:
            raise InvalidObservation("instruction: got none, the policy needs one; send it with the observation")
        visit = Visit(self._engine.stats, self._transport, "reset", self._rank)
        self._begun = False
        try:
            reply = await self._ask("reset", obs, instruction, request_id)
        except Exception as error:
            visit.refused(getattr(error, "code", "internal"))
            raise
        visit.written(reply, lambda: None)
        self._begun, self._instruction = True, instruction

    async def _ask(self, op: Op, obs: Obs, instruction: str | None, request_id: str) -> Reply:
        request = Request(op, obs, instruction=instruction, rank=self._rank, request_id=request_id)
        (reply,) = await self._sender.ask([request])
        if reply.error is not None:
            raise reply.error
        return reply
