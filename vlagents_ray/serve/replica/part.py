"""Parts of a replica that plug-ins add: routes, observers of requests, facts in the metadata, calls
between replicas.

A plug-in registers a class in the entry-point group `vlagents_ray.replica`, and a deployment file
turns the part on:

    args:
      policy: pi0
      parts: {latency_log: {folder: runs/latency}}

A part whose registry entry has `by_default` is on if its plug-in is installed; `parts: {NAME:
null}` turns it off.

The server's access control applies to routes: with API keys, a caller without a key can only reach
`pages`, which contain no data.

A deployment may have several replicas, each with its own instance of the part. A part calls the
instances in other replicas through the methods that it lists in `sibling_methods`:

    class Counter(ReplicaPart):
        sibling_methods = {"count": 3.0}

        def count(self) -> int: ...

        async def total(self) -> int:
            counts = [sibling.call(Counter.count) for sibling in await self.siblings()]
            return self.count() + sum(await asyncio.gather(*counts))

A part that needs the loaded policy overrides `before_ready`; a part with periodic work overrides
`run`.

`examples/plugin` has a complete part.
"""

from __future__ import annotations

import asyncio
import inspect
import logging
from collections.abc import Awaitable, Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Protocol

from starlette.routing import BaseRoute, Match

from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import registered_class
from vlagents_ray.serve.config.parts import PartArgs, PartConfig
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.observer import Observer

logger = logging.getLogger(__name__)


class OtherReplica(Protocol):
    """The interface of another replica of the application (`SiblingReplica`) for parts."""

    name: str  # unique over time

    async def call_part(self, part: str, method: str, *args: Any, limit_s: float | None) -> Any:
        """Call a method of a part of this replica; raise `PeerEnded`, `PeerUnreachable` or the
        method's own `VLAgentsError`.
        """


async def no_siblings() -> Sequence[OtherReplica]:
    """Return the other replicas of an application that has only one replica: an empty list."""
    return []


@dataclass(frozen=True, slots=True)
class PartContext:
    """The information and the functions of a replica that its parts may use."""

    engine: Engine
    replica: str  # name of the replica, unique over time
    node: str  # name of the replica's node
    metadata: Callable[[], Mapping[str, Any]]  # the document of `GET /v1/metadata`
    part: str = ""  # name of the part, which is its key in the deployment file
    # Tags of the replica's metrics, see `replica.metrics.series`.
    metric_tags: Mapping[str, str] = field(default_factory=dict)
    # The application's other replicas.
    siblings: Callable[[], Awaitable[Sequence[OtherReplica]]] = no_siblings
    # Whether clients on other machines need no key, `access: {insecure: true}`.
    open_to_network: bool = False
    slow_s: float = 30.0  # maximum time for the arrival of a message, `limits.slow_s`, s

    @property
    def short_name(self) -> str:
        """The name of the replica without its application and deployment, for viewers."""
        return self.replica.rpartition("#")[2]


class SiblingPart:
    """The same part of another replica."""

    def __init__(
        self, replica: OtherReplica, part: str, methods: Mapping[str, float | None]
    ) -> None:
        """Create a proxy for the part with the name `part` of a replica; `methods` are its
        `ReplicaPart.sibling_methods`.
        """
        self.name = replica.name  # name of the replica, unique over time
        self._replica = replica
        self._part = part
        self._methods = methods

    async def call(self, method: Callable[..., Any], *args: Any) -> Any:
        """Call a method of the other replica's part with `args`, and return its result.

        Args:
            method: One of the part's `sibling_methods`, such as `Counter.count`.

        Raises:
            PeerEnded: The replica has ended.
            PeerUnreachable: The replica does not answer in time or has no such part, or the method
                raised an error other than a `VLAgentsError`. The method may or may not have been
                executed.
            VLAgentsError: The method raised it.
        """
        name = method.__name__
        return await self._replica.call_part(self._part, name, *args, limit_s=self._methods[name])


