"""The Ray Serve deployment around an engine: one replica, one policy, one batch queue."""

from __future__ import annotations

import asyncio
import faulthandler
import importlib.metadata
import logging
import os
from collections import Counter
from dataclasses import asdict
from functools import partial
from typing import Any

import ray
from ray import serve
from ray.serve.exceptions import RayServeException
from starlette.types import ASGIApp

from vlagents_ray.client.transports.serve_handle import ClientApi
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.policies.base.program import loaded_code
from vlagents_ray.protocol.messages import PROTOCOL_VERSION, SERVERS_MACHINE, boot_id
from vlagents_ray.ray_tools.git_state import code_of
from vlagents_ray.ray_tools.private import http_options, replica_is_ending
from vlagents_ray.registry import names
from vlagents_ray.serve.access.api_keys import NoKey, require_access, warn_of_plain_http
from vlagents_ray.serve.access.audit import write_audit
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.dialects.base import ReplicaContext
from vlagents_ray.serve.dialects.routes import describe, dialect_routes, require_fit
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.plasma import PlasmaServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.endpoints.unix_messages import Admit
from vlagents_ray.serve.endpoints.websocket import WebSocketServer
from vlagents_ray.serve.endpoints.weights import weights_routes
from vlagents_ray.serve.live.endpoint import live_routes
from vlagents_ray.serve.models.checkpoints import resolved
from vlagents_ray.serve.ports import EVERYWHERE, HOST, LOOPBACK
from vlagents_ray.serve.queue.batch_queue import LoadMeter
from vlagents_ray.serve.replica.engine_replica import EngineReplica
from vlagents_ray.serve.replica.live import ReplicaLive
from vlagents_ray.serve.replica.metrics import Exporter, tags_of
from vlagents_ray.serve.replica.recording import open_recorder
from vlagents_ray.serve.replica.shadow import ReplicaShadow
from vlagents_ray.serve.replica.weights import ReplicaWeights
from vlagents_ray.serve.scaling.autoscaling import SESSIONS, UTILISATION, WAITING
from vlagents_ray.serve.scaling.held_sessions import PEER_METHODS
from vlagents_ray.serve.scaling.rebalancer import Rebalancer
from vlagents_ray.serve.scaling.replica_selection import ClientLocation, ReplicaLoad
from vlagents_ray.serve.scaling.session_migration import SessionMigrator
from vlagents_ray.serve.scaling.sibling_replicas import SiblingApi, SiblingReplicas

logger = logging.getLogger(__name__)

_WATCH_S = 0.25
_LOCKED_S = 1.0  # delay after a call's limit, which `notice_hung` reports unless the interpreter's lock is held
_STDERR = 2
_GATEWAY_POLL_S = 10.0


