"""The sessions of a replica as other replicas see them: the operations that they call when a session moves.

See `vlagents_ray.serve.scaling.session_migration` for the calling side, and for the protocol that prevents a move from
duplicating or losing a session.
"""

from __future__ import annotations

import asyncio
import logging
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Collection, Coroutine, Sequence
from typing import Any, Concatenate, ParamSpec, TypeVar

from vlagents_ray.errors import VLAgentsError
from vlagents_ray.protocol.messages import Op, Reply, Request
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray.serve.sessions import Outdated, Version

logger = logging.getLogger(__name__)

EXPORT_S = 10.0  # time limit for the export of a session, which waits for the session's queued acts
ARRIVAL_S = 3.0  # time limit for a released session to arrive at its new replica
ON_ITS_WAY_S = 0.1  # interval between questions to the other replicas, since a session may be moving between two
_REMEMBERED = 1000  # number of remembered releases, for replicas that repeat a request

P = ParamSpec("P")
T = TypeVar("T")
InThread = Callable[..., Awaitable[Any]]
Spawn = Callable[[Coroutine[Any, Any, Any]], "asyncio.Task[Any]"]


class PeerEnded(Exception):
    """The other replica has ended, and its sessions with it."""


class PeerUnreachable(Exception):
    """The other replica cannot be reached, and it is unknown whether it has executed the request."""


class HeldSessions:
    """Exports, releases and adopts the sessions of one engine, on the replica's event loop."""

    def __init__(self, engine: Engine, loop: asyncio.AbstractEventLoop, in_thread: InThread, spawn: Spawn) -> None:
        """Create the operations on the sessions of one engine.

        Args:
            engine: The engine that holds the sessions.
            loop: The replica's event loop.
            in_thread: Runs a call that takes long (unpickling) on another thread.
            spawn: Starts a task on the replica's event loop.
        """
        self._engine = engine
        self._loop = loop
        self._in_thread = in_thread
        self._spawn = spawn
        self._claims: OrderedDict[str, asyncio.Task[bool]] = OrderedDict()  # releases that other replicas requested
        self._released: OrderedDict[str, float] = OrderedDict()  # time of release by session, s
        self._leaving: dict[str, asyncio.Future[None]] = {}  # sessions being given away, until another replica has them

    # Operations for other replicas.

    async def held(self, session_ids: Collection[str]) -> dict[str, Version]:
        """Return the versions of those sessions that are here, or are moving from here to another replica.

        Returns at once. The version of a session that is moving is (0, 0).
        """
        leaving = dict.fromkeys(filter(self.is_leaving, session_ids), (0, 0))
        return leaving | self._engine.sessions.held(session_ids)

    async def copy(self, session_id: str) -> dict[str, Any] | None:
        """Return the session's state after its queued acts; None if it is not here, or cannot be pickled."""
        if session_id in self._leaving:
            await asyncio.wait([self._leaving[session_id]], timeout=EXPORT_S)
            return None
        if self.is_leaving(session_id):
            await asyncio.sleep(ON_ITS_WAY_S)
        return await self._ask(session_id, "export", EXPORT_S)

    async def release(self, session_id: str, version: Version, claim: str) -> bool:
        """Release the session if it still has that version; return whether it was released.

        A repeated call with the same `claim` returns the same answer, and has no further effect.
        """
        if claim not in self._claims:
            self._claims[claim] = self._spawn(self._release(session_id, version, EXPORT_S))
            if len(self._claims) > _REMEMBERED:
                self._claims.popitem(last=False)
        return await asyncio.shield(self._claims[claim])

    async def _release(self, session_id: str, version: Version, timeout_s: float | None) -> bool:
        answer = await self._ask(session_id, "release", timeout_s, version=tuple(version))
        if answer is None or not answer["released"]:
            return False
        self._released[session_id] = self._loop.time()
        self._released.move_to_end(session_id)
        if len(self._released) > _REMEMBERED:
            self._released.popitem(last=False)
        return True

    def is_leaving(self, session_id: str) -> bool:
        """Return whether the session has just been released here, so that no replica may hold it at the moment."""
        left = self._loop.time() - self._released.get(session_id, float("-inf"))
        return session_id in self._leaving or (left < ARRIVAL_S and session_id not in self._engine.sessions)

    async def take_over(self, session_id: str, state: dict[str, Any]) -> bool:
        """Continue a session that the other replica has released.

        Returns:
            Whether the session is here; also True if a newer state of it has made this one obsolete.
        """
        if self._engine.draining:
            return False
        try:
            await self._in_thread(self._engine.transfer.adopt, session_id, state)
        except Outdated:  # the call is a repetition, or a newer state arrived first
            return True
        except VLAgentsError as error:
            logger.info("session %s: not taken over: %s", session_id, error)
            return False
        return True

    async def drop_older(self, steps: dict[str, int]) -> None:
        """Close sessions that began an episode at another replica, at these steps."""
        self._engine.sessions.drop_older(steps)

    # Operations for this replica.

    async def send_to_peer(self, session_id: str, peers: Sequence[Peer]) -> bool:
        """Give the session to the first of `peers` that takes it over; return whether one did.

        The next replica is only asked if the one before refused or has ended.
        """
        state = await self._ask(session_id, "export", None)  # without a limit, as the session ends here otherwise
        if state is None or not peers:
            return False
        self._leaving[session_id] = self._loop.create_future()
        try:
            if not await self._release(session_id, (state["steps"], state["moves"]), None):
                return False
            for peer in peers:
                try:
                    if await peer.take_over(session_id, state):
                        return True
                except PeerEnded:
                    continue
                except PeerUnreachable as error:
                    logger.warning("session %s: given to a replica that does not answer: %s", session_id, error)
                    return False
            return False
        finally:
            self._leaving.pop(session_id).set_result(None)

    async def wait_until_left(self, session_id: str) -> None:
        """Wait until another replica has the session, if this replica is giving it away."""
        if session_id in self._leaving:
            await asyncio.wait([self._leaving[session_id]])

    async def _ask(self, session_id: str, op: Op, timeout_s: float | None, **kwargs: Any) -> dict[str, Any] | None:
        """Return the engine's answer to a request, or None for an error.

        If the request has not begun after `timeout_s`, it is withdrawn, and has no effect.
        """
        answered: asyncio.Future[Reply] = self._loop.create_future()

        def done(reply: Reply) -> None:
            self._loop.call_soon_threadsafe(_settle, answered, reply)

        pending = PendingRequest(session_id, Request(op, kwargs=kwargs), done)
        self._engine.submit([pending])
        await asyncio.wait([answered], timeout=timeout_s)
        if not answered.done():
            self._engine.withdraw(pending)
            if not pending.begun:
                return None
            await answered
        reply = answered.result()
        if reply.error is not None:
            logger.info("session %s: %s: %s", session_id, op, reply.error)
            return None
        return reply.info


