"""The views of the other replicas of an application: their snapshots, and commands to their
sessions.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Sequence
from functools import partial
from typing import Any

from vlagents_ray.serve.replica.part import SiblingPart
from vlagents_ray.serve.scaling.session_migration import PeerEnded, PeerUnreachable
from vlagents_ray_live.live_view import OtherReplicas, ReplicaView, SnapshotReader

logger = logging.getLogger(__name__)

# The methods that the live page calls at other replicas, and the time limit of each, s. If a
# replica is late, the page calls it again later.
METHODS = {"read": 0.3, "press": 3.0}
_VIEW_S = 2.0  # the time for which the list of replicas is reused, s


class SiblingViews(OtherReplicas):
    """The views of other replicas, through their live parts.

    Args:
        siblings: Returns the live part of each other replica; the replicas may change between two
            calls.
    """

    def __init__(self, siblings: Callable[[], Awaitable[Sequence[SiblingPart]]]) -> None:
        self._siblings = siblings
        self._views: dict[str, SnapshotReader] = {}  # the result of the last lookup
        self._looked_up = float("-inf")

    async def views(self) -> dict[str, SnapshotReader]:
        """Return the readers of the replicas' snapshots, by name."""
        if time.monotonic() - self._looked_up > _VIEW_S:
            self._looked_up = time.monotonic()
            siblings = await self._siblings()
            self._views = {
                sibling.name: partial(sibling.call, ReplicaView.read) for sibling in siblings
            }
        return self._views

    async def press(
        self, session: str, do: str, by: str, episode: str | None = None
    ) -> dict[str, Any] | None:
        """Give a command to a session, see `CommandBoard.press`.

        Returns:
            The description of the command; None if no replica has the session.

        Raises:
            VLAgentsError: The replica that has the session rejected the command.
        """
        calls = [
            sibling.call(ReplicaView.press, session, do, by, episode)
            for sibling in await self._siblings()
        ]
        for answer in asyncio.as_completed(calls):
            try:
                pressed: dict[str, Any] | None = await answer
            except (PeerEnded, PeerUnreachable) as error:
                logger.info("another replica does not answer: %s", error)
                continue
            if pressed is not None:
                return pressed
        return None