class ReplicaPart:
    """A part of a replica; a class overrides the methods that it needs.

    A replica calls them in this order: `open` before it loads the policy, `before_ready` when the
    policy is loaded, `run` while the replica is ready, and `close` after the last answer was sent.
    If `open` or `before_ready` raises an error, the replica does not start, and `serve status`
    shows the reason.
    """

    Config: ClassVar[type[PartConfig]] = PartConfig
    sibling_methods: ClassVar[Mapping[str, float | None]] = {}
    """The methods that the same part of other replicas, or a process of the cluster, may call, each
    with the time limit for its answer, s (None: no limit). Coroutine functions run on the replica's
    event loop, other functions in a thread."""

    pages: ClassVar[Mapping[str, str]] = {}
    """Paths of pages for a browser, by title, such as {"live page": "/live"}; `vlagents-ray serve`
    prints their addresses. Pages need no key, since a browser cannot send a key when it opens a
    page. Therefore a page itself must contain no data. Each page must be a route of the part;
    otherwise the replica does not start.
    """

    def __init__(self, settings: Any, context: PartContext) -> None:
        """Create a part with the `settings` of the deployment file, an instance of its `Config`."""
        self.settings = settings
        self.context = context

    def open(self) -> None:
        """Open files and start threads."""

    async def before_ready(self) -> None:
        """Prepare everything that needs the loaded policy, on the replica's event loop. Serve sends
        the replica no requests before this returns.
        """

    async def run(self) -> None:
        """Do periodic work on the replica's event loop; the replica cancels this work before it
        closes.

        An error is logged, and ends only this work.
        """

    def close(self) -> None:
        """Close the files and threads that `open` has opened."""

    def routes(self) -> Sequence[BaseRoute]:
        """Return the routes that are added to the replica's HTTP server."""
        return ()

    def observer(self) -> Observer | None:
        """Return an observer of all requests and answers; it is closed before the part."""
        return None

    def describe(self) -> Mapping[str, Any]:
        """Return facts for clients, which the replica's metadata contains under `parts` and the
        name of this part.

        `GET /docs` lists a part with a `summary` and the path of its `page` or its `paths`, such as
        ["GET /count"].
        """
        return {}

    async def siblings(self) -> list[SiblingPart]:
        """Return this part in each other replica of the application. The replicas may change
        between two calls.
        """
        replicas = await self.context.siblings()
        return [
            SiblingPart(replica, self.context.part, self.sibling_methods) for replica in replicas
        ]


class ReplicaParts:
    """The open parts of one replica."""

    def __init__(self, parts: Mapping[str, ReplicaPart], opened: ExitStack) -> None:
        self._parts = dict(parts)
        self._routes = {name: list(part.routes()) for name, part in parts.items()}
        self._opened = opened

    def routes(self) -> Iterator[BaseRoute]:
        """Yield the routes of all parts."""
        for routes in self._routes.values():
            yield from routes

    def pages(self, server: Sequence[BaseRoute]) -> frozenset[str]:
        """Return the paths of the pages of all parts, which need no key.

        Args:
            server: All routes of the server, in the order in which they are tried.

        Raises:
            ConfigError: A route of another part or of the server would answer the request for a
                page. That route would then need no key either.
        """
        paths = set()
        for name, part in self._parts.items():
            for path in part.pages.values():
                if _route_of(path, server) not in self._routes[name]:
                    raise ConfigError(
                        f"part {name!r}: expected pages that are routes of this part, got "
                        f"{path!r}; correct its `pages`"
                    )
                paths.add(path)
        return frozenset(paths)

    def describe(self) -> dict[str, Any]:
        """Return the facts of all parts that have facts, by name.

        A part that raises an error is left out, and its error is logged.
        """
        facts = {}
        for name, part in self._parts.items():
            try:
                described = dict(part.describe())
            except Exception:
                logger.exception("part %r: its facts are not in the metadata", name)
                continue
            if described:
                facts[name] = described
        return facts

    async def call(self, part: str, method: str, *args: Any) -> Any:
        """Call one of the `sibling_methods` of a part.

        Raises:
            LookupError: This replica has no such part, or the part has no such method.
        """
        opened = self._parts.get(part)
        if opened is None or method not in opened.sibling_methods:
            raise LookupError(
                f"part {part!r}: expected a method for other replicas, got {method!r}, which the "
                "part does not have"
            )
        call = getattr(opened, method)
        if inspect.iscoroutinefunction(call):
            return await call(*args)
        return await asyncio.to_thread(call, *args)

    async def before_ready(self) -> None:
        """Await `before_ready` of each part, in the order of the parts."""
        for part in self._parts.values():
            await part.before_ready()

    async def run(self) -> None:
        """Do the periodic work of all parts."""
        await asyncio.gather(*(self._run(name, part) for name, part in self._parts.items()))

    async def _run(self, name: str, part: ReplicaPart) -> None:
        try:
            await part.run()
        except Exception:
            logger.exception("part %r: its periodic work has ended", name)

    def close(self) -> None:
        """Close all parts in reverse order."""
        self._opened.close()


def _route_of(path: str, routes: Sequence[BaseRoute]) -> BaseRoute | None:
    """Return the route that answers `GET path`, or None."""
    scope = {"type": "http", "method": "GET", "path": path, "root_path": "", "headers": []}
    for route in routes:
        match, _ = route.matches(scope)
        if match is Match.FULL:
            return route
    return None


def open_parts(args: PartArgs, context: PartContext) -> ReplicaParts:
    """Create and open the parts that a deployment file turns on. If a part fails, the parts that
    were opened before it are closed.
    """
    parts: dict[str, ReplicaPart] = {}
    with ExitStack() as opened:
        for name, settings in args.on().items():
            part: ReplicaPart = registered_class("replica", name)(
                settings, replace(context, part=name)
            )
            part.open()
            opened.callback(part.close)
            observer = part.observer()
            if observer is not None:
                opened.callback(observer.close)
                opened.callback(context.engine.observers.remove, observer)
                context.engine.observers.add(observer)
            parts[name] = part
        return ReplicaParts(parts, opened.pop_all())