class PolicyReplica(EngineReplica, ReplicaWeights, ReplicaLive, ReplicaShadow, ClientApi, SiblingApi):
    """One replica of the policy, with all the ways in that clients use.

    Until the first replica runs, Serve's proxies reply for the application: see `vlagents_ray.serve.scaling.router` and
    `vlagents_ray.serve.launch.haproxy`.
    """

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self, args: dict[str, Any], gateway: Any = None, candidate: Any = None
    ) -> None:
        """Make the replica with the settings `args`; handles make the other two a part of the application."""
        self._gateway = gateway
        self._gateways: dict[str, Any] = {}
        self._args = ServerArgs(**args)
        self._app = serve.get_replica_context().app_name
        policy = names("policies").get(self._args.policy, self._args.policy)
        self._code = code_of(policy)
        wrappers = [name for one in self._args.wrappers for name in ([one] if isinstance(one, str) else one)]
        wrappers = [names("wrappers").get(name, name) for name in wrappers]
        self._program = {name: of for one in (policy, *wrappers) for name, of in loaded_code(one).items()}
        self._keys = self._args.access.keys()
        require_access(http_options().host or EVERYWHERE, self._keys, self._args.access.insecure)
        if self._keys is not None:
            write_audit()
            if not self._args.access.plain_http:
                warn_of_plain_http(_plain_host())
        self._peers = SiblingReplicas()
        self._migrator = SessionMigrator(self._peers.others, asyncio.get_running_loop())
        self._open_engine(self._args, partial(require_fit, self._args.dialects), self._migrator)
        self._migrator.start(self._engine)
        self._open_weights(self._engine, self._peers)
        self._open_live(self._engine, self._peers, self.metadata, self._args.live, self._args.viewers)
        self._open_shadow(self._engine, self._args.shadow, candidate)
        self._meter = LoadMeter(self._engine.queue)
        self._recorder = open_recorder(self._engine, self._args.record, self._peers.own_name, self.metadata)
        self._metrics = Exporter(
            self._engine, tags_of(self._args.policy), self._keys, self._shadow_drops, self._recorder
        )
        self._metrics.start()
        self._rebalancer = Rebalancer(self._engine, self._peers, self._load_of)
        has_files = hasattr(os, "memfd_create")
        self._local = ShmServer(self._engine, self._limits, self._admit()) if has_files else None
        self._plasma = PlasmaServer(self._engine, self._limits) if self._local is not None else None
        self._stream = self._stream_endpoint()
        for endpoint in (self._local, self._plasma, self._stream):
            if endpoint is not None:
                endpoint.open()

    async def _start(self) -> None:
        await super()._start()
        await self._follow_others()
        self._rebalancer.start()
        self._shutdown_watch = asyncio.ensure_future(self._watch_shutdown())
        if self._gateway is not None:
            self._gateway_poll = asyncio.ensure_future(self._poll_gateways())

    def __serve_build_asgi_app__(self) -> ASGIApp:
        slow_s, idle_s = self._args.limits.slow_s, self._args.sessions.idle_s
        dialects = dialect_routes(self._args.dialects, ReplicaContext(self._engine, self.metadata, self._limits))
        insecure, hosts = self._args.access.insecure, self._args.access.hosts
        others = [
            *weights_routes(self, slow_s, open_to_network=insecure),
            *live_routes(self._fleet, open_to_network=insecure),
        ]
        inside = build_http_app(self._engine, self.metadata, self._limits, self._metadata_for_machine, dialects, others)
        return AccessMiddleware(inside, self._keys, self._app, slow_s=slow_s, idle_s=idle_s, hosts=hosts)

    def _admit(self) -> Admit | NoKey:
        """Return the check of keys at the replica's own ports, or the reason why none is needed."""
        return NoKey.OPEN if self._keys is None else partial(self._keys.check, app=self._app)

    async def refusal(self) -> str | None:
        """Return the full reason why the policy cannot act yet, for the process that starts the server; else None."""
        try:
            self._engine.check_health()
        except Exception as error:  # noqa: BLE001 - a policy's own check may raise any error
            return str(error)
        return None

    def metadata(self) -> dict[str, Any]:
        """Return the document of `GET /v1/metadata` and `RemoteAgent.metadata`."""
        contract, models = self._engine.contract, self._engine.models
        return {
            "policy": self._args.policy,
            "checkpoint": resolved(models.config),
            "weights": models.weights,
            "devices": models.devices,
            "policy_version": self._engine.weights.describe(),
            "checkpoints": models.describe(),
            "config": models.config,
            "contract": None if contract is None else contract.to_json(),
            "continues_plans": models.continues_plans,
            "protocol": PROTOCOL_VERSION,
            "version": importlib.metadata.version("vlagents-ray"),
            "code": None if self._code is None else self._code.to_json(),
            "program": self._program | models.files,
            "dialects": describe(self._args.dialects) | self._gateways,
            "local": None if self._local is None else asdict(self._local.address),
            "stream": None if self._stream is None else asdict(self._stream.address),
            "shadow": self._shadow_description,
        }

    def _stream_endpoint(self) -> WebSocketServer | None:
        stream = self._args.stream
        if not stream.enabled:
            return None
        return WebSocketServer(
            self._engine,
            self._limits,
            _plain_host(),
            stream.ports,
            self._admit(),
            slow_s=self._args.limits.slow_s,
            idle_s=self._args.sessions.idle_s,
            hosts=self._args.access.hosts,
        )

    async def attach(self, node: str = "", boot_id: str = "", must_be_near: bool = False) -> tuple[dict[str, Any], Any]:
        """Return the metadata and the actor of the least loaded replica, near the client if possible.

        A session must stay on one replica, which a Serve handle does not guarantee; therefore the client calls the
        actor's own entry point for every further request.

        Args:
            node: The id of the client's node, which is in the cluster; replicas on this node are preferred.
            boot_id: The boot id of the client's machine.
            must_be_near: Whether the client's transport reaches no other machine.
        """
        place = ClientLocation(node, boot_id, must_be_near)
        return await self._place_at_sibling(place) or self._connection_info()

    async def expect_client(self) -> tuple[dict[str, Any], Any]:
        """Return metadata and actor for a client that another replica redirects to this one."""
        self._rebalancer.expect_client()
        return self._connection_info()

    def _connection_info(self) -> tuple[dict[str, Any], Any]:
        plasma = None if self._plasma is None else asdict(self._plasma.plasma)
        return self.metadata() | {"plasma": plasma}, ray.get_runtime_context().current_actor

    async def load(self) -> ReplicaLoad:
        """Return this replica's load, which other replicas compare with theirs."""
        return self._rebalancer.load()

    async def nodes(self) -> dict[str, int]:
        """Return the number of replicas that accept sessions by node, so that clients can be placed near them."""
        loads = [self._rebalancer.load(), *await asyncio.to_thread(self._peers.loads)]
        return dict(Counter(load.node for load in loads if load.accepts))

    async def _metadata_for_machine(self, caller: str) -> dict[str, Any]:
        """Return the metadata of the least loaded replica on the machine with the boot id `caller`, or else on this."""
        machines = (caller,) * (caller != SERVERS_MACHINE) + (boot_id(),)
        places = [ClientLocation(boot_id=machine, must_be_near=True) for machine in machines]
        metadata, _ = await self._place_at_sibling(*places) or (self.metadata(), None)
        return {key: value for key, value in metadata.items() if key != "plasma"}

    async def _place_at_sibling(self, *places: ClientLocation) -> tuple[dict[str, Any], Any] | None:
        """Return metadata and actor of another replica if it suits the client better, see `Rebalancer.place`."""
        reference = await asyncio.wrap_future(self._rebalancer.place(*places))
        if reference is None:
            return None
        found: tuple[dict[str, Any], Any] | None = await asyncio.to_thread(self._peers.answer, reference)
        return found

    def _load_of(self, sessions: int) -> ReplicaLoad:
        accepts = self._engine.ready and not (self._engine.draining or replica_is_ending())
        node = ray.get_runtime_context().get_node_id()
        return ReplicaLoad(self._peers.own_name, sessions, accepts, node, boot_id(), self._engine.version)

    async def lease(self, length: int) -> tuple[bytes, int]:
        """Lease a plasma channel for frames of `length` bytes to a client that got the address from `attach`."""
        if self._plasma is None:
            raise PolicyUnavailable("plasma: this replica has no plasma endpoint; use transport 'handle'")
        return await asyncio.to_thread(self._plasma.pool.lease, length)

    async def call(self, session_id: str, frame: Any) -> bytes:
        """Execute a frame of requests from inside the cluster, a buffer that is read in place from plasma."""
        _, message = await self._ask(session_id, frame)
        return message.frame()

    async def peer(self, method: str, *args: Any) -> Any:
        """Call one of `PEER_METHODS` for another replica, about sessions that migrate."""
        return await PEER_METHODS[method](self._migrator.held, *args)

    def record_autoscaling_stats(self) -> dict[str, float]:
        """Return the load since the last call, for `MeasuredLoad`; called periodically by Serve."""
        load = self._meter.read()
        return {
            UTILISATION: load.utilisation,
            WAITING: load.waiting / self._args.batch.max_size,
            SESSIONS: float(len(self._engine.sessions)),
        }

    async def _watch_shutdown(self) -> None:
        """Drain the engine as soon as Serve stops this replica, if other replicas can take its clients.

        Until then, detect a policy that hangs. A policy that holds the interpreter's lock blocks this task, too: then a
        thread that needs no lock writes the stack traces into the log.
        """
        while not replica_is_ending():
            faulthandler.dump_traceback_later(self._engine.calls.limits.act_s + _LOCKED_S, file=_STDERR)
            await asyncio.sleep(_WATCH_S)
            self._engine.notice_hung()
        faulthandler.cancel_dump_traceback_later()
        if await asyncio.to_thread(_others_run):
            self._engine.drain()

    async def _poll_gateways(self) -> None:
        """Ask the gateway periodically for its addresses, which may change without a restart of this replica."""
        while True:
            try:
                self._gateways = await self._gateway.description.remote()  # waits until the gateway runs
            except (ray.exceptions.RayError, RayServeException) as error:
                self._gateways = {}
                logger.info("the gateway does not say where it listens: %s", error)
            await asyncio.sleep(_GATEWAY_POLL_S)

    async def __del__(self) -> None:
        if not hasattr(self, "_engine"):
            return
        for task in ("_shutdown_watch", "_gateway_poll", "_catching_up"):
            if hasattr(self, task):
                getattr(self, task).cancel()
        if self._engine.draining:
            await self._migrator.hand_over()
        await asyncio.to_thread(self._close_live)
        self._close_shadow()
        self._rebalancer.close()
        await self._migrator.close()
        for part in (self._engine, self._recorder, self._metrics):
            if part is not None:
                await asyncio.to_thread(part.close)
        for endpoint in (self._local, self._plasma, self._stream):
            if endpoint is not None:
                endpoint.close()


def _plain_host() -> str:
    """Return the address for unencrypted ports: loopback if Serve's own port is encrypted."""
    http = http_options()
    return os.environ.get(HOST) or (LOOPBACK if http.ssl_certfile else http.host or EVERYWHERE)


def _others_run() -> bool:
    """Whether the application has a replica that accepts requests."""
    context = serve.get_replica_context()
    app = serve.status().applications.get(context.app_name)
    policy = None if app is None else app.deployments.get(context.deployment)
    return policy is not None and policy.replica_states.get("RUNNING", 0) > 0
