"""The Serve deployment that holds the ports: one process beside the replicas, which it talks to as any client does."""

from __future__ import annotations

import asyncio
import importlib.metadata
import logging
from functools import partial
from typing import Any

from ray import serve

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.serve.auth import Keys, require_access
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.dialects.routes import require_fit
from vlagents_ray.serve.gateways.config import GatewayArgs, GR00TArgs, VlagentsArgs
from vlagents_ray.serve.gateways.door import Door, House, reserve
from vlagents_ray.serve.gateways.talk import Connect
from vlagents_ray.wire.messages import RankName

logger = logging.getLogger(__name__)

_HOST = "127.0.0.1"
_LOADING_S = 3600.0  # for the policy to load; what keeps it from that is said at once
_ANSWER_S = 30.0


class Gateway:
    """Binds its ports when it starts, and opens them when the policy can act: only then is it running."""

    async def __init__(self, args: dict[str, Any]) -> None:  # type: ignore[misc]  # Serve awaits it
        self._doors: list[Door] = []
        await asyncio.to_thread(self._open, ServerArgs(**args))

    def _open(self, args: ServerArgs) -> None:
        wanted = args.dialects.gateways()
        keys = args.access.keys()
        for one in wanted.values():
            require_access(one.host or _HOST, keys, args.access.insecure)
        listeners = {name: reserve(name, one.host or _HOST, one.port) for name, one in wanted.items()}
        try:
            app = serve.get_replica_context().app_name
            contract = _wait_for_policy(app)
            require_fit(args.dialects, contract)
            for name, one in wanted.items():
                house = House(
                    app=app,
                    connect=_connector(app, one.rank, keyed=keys is not None),
                    limits=args.limits.limits(),
                    sessions=args.sessions.limit,
                    idle_s=args.sessions.idle_s,
                    contract=contract,
                    check=None if keys is None else partial(_check, keys, app),
                )
                self._doors.append(_door(one, house, listeners[name]))
            for door in self._doors:
                door.open()
        except BaseException:
            for listener in listeners.values():
                listener.close()
            raise

    def check_health(self) -> None:
        """Called by Serve; a gateway whose door has failed is replaced."""
        if not all(door.alive() for door in self._doors):
            raise PolicyUnavailable("a door of the gateway has failed; its log has the details")

    async def __del__(self) -> None:
        for door in getattr(self, "_doors", []):
            await asyncio.to_thread(door.close)


def _wait_for_policy(app: str) -> Contract | None:
    """The policy's contract, once it can act; raises what keeps it from loading."""
    with RemoteAgent(f"serve://{app}", transport="handle", connect_timeout_s=_LOADING_S) as agent:
        return agent.contract


def _check(keys: Keys, app: str, key: str | None) -> None:
    keys.check(key, app)


def _connector(app: str, rank: RankName, *, keyed: bool) -> Connect:
    def connect(key: str | None) -> RemoteAgent:
        # Who was let in without a key has none to show at the replica's shared memory; the handle asks for none.
        return RemoteAgent(
            f"serve://{app}",
            transport="handle" if keyed and key is None else "auto",
            rank=rank,
            timeout_s=_ANSWER_S,
            connect_timeout_s=_ANSWER_S,
            api_key=key,
        )

    return connect


def _door(args: GatewayArgs, house: House, listener: Any) -> Door:
    if isinstance(args, GR00TArgs):
        from vlagents_ray.serve.gateways.gr00t import GR00TDoor

        return GR00TDoor(house, args, listener)
    if isinstance(args, VlagentsArgs):
        from vlagents_ray.serve.gateways.vlagents import VlagentsDoor

        return VlagentsDoor(house, args, listener, importlib.metadata.version("vlagents-ray"))
    raise ConfigError(f"no door for {type(args).__name__}")
