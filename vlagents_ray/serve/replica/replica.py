"""The Ray Serve deployment around an engine: one replica, one policy, one batch queue."""

from __future__ import annotations

import asyncio
import faulthandler
import logging
import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from typing import Any

import ray
from ray import serve
from ray.serve.exceptions import RayServeException
from starlette.types import ASGIApp

from vlagents_ray.client.transports.serve_handle import ClientApi
from vlagents_ray.errors import ConnectionLost, PolicyFailed, PolicyUnavailable, VLAgentsError
from vlagents_ray.policies.base.accelerator import GPU_SHARE, VISIBLE
from vlagents_ray.protocol.frames import Decoded, decode_requests
from vlagents_ray.protocol.messages import (
    PROTOCOL_VERSION,
    SERVERS_MACHINE,
    MessageLimits,
    StreamAddress,
    boot_id,
)
from vlagents_ray.ray_tools.private import (
    check_replica,
    gpus_here,
    has_channels,
    http_options,
    replica_is_ending,
)
from vlagents_ray.ray_tools.session import cluster_id
from vlagents_ray.serve.access.api_keys import NoKey, require_access, warn_of_plain_http
from vlagents_ray.serve.access.audit import write_audit
from vlagents_ray.serve.access.charges import free
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.dialects.base import ReplicaContext, dialect_routes
from vlagents_ray.serve.endpoints import answers
from vlagents_ray.serve.endpoints.access_middleware import AccessMiddleware
from vlagents_ray.serve.endpoints.asgi_websocket import AsgiWebSockets
from vlagents_ray.serve.endpoints.connection import KeyCheck
from vlagents_ray.serve.endpoints.direct_requests import DirectRequests, set_for_this_replica
from vlagents_ray.serve.endpoints.http import build_http_app
from vlagents_ray.serve.endpoints.own_port import OwnPortServer
from vlagents_ray.serve.endpoints.plasma import PlasmaServer
from vlagents_ray.serve.endpoints.shm import ShmServer
from vlagents_ray.serve.endpoints.shutdown import Shutdown
from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.engine.sender import Sender, message_admission
from vlagents_ray.serve.local_agent import build_engine, policy_metadata
from vlagents_ray.serve.ports import EVERYWHERE, HOST, LOOPBACK
from vlagents_ray.serve.queue.batch_queue import LoadMeter
from vlagents_ray.serve.replica.metrics import Exporter, tags_of
from vlagents_ray.serve.replica.part import PartContext, open_parts
from vlagents_ray.serve.scaling.autoscaling import SESSIONS, UTILISATION
from vlagents_ray.serve.scaling.rebalancer import ClientLocation, Rebalancer, ReplicaLoad
from vlagents_ray.serve.scaling.session_migration import HeldSessions, SessionMigrator
from vlagents_ray.serve.scaling.sibling_replicas import PEER_METHODS, SiblingApi, SiblingReplicas

logger = logging.getLogger(__name__)

_WATCH_S = 0.25
# Delay after a call's time limit before a thread without the interpreter's lock reports the call.
# `notice_hung` reports it earlier unless the call holds the lock.
_LOCKED_S = 1.0
_STDERR = 2
_GATEWAY_POLL_S = 10.0
# Time for clients of a draining replica to connect to another replica before their WebSockets are
# closed, s.
_LEAVE_S = 5.0


