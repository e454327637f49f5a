"""Parts of a replica that plug-ins add: routes of its HTTP server, observers of its requests, facts in its metadata.

A plug-in registers a class by the entry-point group `vlagents_ray.replica`, and a deployment file turns it on:

    args:
      policy: pi0
      parts: {latency_log: {folder: runs/latency}}

Routes are behind the server's access control: with API keys on, a caller without a key reaches none of them.
`examples/plugin` has a complete part.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, ClassVar

from starlette.routing import BaseRoute

from vlagents_ray.registry import registered_class
from vlagents_ray.serve.config.parts import PartArgs, PartConfig
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.observer import Observer

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class PartContext:
    """What a part may use of its replica."""

    engine: Engine
    replica: str  # name of the replica, unique over time
    node: str  # name of its node
    metadata: Callable[[], Mapping[str, Any]]  # the document of `GET /v1/metadata`


class ReplicaPart:
    """A part of a replica; a class overrides the methods that it needs.

    `open` is called before the policy is loaded, and `close` after the last answer was sent. If `open` raises an error,
    the replica does not start, and `serve status` has the reason.
    """

    Config: ClassVar[type[PartConfig]] = PartConfig

    def __init__(self, settings: Any, context: PartContext) -> None:
        """Create a part with the `settings` of the deployment file, an instance of its `Config`."""
        self.settings = settings
        self.context = context

    def open(self) -> None:
        """Open files and start threads."""

    def close(self) -> None:
        """Close what `open` has opened."""

    def routes(self) -> Sequence[BaseRoute]:
        """Return the routes that are added to the replica's HTTP server."""
        return ()

    def observer(self) -> Observer | None:
        """Return an observer of all requests and answers; it is closed before the part."""
        return None

    def describe(self) -> Mapping[str, Any]:
        """Return facts for clients, which the replica's metadata has under `parts` and the name of this part."""
        return {}


class ReplicaParts:
    """The open parts of one replica."""

    def __init__(self, parts: Mapping[str, ReplicaPart], opened: ExitStack) -> None:
        self._parts = dict(parts)
        self._opened = opened

    def routes(self) -> Iterator[BaseRoute]:
        """Yield the routes of all parts."""
        for part in self._parts.values():
            yield from part.routes()

    def describe(self) -> dict[str, Any]:
        """Return the facts of all parts, by name; a part that raises an error is left out, and its error is logged."""
        facts = {}
        for name, part in self._parts.items():
            try:
                facts[name] = dict(part.describe())
            except Exception:
                logger.exception("part %r: its facts are not in the metadata", name)
        return facts

    def close(self) -> None:
        """Close all parts in reverse order."""
        self._opened.close()


def open_parts(args: PartArgs, context: PartContext) -> ReplicaParts:
    """Create and open the parts that are on in a deployment file; if one fails, close those before it."""
    parts: dict[str, ReplicaPart] = {}
    with ExitStack() as opened:
        for name, settings in args.on().items():
            part: ReplicaPart = registered_class("replica", name)(settings, context)
            part.open()
            opened.callback(part.close)
            observer = part.observer()
            if observer is not None:
                opened.callback(observer.close)
                opened.callback(context.engine.observers.remove, observer)
                context.engine.observers.add(observer)
            parts[name] = part
        return ReplicaParts(parts, opened.pop_all())
