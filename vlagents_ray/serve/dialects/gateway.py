"""The Serve deployment of the dialects with their own port: a separate process, which is a
client of the replicas.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from functools import partial
from typing import Any

from ray import serve

from vlagents_ray.client.agent import RemoteAgent
from vlagents_ray.contract import Contract
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.protocol.messages import PriorityName
from vlagents_ray.registry import dialect_class
from vlagents_ray.serve.access.api_keys import NoKey, require_access
from vlagents_ray.serve.access.audit import write_audit
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.dialects.base import GatewayContext, PortDialect
from vlagents_ray.serve.engine.admission import Admission
from vlagents_ray.serve.ports import LOOPBACK, reserve

_LOADING_S = 3600.0  # time limit for loading the policy; a failure is raised immediately
_ANSWER_S = 30.0


class Gateway:
    """Reserves its ports at the start; it is RUNNING and accepts clients only when the policy
    can act.
    """

    async def __init__(self, args: dict[str, Any]) -> None:  # type: ignore[misc]  # Serve awaits it
        self._dialects: list[PortDialect] = []
        settings = ServerArgs(**args)
        self._description = settings.dialects.describe()
        await asyncio.to_thread(self._open, settings)

    def _open(self, args: ServerArgs) -> None:
        """Reserve the ports, wait for the policy, and begin to accept clients."""
        configs = args.dialects.gateways()
        keys = args.access.keys()
        if keys is not None:
            write_audit()
        for config in configs.values():
            require_access(config.host or LOOPBACK, keys, args.access.insecure)
        listeners = {
            name: reserve(name, config.host or LOOPBACK, config.port)
            for name, config in configs.items()
        }

        try:
            app = serve.get_replica_context().app_name
            policy = wait_for_policy(app)
            args.dialects.require_fit(policy.contract)

            limits = args.limits.limits()
            admission = Admission(limits.in_flight_bytes)
            for name, config in configs.items():
                context = GatewayContext(
                    app=app,
                    connect=partial(_connect, app, config.priority, keys is not None),
                    limits=limits,
                    sessions=args.sessions.limit,
                    idle_s=args.sessions.idle_s,
                    contract=policy.contract,
                    check=NoKey.OPEN if keys is None else partial(keys.check, app=app),
                    admission=admission,
                    continues_plans=policy.continues_plans,
                    longest_prefix=policy.longest_prefix,
                )
                self._dialects.append(dialect_class(name)(name, config, context))

            for dialect in self._dialects:
                dialect.serve(listeners[dialect.name])
        except BaseException:
            for listener in listeners.values():
                listener.close()
            raise

    async def description(self) -> dict[str, Any]:
        """Return the description of the dialects for the metadata of replicas, see
        `DialectArgs.describe`.
        """
        return self._description

    def check_health(self) -> None:
        """Raise an error if a dialect no longer accepts clients; Serve calls this, and then
        replaces the gateway.
        """
        failed = [dialect.name for dialect in self._dialects if not dialect.alive()]
        if failed:
            raise PolicyUnavailable(
                f"the gateway no longer accepts clients of {failed}; its log has the details"
            )

    async def __del__(self) -> None:
        closing = [asyncio.to_thread(dialect.close) for dialect in getattr(self, "_dialects", [])]
        await asyncio.gather(*closing)


@dataclass(frozen=True, slots=True)
class ServedPolicy:
    """The properties of the policy that the gateway needs before it accepts clients."""

    contract: Contract | None
    continues_plans: bool
    longest_prefix: int


def wait_for_policy(app: str) -> ServedPolicy:
    """Wait until the policy can act and describe it; raise the error if loading fails."""
    with RemoteAgent(f"serve://{app}", transport="handle", connect_timeout_s=_LOADING_S) as agent:
        return ServedPolicy(agent.contract, agent.continues_plans, agent.longest_prefix)


def _connect(
    app: str, priority: PriorityName, keyed: bool, key: str | None, allowed: PriorityName | None
) -> RemoteAgent:
    """Connect to the application for one client.

    The gateway itself enforces the permissions of the key, in `GatewaySessions`, since not every
    transport to a replica transmits the key. Shared memory requires a key, which some clients lack;
    a Serve handle does not.
    """
    return RemoteAgent(
        f"serve://{app}",
        transport="handle" if keyed and key is None else "auto",
        priority=allowed or priority,
        timeout_s=_ANSWER_S,
        connect_timeout_s=_ANSWER_S,
        api_key=key,
    )
