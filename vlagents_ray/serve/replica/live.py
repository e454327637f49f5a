"""The methods of a replica for viewers of the live page, and for the other replicas that they look at."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Collection, Mapping
from typing import Any

import ray

from vlagents_ray.errors import UnknownSession
from vlagents_ray.ray_tools.private import compress_no_websockets
from vlagents_ray.serve.access.audit import write_audit
from vlagents_ray.serve.config.deployment import LiveArgs, ViewerArgs
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.live.fleet import Fleet
from vlagents_ray.serve.live.recordings import SessionRecordings
from vlagents_ray.serve.live.snapshot import ReplicaView, Snapshot
from vlagents_ray.serve.live.spans import open_spans
from vlagents_ray.serve.scaling.replica_views import ReplicaViews
from vlagents_ray.serve.scaling.sibling_replicas import SiblingReplicas


class ReplicaLive:
    """A part of `PolicyReplica`: what it shows to viewers."""

    def _open_live(
        self,
        engine: Engine,
        peers: SiblingReplicas,
        metadata: Callable[[], Mapping[str, Any]],
        settings: LiveArgs | None,
        viewers: ViewerArgs,
    ) -> None:
        compress_no_websockets()
        write_audit()  # of the buttons that are pressed, also without keys
        node = ray.get_runtime_context().get_node_id()
        name = peers.own_name.rpartition("#")[2]
        self._view = ReplicaView(engine, name, node[:8], metadata, settings)
        self._view.open()
        self._fleet = Fleet(self._view, ReplicaViews([peers.app], but=peers.own_name))
        self._recordings = SessionRecordings(engine, self._view.tap, viewers.targets())
        self._recordings.open()
        self._spans = open_spans(engine, name)

    def _close_live(self) -> None:
        self._recordings.close()
        if self._spans is not None:
            self._spans.close()
        self._view.close()

    async def live(self, since: int, shown: Collection[str]) -> Snapshot:
        """Return what happened here since a snapshot, with pictures of the sessions `shown`."""
        return await asyncio.to_thread(self._view.read, since, shown)

    async def press(self, session: str, do: str, by: str) -> dict[str, Any] | None:
        """Give a command to a session, for another replica; None if the session is not here."""
        try:
            return self._view.commands.press(session, do, by)
        except UnknownSession:
            return None
