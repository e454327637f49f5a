"""Where the dialects that are on are reached, and what they tell of themselves."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any

from starlette.requests import Request as HttpRequest
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Match, Route, WebSocketRoute
from starlette.types import Scope

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.dialects.config import DialectArgs
from vlagents_ray.serve.dialects.door import House
from vlagents_ray.serve.dialects.openpi import MapDoor, MapRoot, OpenPiDoor
from vlagents_ray.serve.dialects.openvla import OpenVLADoor
from vlagents_ray.serve.dialects.roboarena import RoboArenaDoor
from vlagents_ray.serve.dialects.vla_eval import VlaEvalDoor
from vlagents_ray.serve.problems import problem_response
from vlagents_ray.wire.presets import read_mapping


class Root(WebSocketRoute):
    """The application's root, with or without a slash at its end: `ws://host:port`, `ws://host:port/app`."""

    def matches(self, scope: Scope) -> tuple[Match, Scope]:
        """Full or none."""
        path = scope.get("path", "").removeprefix(scope.get("root_path", ""))
        if scope["type"] == "websocket" and path in ("", "/"):
            return Match.FULL, {"endpoint": self.endpoint, "path_params": {}}
        return Match.NONE, {}


def dialect_routes(args: DialectArgs, house: House) -> list[BaseRoute]:
    """Of the dialects that are on."""
    routes: list[BaseRoute] = []
    pi: list[MapDoor] = []
    if args.openpi is not None:
        pi.append(OpenPiDoor(args.openpi, house))
        routes.append(WebSocketRoute("/openpi", MapRoot(pi[-1:], house).stream))
    if args.roboarena is not None:
        pi.append(RoboArenaDoor(args.roboarena, house))
        routes.append(WebSocketRoute("/roboarena", MapRoot(pi[-1:], house).stream))
    if args.openvla is not None:
        routes.append(Route("/act", OpenVLADoor(args.openvla, house).act, methods=["POST"]))
    root = MapRoot(pi, house).stream if pi else None
    if args.vla_eval is not None:
        door = VlaEvalDoor(args.vla_eval, house)
        routes += [WebSocketRoute("/vla-eval", door.stream), Route("/health", _health(house))]
        root = root or door.stream
    if root is not None:
        routes.append(Root("/", root))
    return routes


def describe(args: DialectArgs) -> dict[str, Any]:
    """For the metadata: by name, the paths and the mapping of each dialect that is on."""
    paths = {
        "openpi": ["WS /", "WS /openpi"],
        "roboarena": ["WS /", "WS /roboarena"],
        "openvla": ["POST /act"],
        "vla_eval": ["WS /vla-eval"],
    }
    if args.openpi is None and args.roboarena is None:
        paths["vla_eval"].insert(0, "WS /")
    return {name: {"paths": paths[name], "mapping": dialect.keys().to_json()} for name, dialect in args.on()}


def require_fit(args: DialectArgs, contract: Contract | None) -> None:
    """Raise `ConfigError` with whatever the policy needs and a mapping cannot give it."""
    mappings = {name: dialect.keys() for name, dialect in args.on()}
    if args.gr00t is not None:
        mappings["gr00t"] = read_mapping(args.gr00t.mapping)
    found = [f"- dialects.{name}: {line}" for name, mapping in mappings.items() for line in mapping.lacks(contract)]
    if found:
        raise ConfigError("dialects and policy do not fit:\n" + "\n".join(found))


def _health(house: House) -> Callable[[HttpRequest], Awaitable[Response]]:
    async def health(_http: HttpRequest) -> Response:
        """As vla-eval's own servers have it."""
        try:
            house.engine.require_ready()
        except VLAgentsError as error:
            return problem_response(error, "", PolicyUnavailable.status)
        return JSONResponse({"status": "ok"})

    return health
