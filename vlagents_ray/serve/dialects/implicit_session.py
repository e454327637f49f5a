"""Sessions of clients whose protocol has no reset: the first observation and each new instruction begin an episode."""

from __future__ import annotations

import logging

from vlagents_ray.contract import Contract
from vlagents_ray.errors import InvalidObservation, UnknownSession
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.messages import (
    Op,
    RankName,
    Reply,
    Request,
)
from vlagents_ray.serve.engine.dispatch import Dispatcher
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.metrics_buffer import RequestTrace

logger = logging.getLogger(__name__)


class ImplicitEpisode:
    """Decides when an episode begins in a protocol without reset: at the first observation and each new instruction.

    An observation without an instruction keeps the previous instruction.
    """

    def __init__(self) -> None:
        self.instruction: str | None = None  # instruction of the last reset
        self.begun = False  # whether there was an observation of this episode

    def begins(self, instruction: str | None) -> bool:
        """Whether an observation with that instruction begins an episode."""
        return not self.begun or (instruction is not None and instruction != self.instruction)

    def opening(self, instruction: str | None, contract: Contract | None) -> str | None:
        """Return the instruction for the reset; raise `InvalidObservation` if the policy needs one and none is set."""
        instruction = self.instruction if instruction is None else instruction
        if instruction is None and contract is not None and contract.instruction:
            raise InvalidObservation("instruction: got none, the policy needs one; send it with the observation")
        return instruction

    def began(self, instruction: str | None) -> None:
        """Note that the session was reset with that instruction."""
        self.begun, self.instruction = True, instruction

    def end(self) -> None:
        """Let the next observation begin an episode."""
        self.begun = False


class ImplicitSession:
    """A session of a client on the server's own port; it must not be called concurrently."""

    def __init__(self, engine: Engine, sender: Dispatcher, transport: str, rank: RankName = "robot") -> None:
        self.episode = ImplicitEpisode()
        self._engine = engine
        self._sender = sender
        self._transport = transport
        self._rank: RankName = rank

    async def act(self, obs: Obs, instruction: str | None, request_id: str) -> Reply:
        """Return the policy's action; the session is reset first if an episode begins.

        A session that was removed because it was idle is reset again, which is safe since the observation was not acted
        on. Raises the error of the reply.
        """
        if self.episode.begins(instruction):
            await self._reset(obs, instruction, request_id)
        try:
            return await self._ask("act", obs, None, request_id)
        except UnknownSession:
            logger.info("%s: a session was forgotten; it begins again (request %s)", self._transport, request_id)
            await self._reset(obs, instruction, request_id)
            return await self._ask("act", obs, None, request_id)

    async def _reset(self, obs: Obs, instruction: str | None, request_id: str) -> None:
        instruction = self.episode.opening(instruction, self._engine.contract)
        trace = RequestTrace(self._engine.stats, self._transport, "reset", self._rank)
        self.episode.end()
        try:
            reply = await self._ask("reset", obs, instruction, request_id)
        except Exception as error:
            trace.refused(getattr(error, "code", "internal"))
            raise
        trace.written(reply, lambda: None)
        self.episode.began(instruction)

    async def _ask(self, op: Op, obs: Obs, instruction: str | None, request_id: str) -> Reply:
        request = Request(op, obs, instruction=instruction, rank=self._rank, request_id=request_id)
        (reply,) = await self._sender.ask([request])
        if reply.error is not None:
            raise reply.error
        return reply
