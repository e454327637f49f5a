"""Sessions of clients whose protocol has no reset: the first observation and each new instruction begin an episode."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import Any, NamedTuple

from vlagents_ray.contract import Contract
from vlagents_ray.errors import InvalidObservation, UnknownSession
from vlagents_ray.interface import Obs
from vlagents_ray.protocol.frames import Decoded
from vlagents_ray.protocol.messages import Op, RankName, Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender
from vlagents_ray.serve.requests import Message

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
    """A session of a client on the server's own port; it must not be called concurrently.

    Args:
        engine: The engine that serves it.
        sender: The sender of the client's requests.
        rank: Class of its requests.
        name: Name of the session, unique in the replica; empty for the sender's own.
    """

    def __init__(self, engine: Engine, sender: Sender, rank: RankName = "robot", name: str = "") -> None:
        self.episode = ImplicitEpisode()
        self._engine = engine
        self._sender = sender
        self._rank: RankName = rank
        self._name = name

    async def act(self, message: Message, obs: Obs, instruction: str | None, request_id: str, **kwargs: Any) -> Reply:
        """Return the policy's action; see `act_together`."""
        (reply,) = await act_together(message, [SessionObs(self, obs, instruction)], request_id, **kwargs)
        return reply

    async def close(self) -> None:
        """End the session."""
        await self._sender.ask(self._sender.message("close"), Decoded([self._request("close", None, None, "", {})], {}))

    def _request(
        self, op: Op, obs: Obs | None, instruction: str | None, request_id: str, kwargs: dict[str, Any]
    ) -> Request:
        return Request(
            op,
            obs,
            instruction=instruction,
            kwargs=kwargs,
            session=self._name,
            rank=self._rank,
            request_id=request_id,
        )


class SessionObs(NamedTuple):
    """An observation of a session, and its instruction; None if there is none."""

    session: ImplicitSession
    obs: Obs
    instruction: str | None


async def act_together(message: Message, seen: Sequence[SessionObs], request_id: str, **kwargs: Any) -> list[Reply]:
    """Return the policy's action for each observation in a client's message; their acts are queued at once.

    A session whose episode begins is reset first, with `kwargs`. One that was removed because it was idle is reset
    again, which is safe since the observation was not acted on.

    Raises:
        VLAgentsError: The first error among the replies.
    """
    await _reset([one for one in seen if one.session.episode.begins(one.instruction)], request_id, kwargs)
    replies = await _ask(message, "act", seen, [None] * len(seen), request_id, {})
    if forgotten := [i for i, reply in enumerate(replies) if isinstance(reply.error, UnknownSession)]:
        logger.info("%s: a session was forgotten; it begins again (request %s)", message.transport, request_id)
        again = [seen[i] for i in forgotten]
        await _reset(again, request_id, kwargs)
        repeated = await _ask(seen[0].session._sender.message(), "act", again, [None] * len(again), request_id, {})
        for i, reply in zip(forgotten, repeated, strict=True):
            replies[i] = reply
    _raise_first(replies)
    return replies


async def _reset(seen: Sequence[SessionObs], request_id: str, kwargs: dict[str, Any]) -> None:
    if not seen:
        return
    openings = [one.session.episode.opening(one.instruction, one.session._engine.contract) for one in seen]
    for session, _, _ in seen:
        session.episode.end()
    resets = seen[0].session._sender.message("reset", seen[0].session._rank)
    resets.decoded_alike(len(seen))
    replies = await _ask(resets, "reset", seen, openings, request_id, kwargs)
    resets.written(lambda: None)
    for one, opening, reply in zip(seen, openings, replies, strict=True):
        if reply.error is None:
            one.session.episode.began(opening)
    _raise_first(replies)


async def _ask(
    message: Message,
    op: Op,
    seen: Sequence[SessionObs],
    instructions: Sequence[str | None],
    request_id: str,
    kwargs: dict[str, Any],
) -> list[Reply]:
    names = [request_id] if len(seen) == 1 else [f"{request_id}-{place}" for place in range(len(seen))]
    requests = [
        one.session._request(op, one.obs, instruction, name, kwargs)
        for one, instruction, name in zip(seen, instructions, names, strict=True)
    ]
    return await seen[0].session._sender.ask(message, Decoded(requests, {}))


def _raise_first(replies: Sequence[Reply]) -> None:
    for reply in replies:
        if reply.error is not None:
            raise reply.error
