"""The Ray Serve deployment around an engine: one replica, one policy, one batch queue."""

from __future__ import annotations

import asyncio
import faulthandler
import importlib.metadata
import logging
import os
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any

import ray
from ray import serve
from ray.serve.exceptions import RayServeException
from starlette.types import ASGIApp

from vlagents_ray.client.transports.serve_handle import ClientApi
from vlagents_ray.errors import PolicyUnavailable, UnknownSession
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
from vlagents_ray.serve.models.checkpoints import resolved
from vlagents_ray.serve.observers.live_page import live_routes
from vlagents_ray.serve.observers.live_view import Fleet, Snapshot
from vlagents_ray.serve.observers.opening import open_observers
from vlagents_ray.serve.ports import EVERYWHERE, HOST, LOOPBACK
from vlagents_ray.serve.queue.batch_queue import LoadMeter
from vlagents_ray.serve.replica.candidate import CandidateLink
from vlagents_ray.serve.replica.engine_replica import ReplicaEngine
from vlagents_ray.serve.replica.metrics import Exporter, tags_of
from vlagents_ray.serve.scaling.autoscaling import SESSIONS, UTILISATION, WAITING
from vlagents_ray.serve.scaling.rebalancer import ClientLocation, Rebalancer, ReplicaLoad
from vlagents_ray.serve.scaling.session_migration import PEER_METHODS, SessionMigrator
from vlagents_ray.serve.scaling.sibling_replicas import ReplicaViews, SiblingApi, SiblingReplicas
from vlagents_ray.serve.scaling.weight_push import OwnWeights, Values, WeightPusher, WeightsReplica
from vlagents_ray.serve.weights import HeldVersion, NewestVersion, PushOptions, PushResult
from vlagents_ray.weights.safetensors import ValueSpec

logger = logging.getLogger(__name__)

_WATCH_S = 0.25
_LOCKED_S = 1.0  # delay after a call's limit, which `notice_hung` reports unless the interpreter's lock is held
_STDERR = 2
_GATEWAY_POLL_S = 10.0
_CATCH_UP_S = 10.0  # interval of the questions whether this replica has missed a version of the weights