class PolicyReplica(ClientApi, SiblingApi):
    """One replica of the policy, with all endpoints for clients.

    Ray calls its methods by name: Serve calls the methods of a deployment, clients inside the
    cluster call the methods of `ClientApi`, and other replicas call the methods of `SiblingApi`.
    Until the first replica runs, Serve's proxies reply for the application: see
    `vlagents_ray.serve.scaling.router` and `vlagents_ray.serve.launch.haproxy`.
    """

    _opened = False  # whether `close` has something to close

    async def __init__(  # type: ignore[misc]  # Serve awaits it
        self, args: dict[str, Any], gateway: Any = None
    ) -> None:
        """Create the replica with the settings `args`. Serve adds the deployment of the gateway to
        the application because its handle is an argument.
        """
        check_replica()
        self._args = settings = ServerArgs(**args)
        self._gateway = gateway
        self._gateways: dict[str, Any] = {}
        self._app = serve.get_replica_context().app_name
        self._cluster = cluster_id()
        self._code, self._program = settings.code()
        self._keys = settings.access.keys()
        require_access(http_options().host or EVERYWHERE, self._keys, settings.access.insecure)
        # The audit log is also needed without keys: it contains the buttons pressed on the live
        # page.
        write_audit()
        if self._keys is not None and not settings.access.plain_http:
            warn_of_plain_http(_plain_host())
        self._tasks: list[asyncio.Task[None]] = []
        self._shutdown = Shutdown()

        # The engine, and its components that communicate with other replicas.
        self._peers = SiblingReplicas()
        self._migrator = SessionMigrator(
            self._peers.own_name, self._peers.others, asyncio.get_running_loop()
        )
        self._limits = settings.limits.limits()
        if 0 < settings.resources.num_gpus < 1:
            os.environ.setdefault(GPU_SHARE, str(settings.resources.num_gpus))
        if VISIBLE not in settings.environment.env_vars:
            hide_gpus(ray.get_runtime_context().get_accelerator_ids().get("GPU", []))
        self._engine = build_engine(settings, settings.config, self._migrator)
        self._configured = False
        self._migrator.start(self._engine)
        self._rebalancer = Rebalancer(self._engine, self._peers, self._load_of)

        # The parts that plug-ins add, and the metrics.
        node = ray.get_runtime_context().get_node_id()[:8]
        tags = tags_of(settings.policy)
        context = PartContext(
            self._engine,
            self._peers.own_name,
            node,
            self.metadata,
            metric_tags=tags,
            open_to_network=settings.access.insecure,
            siblings=self._peers.others,
            slow_s=settings.limits.slow_s,
        )
        self._parts = open_parts(settings.parts, context)
        self._meter = LoadMeter(self._engine.queue)
        self._metrics = Exporter(self._engine, tags, self._keys)
        self._metrics.start()

        # The endpoints.
        has_files = hasattr(os, "memfd_create")
        check_key: KeyCheck | NoKey = (
            NoKey.OPEN if self._keys is None else partial(self._keys.check, app=self._app)
        )
        self._local = ShmServer(self._engine, self._limits, check_key) if has_files else None
        has_plasma = has_files and has_channels()
        self._plasma = PlasmaServer(self._engine, self._limits) if has_plasma else None
        self._stream = (
            _stream_endpoint(self._engine, settings, check_key) if settings.stream.enabled else None
        )
        # The WebSockets of the server's port, once Serve has requested its application.
        self._websockets: AsgiWebSockets | None = None
        self._opened = True
        for endpoint in (self._local, self._plasma, self._stream):
            if endpoint is not None:
                endpoint.open()

    async def reconfigure(self, settings: dict[str, Any] | None, rank: Any) -> None:
        """Apply the file's `user_config`; called by Serve before the replica is ready, and when the
        settings change.

        The first call loads the policy, so that Serve reports RUNNING only when the policy can act,
        and `serve status` shows the reason if it cannot. A later call loads the policy with the new
        settings in place of the current one. Serve calls this method of one replica after another,
        and sends no clients to a replica during the call. After an error, Serve replaces the
        replica; if the new settings fail again, other replicas keep the old ones.

        Args:
            settings: The policy's settings that replace those in `args`.
            rank: Not used, but without this parameter Serve does not call `reconfigure` if there is
                no `user_config`.
        """
        config = {**self._args.config, **(settings or {})}
        is_first, self._configured = not self._configured, True
        try:
            await asyncio.to_thread(self._engine.start if is_first else self._engine.swap, config)
        except PolicyFailed as error:
            if not isinstance(error.__cause__, VLAgentsError):
                raise
            logger.exception("the policy did not load")
            # Errors of this package contain the remedy. Without `from None`, `serve status` would
            # show both tracebacks first.
            raise PolicyFailed(str(error)) from None

        if is_first:
            await self._begin()

    async def _begin(self) -> None:
        """Start the replica's periodic tasks, before Serve reports that it runs."""
        await self._parts.before_ready()

        works = [
            self._watch_shutdown(),
            self._peers.announce_this_replica(),
            self._rebalancer.run(),
            self._parts.run(),
        ]
        if self._gateway is not None:
            works.append(self._poll_gateways())
        self._tasks = [asyncio.ensure_future(work) for work in works]

    async def close(self) -> None:
        """Close the replica: first the sources of requests, then the engine, the endpoints, and
        last the parts.

        In this order the engine can answer waiting requests over open endpoints, no client waits
        for the parts, and their observers receive all answers.
        """
        for task in self._tasks:
            task.cancel()
        if self._engine.draining:
            await self._migrator.hand_over()
        await self._migrator.close()
        await asyncio.to_thread(self._engine.close)
        for endpoint in (self._local, self._plasma, self._stream, self._websockets):
            if endpoint is not None:
                endpoint.close()
        for part in (self._parts, self._metrics):
            await asyncio.to_thread(part.close)

    async def __del__(self) -> None:
        if self._opened:
            await self.close()

    async def check_health(self) -> None:
        """Raise an error if the policy died or hangs. Serve calls this periodically once the policy
        is loaded, and replaces the replica after an error.
        """
        await asyncio.to_thread(self._engine.health.check)

    async def refusal(self) -> str | None:
        """Return the full reason why the policy cannot act, for the process that starts the
        server; None if it can.
        """
        try:
            self._engine.health.check()
        except Exception as error:  # noqa: BLE001 - a policy's own check may raise any error
            return str(error)
        return None

    def record_autoscaling_stats(self) -> dict[str, float]:
        """Return the load since the last call, for `MeasuredLoad`; called periodically by Serve."""
        return {
            UTILISATION: self._meter.read().needed(self._engine.pace.needed()),
            SESSIONS: float(len(self._engine.sessions)),
        }

    def __serve_build_asgi_app__(self) -> ASGIApp:
        slow_s, idle_s = self._args.limits.slow_s, self._args.sessions.idle_s
        hosts = self._args.access.hosts
        more = [
            *dialect_routes(
                self._args.dialects, ReplicaContext(self._engine, self.metadata, self._limits)
            ),
            *self._parts.routes(),
        ]
        inside = build_http_app(
            self._engine,
            self.metadata,
            self._limits,
            self._metadata_for_machine,
            more,
            self._direct_address(),
        )
        access = AccessMiddleware(
            inside,
            self._keys,
            self._app,
            slow_s=slow_s,
            idle_s=idle_s,
            hosts=hosts,
            admission=self._engine.admission,
            shutdown=self._shutdown,
            public=self._parts.pages(inside.routes),
        )
        self._websockets = access.websockets
        direct = DirectRequests(access)
        set_for_this_replica(direct)
        return direct

    def _direct_address(self) -> StreamAddress | None:
        """Return the address of this replica's own port for clients of the server's port; None if
        the server's port is encrypted, since the replica's own port is not encrypted.
        """
        is_encrypted = http_options().ssl_certfile is not None
        return None if self._stream is None or is_encrypted else self._stream.address

    def metadata(self) -> dict[str, Any]:
        """Return the document of `GET /v1/metadata` and `RemoteAgent.metadata`."""
        return policy_metadata(self._args, self._engine, self._code, self._program) | {
            "protocol": PROTOCOL_VERSION,
            "cluster": self._cluster,
            "dialects": self._args.dialects.describe() | self._gateways,
            "parts": self._parts.describe(),
            "local": None if self._local is None else asdict(self._local.address),
            "stream": None if self._stream is None else asdict(self._stream.address),
            "compact": True,  # WebSockets accept `vlagents_ray.protocol.compact`
        }

    # Clients inside the cluster: `ClientApi`.

    async def attach(
        self, node: str = "", boot_id: str = "", must_be_near: bool = False
    ) -> tuple[dict[str, Any], Any]:
        """Return the metadata and the actor of the least loaded replica, near the client if
        possible.

        A session must stay on one replica, which a Serve handle does not guarantee; therefore the
        client calls the actor's own entry point for every further request.

        Args:
            node: The id of the client's node, which is in the cluster; replicas on this node are
                preferred.
            boot_id: The boot id of the client's machine.
            must_be_near: Whether the client's transport reaches only its own machine.
        """
        location = ClientLocation(node, boot_id, must_be_near)
        return await self._rebalancer.redirect(location) or self._connection_info()

    async def call(self, session_id: str, frame: Any, pause: float) -> bytes | float:
        """Execute a frame of requests from inside the cluster. The frame is a buffer in plasma,
        which is read without a copy.
        """
        return await answer_frame(self._engine, self._limits, session_id, frame, pause)

    async def lease(self, length: int) -> tuple[bytes, int] | VLAgentsError:
        """Lease a plasma channel for frames of `length` bytes to a client that got the address
        from `attach`; return its id and its capacity, bytes, or the error.
        """
        if self._plasma is None:
            return PolicyUnavailable(
                "plasma: this replica has no plasma endpoint; use transport 'handle'"
            )
        try:
            return await asyncio.to_thread(self._plasma.pool.lease, length)
        except VLAgentsError as error:
            return error

    async def nodes(self) -> dict[str, int]:
        """Return the number of replicas that accept sessions on each node, so that clients can be
        placed near them.
        """
        loads = [self._rebalancer.load(), *await self._peers.loads()]
        return dict(Counter(load.node for load in loads if load.accepts))

    def _connection_info(self) -> tuple[dict[str, Any], Any]:
        plasma = None if self._plasma is None else asdict(self._plasma.plasma)
        return self.metadata() | {"plasma": plasma}, ray.get_runtime_context().current_actor

    async def _metadata_for_machine(self, caller: str) -> dict[str, Any]:
        """Return the metadata of the least loaded replica on the machine with boot id `caller`,
        or of this replica.
        """
        machines = [boot_id()] if caller == SERVERS_MACHINE else [caller, boot_id()]
        locations = [ClientLocation(boot_id=machine, must_be_near=True) for machine in machines]
        metadata, _ = await self._rebalancer.redirect(*locations) or (self.metadata(), None)
        return {key: value for key, value in metadata.items() if key != "plasma"}

    # Other replicas: `SiblingApi`.

    def _load_of(self, sessions: int) -> ReplicaLoad:
        accepts = self._engine.health.ready and not (self._engine.draining or replica_is_ending())
        node = ray.get_runtime_context().get_node_id()
        return ReplicaLoad(
            self._peers.own_name,
            sessions,
            accepts,
            node,
            boot_id(),
            self._engine.model.version,
        )

    async def expect_client(self) -> tuple[dict[str, Any], Any]:
        """Return metadata and actor for a client that another replica redirects to this replica."""
        self._rebalancer.expect_client()
        return self._connection_info()

    async def peer(self, method: str, *args: Any) -> Any:
        """Call one of `PEER_METHODS` for another replica; return its result or error."""
        part, call, _ = PEER_METHODS[method]
        try:
            if part is HeldSessions:
                return await call(self._migrator.sessions, *args)
            return call(self._rebalancer, *args)
        except VLAgentsError as error:
            return error

    async def call_part(self, part: str, method: str, *args: Any) -> Any:
        """Call a method of a part for the same part of another replica, or for a process of the
        cluster; return its result or error.
        """
        try:
            return await self._parts.call(part, method, *args)
        except VLAgentsError as error:
            return error

    # The replica's periodic tasks.

    async def _watch_shutdown(self) -> None:
        """Drain the engine as soon as Serve stops this replica, if other replicas can take its
        clients.

        The WebSockets are closed, since Serve waits for them before it calls `close`, and kills the
        replica after a time limit. Until then, this task detects a policy that hangs. A policy that
        holds the interpreter's lock also blocks this task; in that case a thread that needs no lock
        writes the stack traces into the log.
        """
        while not replica_is_ending():
            faulthandler.dump_traceback_later(
                self._engine.calls.limits.act_s + _LOCKED_S, file=_STDERR
            )
            await asyncio.sleep(_WATCH_S)
            self._engine.notice_hung()
        faulthandler.cancel_dump_traceback_later()
        if await asyncio.to_thread(_others_run):
            self._engine.drain_list.drain()
        self._shutdown.begin(_LEAVE_S if self._engine.draining else 0.0)

    async def _poll_gateways(self) -> None:
        """Query the gateway periodically for its addresses, which may change without a restart
        of this replica.
        """
        while True:
            try:
                # This call waits until the gateway runs.
                self._gateways = await self._gateway.description.remote()
            except (ray.exceptions.RayError, RayServeException) as error:
                self._gateways = {}
                logger.info("the gateway did not report its port: %s", error)
            await asyncio.sleep(_GATEWAY_POLL_S)


