"""What replicas show to viewers, read over Ray by another replica of their application, or by a driver."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Collection
from functools import partial
from typing import Any

import ray

from vlagents_ray.client.transports.serve_handle import call_replica
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.config.deployment import POLICY
from vlagents_ray.serve.live.fleet import Exchange, Other, OtherReplicas
from vlagents_ray.serve.live.snapshot import Snapshot
from vlagents_ray.serve.scaling.sibling_replicas import SiblingApi, replica_actors

logger = logging.getLogger(__name__)

_ANSWER_S = 0.3  # time limit for an answer; a replica that is late is asked again
_PRESS_S = 3.0  # time limit for the answer to a command, which is not repeated
_VIEW_S = 2.0  # time for which the replicas that were found are not looked up again


class ReplicaViews(OtherReplicas):
    """Reads the snapshots of the replicas of applications in the Ray cluster that this process is connected to."""

    def __init__(self, apps: Collection[str], but: str = "") -> None:
        """Read those of the replicas of `apps`, apart from the replica whose full name is `but`."""
        self._apps = apps
        self._but = but
        self._views: dict[str, Other] = {}  # found last
        self._found = float("-inf")

    async def views(self) -> dict[str, Other]:
        """Return the reader of the snapshots of each, by name."""
        if time.monotonic() - self._found > _VIEW_S:
            self._found = time.monotonic()
            actors = await asyncio.to_thread(self._look_up)
            self._views = {name: partial(_view, actor) for name, actor in actors.items()}
        return self._views

    async def press(self, session: str, do: str, text: str, by: str) -> dict[str, Any] | None:
        """Give a command to a session of one of them, see `CommandBoard.press`; None if none has the session."""
        pressed: dict[str, Any] | None = await self._first(
            lambda actor: _answer(actor, SiblingApi.press, session, do, text, by)
        )
        return pressed

    async def exchange(self, session: str) -> Exchange | None:
        """Return `RobotLinks.exchange` of the one that has the connection of the session's robot; None if none has."""

        async def found(actor: Any) -> Exchange | None:
            exchange = partial(_exchange, actor)
            return None if await exchange(session, "", {"do": "find"}) is None else exchange

        exchange: Exchange | None = await self._first(found)
        return exchange

    async def _first(self, ask: Callable[[Any], Awaitable[Any]]) -> Any:
        """Ask all of them, and return the first answer that is not None; raises what a replica itself raised."""
        actors = await asyncio.to_thread(self._look_up)
        for answer in asyncio.as_completed([ask(actor) for actor in actors.values()]):
            try:
                found = await answer
            except (ray.exceptions.RayError, TimeoutError, asyncio.TimeoutError) as error:
                cause = getattr(error, "cause", None)  # what the replica itself raised
                if isinstance(cause, VLAgentsError):
                    raise cause from error
                logger.info("another replica does not answer: %s", error)
                continue
            if found is not None:
                return found
        return None

    def _look_up(self) -> dict[str, Any]:
        actors = [found for app in self._apps for found in replica_actors(app, POLICY)]
        return {name: actor for name, actor in actors if name != self._but}


async def _view(actor: Any, since: int, shown: Collection[str]) -> Snapshot:
    snapshot: Snapshot = await asyncio.wait_for(call_replica(actor, SiblingApi.live, since, shown), _ANSWER_S)
    return snapshot


async def _answer(actor: Any, method: Callable[..., Any], *args: Any) -> dict[str, Any] | None:
    answer: dict[str, Any] | None = await asyncio.wait_for(call_replica(actor, method, *args), _PRESS_S)
    return answer


async def _exchange(actor: Any, session: str, hold: str, message: dict[str, Any]) -> dict[str, Any] | None:
    try:
        return await _answer(actor, SiblingApi.exchange, session, hold, message)
    except (ray.exceptions.RayError, TimeoutError, asyncio.TimeoutError) as error:
        logger.info("another replica does not answer: %s", error)
        return None  # the robot is not reached