class PolicyReplica(ClientApi, SiblingApi):
    """One replica of the policy, with all the ways in that clients use.

    Ray calls its methods by name: Serve those of a deployment, clients inside the cluster those of `ClientApi`, and
    other replicas those of `SiblingApi` and `WeightsReplica`. Until the first replica runs, Serve's proxies reply for
    the application: see `vlagents_ray.serve.scaling.router` and `vlagents_ray.serve.launch.haproxy`.
    """

    _opened = False  # whether there is something to close

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self, args: dict[str, Any], gateway: Any = None, candidate: Any = None
    ) -> None:
        """Make the replica with the settings `args`; handles make the other two a part of the application."""
        self._args = settings = ServerArgs(**args)
        self._gateway = gateway
        self._gateways: dict[str, Any] = {}
        self._app = serve.get_replica_context().app_name
        policy = names("policies").get(settings.policy, settings.policy)
        self._code = code_of(policy)
        wrappers = [name for one in settings.wrappers for name in ([one] if isinstance(one, str) else one)]
        wrappers = [names("wrappers").get(name, name) for name in wrappers]
        self._program = {name: of for one in (policy, *wrappers) for name, of in loaded_code(one).items()}
        self._keys = settings.access.keys()
        require_access(http_options().host or EVERYWHERE, self._keys, settings.access.insecure)
        write_audit()  # without keys as well: of the buttons that are pressed on the live page
        if self._keys is not None and not settings.access.plain_http:
            warn_of_plain_http(_plain_host())
        self._tasks: list[asyncio.Task[None]] = []

        # The engine, and what it shares with the other replicas.
        self._peers = SiblingReplicas()
        self._migrator = SessionMigrator(self._peers.others, asyncio.get_running_loop())
        self._policy = ReplicaEngine.from_args(settings, partial(require_fit, settings.dialects), self._migrator)
        self._engine, self._limits = self._policy.engine, self._policy.limits
        self._migrator.start(self._engine)
        self._rebalancer = Rebalancer(self._engine, self._peers, self._load_of)
        self._weights = OwnWeights(self._peers.own_name, self._engine.weights)
        self._pusher = WeightPusher(self._weights, self._peers.others)

        # What is seen of it.
        node = ray.get_runtime_context().get_node_id()[:8]
        ask = None if candidate is None else CandidateLink(candidate)
        self._observers = open_observers(self._engine, settings, self._peers.own_name, node, self.metadata, ask)
        self._fleet = Fleet(self._observers.view, ReplicaViews([self._app], but=self._peers.own_name))
        self._meter = LoadMeter(self._engine.queue)
        self._metrics = Exporter(self._engine, tags_of(settings.policy), self._keys, self._observers)
        self._metrics.start()

        # The ways in.
        has_files = hasattr(os, "memfd_create")
        self._local = ShmServer(self._engine, self._limits, self._admit()) if has_files else None
        self._plasma = PlasmaServer(self._engine, self._limits) if has_files else None
        self._stream = self._stream_endpoint()
        self._opened = True
        for endpoint in (self._local, self._plasma, self._stream):
            if endpoint is not None:
                endpoint.open()

    async def reconfigure(self, settings: dict[str, Any] | None, rank: Any) -> None:
        """Apply the file's `user_config`; called by Serve before the replica is ready, and when the settings change.

        An error of the first call makes the start of the replica fail. `rank` is not used, but Serve calls a method
        with this parameter also without a `user_config`.
        """
        if not self._policy.configure(settings):
            return
        await self._policy.load()
        await self._catch_up()  # takes the others' versions before this replica is ready
        self._rebalancer.start()
        works = [self._watch_shutdown(), self._keep_catching_up()]
        if self._gateway is not None:
            works.append(self._poll_gateways())
        self._tasks = [asyncio.ensure_future(work) for work in works]

    async def close(self) -> None:
        """Close everything: first what gives or takes work, then the engine, then what observes it, the ways in last.

        So the engine answers what waits, over ways that are still open, and observers see all of it.
        """
        for task in self._tasks:
            task.cancel()
        if self._engine.draining:
            await self._migrator.hand_over()
        self._rebalancer.close()
        await self._migrator.close()
        for part in (self._engine, self._observers, self._metrics):
            await asyncio.to_thread(part.close)
        for endpoint in (self._local, self._plasma, self._stream):
            if endpoint is not None:
                endpoint.close()

    async def __del__(self) -> None:
        if self._opened:
            await self.close()

    async def check_health(self) -> None:
        """Raise if the policy died or hangs; Serve calls this once the policy has loaded, and replaces the replica."""
        await self._policy.check_health()

    async def refusal(self) -> str | None:
        """Return the full reason why the policy cannot act yet, for the process that starts the server; else None."""
        try:
            self._engine.check_health()
        except Exception as error:  # noqa: BLE001 - a policy's own check may raise any error
            return str(error)
        return None

    def record_autoscaling_stats(self) -> dict[str, float]:
        """Return the load since the last call, for `MeasuredLoad`; called periodically by Serve."""
        load = self._meter.read()
        return {
            UTILISATION: load.utilisation,
            WAITING: load.waiting / self._args.batch.max_size,
            SESSIONS: float(len(self._engine.sessions)),
        }

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

    def metadata(self) -> dict[str, Any]:
        """Return the document of `GET /v1/metadata` and `RemoteAgent.metadata`."""
        contract, models, shadow = self._engine.contract, self._engine.models, self._args.shadow
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
            "shadow": None if shadow is None else shadow.model_dump(include={"policy", "share"}),
        }

    # Clients inside the cluster: `ClientApi`.

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

    async def call(self, session_id: str, frame: Any) -> bytes:
        """Execute a frame of requests from inside the cluster, a buffer that is read in place from plasma."""
        return await self._policy.call(session_id, frame)

    async def lease(self, length: int) -> tuple[bytes, int]:
        """Lease a plasma channel for frames of `length` bytes to a client that got the address from `attach`."""
        if self._plasma is None:
            raise PolicyUnavailable("plasma: this replica has no plasma endpoint; use transport 'handle'")
        return await asyncio.to_thread(self._plasma.pool.lease, length)

    async def nodes(self) -> dict[str, int]:
        """Return the number of replicas that accept sessions by node, so that clients can be placed near them."""
        loads = [self._rebalancer.load(), *await asyncio.to_thread(self._peers.loads)]
        return dict(Counter(load.node for load in loads if load.accepts))

    def _connection_info(self) -> tuple[dict[str, Any], Any]:
        plasma = None if self._plasma is None else asdict(self._plasma.plasma)
        return self.metadata() | {"plasma": plasma}, ray.get_runtime_context().current_actor

    async def _metadata_for_machine(self, caller: str) -> dict[str, Any]:
        """Return the metadata of the least loaded replica on the machine with the boot id `caller`, or else on this."""
        machines = [boot_id()] if caller == SERVERS_MACHINE else [caller, boot_id()]
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

    # Other replicas: `SiblingApi`.

    async def load(self) -> ReplicaLoad:
        """Return this replica's load, which other replicas compare with theirs."""
        return self._rebalancer.load()

    def _load_of(self, sessions: int) -> ReplicaLoad:
        accepts = self._engine.ready and not (self._engine.draining or replica_is_ending())
        node = ray.get_runtime_context().get_node_id()
        return ReplicaLoad(self._peers.own_name, sessions, accepts, node, boot_id(), self._engine.version)

    async def expect_client(self) -> tuple[dict[str, Any], Any]:
        """Return metadata and actor for a client that another replica redirects to this one."""
        self._rebalancer.expect_client()
        return self._connection_info()

    async def peer(self, method: str, *args: Any) -> Any:
        """Call one of `PEER_METHODS` for another replica, about sessions that migrate."""
        return await PEER_METHODS[method](self._migrator.held, *args)

    async def live(self, since: int, shown: Collection[str]) -> Snapshot:
        """Return what happened here since a snapshot, with pictures of the sessions `shown`."""
        return await asyncio.to_thread(self._observers.view.read, since, shown)

    async def press(self, session: str, do: str, by: str) -> dict[str, Any] | None:
        """Give a command to a session; None if the session is not here."""
        try:
            return self._observers.view.press(session, do, by)
        except UnknownSession:
            return None

    # New weights: from learners, and from the replica that coordinates a push (`WeightsReplica`).

    async def push_weights(self, values: Values, options: PushOptions) -> PushResult:
        """Let all replicas act with new weights; called by a learner."""
        return await self._pusher.push(values, options)

    async def push_received(self, named: Mapping[str, Any], options: PushOptions) -> PushResult:
        """Let all replicas act with new weights, which this one has received over the network."""
        if not await self._peers.others():
            return await self._pusher.push(named, options)
        reference = await asyncio.to_thread(ray.put, named)  # a copy, for which no robot on this event loop waits
        return await self._pusher.push([reference], options)

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Check weights that are to be received."""
        return self._engine.weights.read_header(header, options)

    async def versions_of_weights(self) -> list[int]:
        """Return the newest version of each replica that can be reached; called by a learner."""
        replicas: list[WeightsReplica] = [self._weights, *await self._peers.others()]
        found = await asyncio.gather(*(replica.newest_weights() for replica in replicas), return_exceptions=True)
        return [newest.number for newest in found if isinstance(newest, NewestVersion)]

    async def newest_weights(self) -> NewestVersion:
        """Return the newest version that acts here."""
        return await self._weights.newest_weights()

    async def stage_weights(self, number: int, values: Values, options: PushOptions) -> str:
        """Check and hold a version."""
        return await self._weights.stage_weights(number, values, options)

    async def commit_weights(self, number: int, options: PushOptions) -> None:
        """Act with the staged version."""
        await self._weights.commit_weights(number, options)

    async def drop_weights(self, number: int) -> None:
        """Drop the staged version."""
        await self._weights.drop_weights(number)

    async def held_weights(self) -> list[HeldVersion]:
        """Return the pushed versions that new episodes act with."""
        return await self._weights.held_weights()

    # What the replica does by itself.

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

    async def _keep_catching_up(self) -> None:
        """Take the others' versions of the weights whenever this replica has missed one."""
        while True:
            await asyncio.sleep(_CATCH_UP_S)
            await self._catch_up()

    async def _catch_up(self) -> None:
        try:
            await self._pusher.catch_up()
        except Exception:
            logger.exception("the newest weights were not taken from the other replicas; tried again later")

    async def _poll_gateways(self) -> None:
        """Ask the gateway periodically for its addresses, which may change without a restart of this replica."""
        while True:
            try:
                self._gateways = await self._gateway.description.remote()  # waits until the gateway runs
            except (ray.exceptions.RayError, RayServeException) as error:
                self._gateways = {}
                logger.info("the gateway does not say where it listens: %s", error)
            await asyncio.sleep(_GATEWAY_POLL_S)


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
