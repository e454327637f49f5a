"""The dialects that are on: their routes, their description for clients, and the check that they fit the policy."""

from __future__ import annotations

from typing import Any

from starlette.routing import BaseRoute, Match, WebSocketRoute
from starlette.types import Scope

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.registry import dialect_class, require
from vlagents_ray.serve.config.dialects import DialectArgs
from vlagents_ray.serve.dialects.base import ReplicaContext, RouteDialect


class Root(WebSocketRoute):
    """The application's root, with or without a slash at its end: `ws://host:port`, `ws://host:port/app`."""

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Match a WebSocket at the root."""
        path = scope.get("path", "").removeprefix(scope.get("root_path", ""))
        if scope["type"] == "websocket" and path in ("", "/"):
            return Match.FULL, {"endpoint": self.endpoint, "path_params": {}}
        return Match.NONE, {}


def dialect_routes(args: DialectArgs, context: ReplicaContext) -> list[BaseRoute]:
    """Return the routes of the dialects on the server's own port."""
    dialects: dict[str, RouteDialect] = {
        name: dialect_class(name)(name, config, context)
        for name, config in args.on().items()
        if name not in args.gateways()
    }
    routes = [route for dialect in dialects.values() for route in dialect.routes()]
    if sharing := [dialects[name] for name in _at_root(args)]:
        routes.append(Root("/", sharing[0].at_root(sharing)))
    return routes


def describe(args: DialectArgs) -> dict[str, Any]:
    """Describe the enabled dialects for the metadata: addresses, clients and mapping by name."""
    found: dict[str, Any] = {}
    for name, config in args.on().items():
        cls, mapping = dialect_class(name), config.keys()
        found[name] = {
            **cls.places(config),
            "clients": cls.clients,
            "summary": cls.summary,
            "mapping": None if mapping is None else mapping.to_json(),
        }
    for name in _at_root(args):
        found[name]["paths"].insert(0, "WS /")
    return found


def require_fit(args: DialectArgs, contract: Contract | None) -> None:
    """Raise `ConfigError` if the policy needs a part of the observation that a dialect's mapping does not provide."""
    found = [
        f"- dialects.{name}: {line}"
        for name, config in args.on().items()
        for line in dialect_class(name).lacks(config, contract)
    ]
    if found:
        raise ConfigError("dialects and policy do not fit:\n" + "\n".join(found))


def require_packages(args: DialectArgs) -> None:
    """Raise `MissingDependency` if an enabled dialect needs a package that is not installed."""
    for name in args.on():
        for module in dialect_class(name).requires:
            require(module)


def _at_root(args: DialectArgs) -> list[str]:
    """Return the dialects at the root: the first one that has a root, and others with the same protocol there."""
    roots = {name: getattr(dialect_class(name), "root", "") for name in args.on()}
    first = next(filter(None, roots.values()), None)
    return [name for name, root in roots.items() if root == first]
