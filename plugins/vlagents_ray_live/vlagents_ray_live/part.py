"""The live page as a part of a replica: its routes, and the data of all replicas.

It is on by default. A deployment file adds the last seconds of each session: `parts: {live:
{folder: /data/kept}}`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any, ClassVar

from starlette.routing import BaseRoute

from vlagents_ray.serve.replica.part import PartContext, ReplicaPart
from vlagents_ray_live.live_page import PAGE, live_routes
from vlagents_ray_live.live_view import Fleet, ReplicaView, Snapshot
from vlagents_ray_live.ring import LiveConfig
from vlagents_ray_live.sibling_views import METHODS, SiblingViews

_SUMMARY = (
    "A page that shows the sessions as they run. If the server has keys, the page asks for one "
    "with the scope `watch`, and has buttons for a key that also has the scope `operate`. Robots "
    "that allow it are stopped there."
)


class LivePart(ReplicaPart):
    """Shows the sessions of all replicas on a page, and stops their robots from there."""

    Config = LiveConfig
    sibling_methods: ClassVar[Mapping[str, float | None]] = METHODS
    pages: ClassVar[Mapping[str, str]] = {"live page": PAGE}

    def __init__(self, settings: LiveConfig, context: PartContext) -> None:
        super().__init__(settings, context)
        self.view = ReplicaView(
            context.engine, context.short_name, context.node, context.metadata, settings
        )
        self.fleet = Fleet(self.view, SiblingViews(self.siblings))

    def open(self) -> None:
        """Start to drop data that viewers no longer read, and to keep the last seconds of each
        session if there is a folder.
        """
        self.view.open()

    def close(self) -> None:
        """Stop keeping data."""
        self.view.close()

    def routes(self) -> Sequence[BaseRoute]:
        """Return the routes of the page."""
        return live_routes(self.fleet, open_to_network=self.context.open_to_network)

    def describe(self) -> Mapping[str, Any]:
        """Return the path of the page and its description."""
        return {"page": PAGE, "summary": _SUMMARY}

    def read(self, since: int, shown: Collection[str]) -> Snapshot:
        """Return the events since the snapshot with the number `since`, see `ReplicaView.read`."""
        return self.view.read(since, shown)

    def press(
        self, session: str, do: str, by: str, episode: str | None = None
    ) -> dict[str, Any] | None:
        """Give a command to a session of this replica, see `ReplicaView.press`."""
        return self.view.press(session, do, by, episode)