def _stream_endpoint(
    engine: Engine, args: ServerArgs, check_key: KeyCheck | NoKey
) -> OwnPortServer:
    slow_s, idle_s, hosts = args.limits.slow_s, args.sessions.idle_s, args.access.hosts
    host, ports, limits = _plain_host(), args.stream.ports, args.limits.limits()
    return OwnPortServer(
        engine, limits, host, ports, check_key, slow_s=slow_s, idle_s=idle_s, hosts=hosts
    )


def hide_gpus(assigned: Sequence[str]) -> None:
    """Hide the node's GPUs from this process and its children, unless Ray has `assigned` GPUs to
    it.

    Ray itself does not hide them from a replica with `num_gpus: 0`, which would use unreserved
    memory of the first GPU. Call this before anything uses CUDA.
    """
    if assigned:
        return

    gpus = gpus_here()
    if gpus:
        logger.warning(
            "this node has %g GPUs, which are hidden from the policy, since its resources are "
            "num_gpus: 0; with resources: {num_gpus: 1} it gets a GPU",
            gpus,
        )
    os.environ[VISIBLE] = ""


async def answer_frame(
    engine: Engine, limits: MessageLimits, session_id: str, frame: Any, pause: float
) -> bytes | float:
    """Execute a frame of requests from inside the cluster, and return the frame of the replies.

    A caller has no connection that shows whether it still waits. If the process was paused, the
    caller may have left meanwhile, so nothing is executed, and the pause is returned. A caller that
    still waits sends the frame again with that `pause`, which shows that the new frame was sent
    after the pause.
    """

    def may_have_left() -> bool:
        """Return whether the frame may have waited in a pause that its caller does not know."""
        return engine.pauses.latest() not in (0.0, pause)

    sender = Sender(
        engine,
        "handle",
        session_id,
        caller=NoKey.INSIDE,
        has_left=may_have_left,
        connected=False,
        can_move=True,
    )
    charge = free(NoKey.INSIDE)
    message, decoded = sender.message(charge), Decoded([], {})
    try:
        admission = message_admission(engine, charge, limits)  # the frame is in plasma
        decoded = await admission.decoded(partial(decode_requests, memoryview(frame)))
        message.decoded(decoded)
        replies = await sender.ask(message, decoded, admission)
        if replies and all(isinstance(reply.error, ConnectionLost) for reply in replies):
            engine.stats.record(message)
            return engine.pauses.latest()
    except VLAgentsError as error:
        message.refuse(error)
    data = answers.as_frame(message)
    engine.stats.record(message)
    return data


def _plain_host() -> str:
    """Return the address for unencrypted ports: loopback if Serve's own port is encrypted."""
    http = http_options()
    return os.environ.get(HOST) or (LOOPBACK if http.ssl_certfile else http.host or EVERYWHERE)


def _others_run() -> bool:
    """Return whether the application has a replica that accepts requests."""
    context = serve.get_replica_context()
    app = serve.status().applications.get(context.app_name)
    policy = None if app is None else app.deployments.get(context.deployment)
    return policy is not None and policy.replica_states.get("RUNNING", 0) > 0
