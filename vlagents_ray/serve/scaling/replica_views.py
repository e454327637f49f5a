"""What replicas show to viewers, read over Ray by another replica of their application, or by a driver."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Collection
from functools import partial
from typing import Any

import ray

from vlagents_ray.client.transports.serve_handle import call_replica
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.serve.config.deployment import POLICY
from vlagents_ray.serve.observers.live_view import OtherReplicas, Snapshot, SnapshotReader
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
        self._views: dict[str, SnapshotReader] = {}  # found last
        self._found = float("-inf")

    async def views(self) -> dict[str, SnapshotReader]:
        """Return the reader of the snapshots of each, by name."""
        if time.monotonic() - self._found > _VIEW_S:
            self._found = time.monotonic()
            actors = await asyncio.to_thread(self._look_up)
            self._views = {name: partial(_view, actor) for name, actor in actors.items()}
        return self._views

    async def press(self, session: str, do: str, by: str) -> dict[str, Any] | None:
        """Give a command to a session of one of them, see `CommandBoard.press`; None if none has the session.

        Raises:
            VLAgentsError: The replica that has the session refused the command.
        """
        actors = await asyncio.to_thread(self._look_up)
        asked = [
            asyncio.wait_for(call_replica(actor, SiblingApi.press, session, do, by), _PRESS_S)
            for actor in actors.values()
        ]
        for answer in asyncio.as_completed(asked):
            try:
                pressed: dict[str, Any] | None = await answer
            except (ray.exceptions.RayError, TimeoutError, asyncio.TimeoutError) as error:
                cause = getattr(error, "cause", None)  # what the replica itself raised
                if isinstance(cause, VLAgentsError):
                    raise cause from error
                logger.info("another replica does not answer: %s", error)
                continue
            if pressed is not None:
                return pressed
        return None

    def _look_up(self) -> dict[str, Any]:
        actors = [found for app in self._apps for found in replica_actors(app, POLICY)]
        return {name: actor for name, actor in actors if name != self._but}


async def _view(actor: Any, since: int, shown: Collection[str]) -> Snapshot:
    snapshot: Snapshot = await asyncio.wait_for(call_replica(actor, SiblingApi.live, since, shown), _ANSWER_S)
    return snapshot