class Peer(ABC):
    """A remote proxy for the `HeldSessions` of another replica of the application.

    Each method waits for the other replica without a time limit, and raises `PeerEnded` or `PeerUnreachable`.
    """

    name: str  # unique name of the replica

    async def held(self, session_ids: Collection[str]) -> dict[str, Version]:
        """Call `HeldSessions.held` at the other replica."""
        return await self.ask(HeldSessions.held, session_ids)

    async def copy(self, session_id: str) -> dict[str, Any] | None:
        """Call `HeldSessions.copy` at the other replica."""
        return await self.ask(HeldSessions.copy, session_id)

    async def release(self, session_id: str, version: Version, claim: str) -> bool:
        """Call `HeldSessions.release` at the other replica."""
        return await self.ask(HeldSessions.release, session_id, version, claim)

    async def take_over(self, session_id: str, state: dict[str, Any]) -> bool:
        """Call `HeldSessions.take_over` at the other replica."""
        return await self.ask(HeldSessions.take_over, session_id, state)

    async def drop_older(self, steps: dict[str, int]) -> None:
        """Call `HeldSessions.drop_older` at the other replica."""
        await self.ask(HeldSessions.drop_older, steps)

    @abstractmethod
    async def ask(
        self, method: Callable[Concatenate[HeldSessions, P], Awaitable[T]], *args: P.args, **kwargs: P.kwargs
    ) -> T:
        """Call `method`, one of `PEER_METHODS`, at the other replica, and return its result."""


PEER_METHODS: dict[str, Callable[..., Awaitable[Any]]] = {
    method.__name__: method
    for method in (
        HeldSessions.held,
        HeldSessions.copy,
        HeldSessions.release,
        HeldSessions.take_over,
        HeldSessions.drop_older,
    )
}
"""The methods that a replica may call at another one, by name."""


def _settle(answered: asyncio.Future[Reply], reply: Reply) -> None:
    if not answered.done():
        answered.set_result(reply)
