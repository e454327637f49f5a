"""The Ray Serve deployment around an engine: one replica, one policy, one batch queue."""

from __future__ import annotations

import asyncio
import importlib.metadata
import logging
import os
from collections import Counter
from dataclasses import asdict
from functools import partial
from typing import Any

import ray
from ray import serve
from ray.serve.config import HTTPOptions
from starlette.types import ASGIApp

from vlagents_ray.code import code_of
from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.registry import names
from vlagents_ray.serve.auth import Caller, require_access
from vlagents_ray.serve.autoscaling import SESSIONS, UTILISATION, WAITING
from vlagents_ray.serve.balance import Balance
from vlagents_ray.serve.calls import Sender
from vlagents_ray.serve.checkpoints import resolved
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.dialects.door import House
from vlagents_ray.serve.dialects.routes import describe, dialect_routes, require_fit
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.environments.agent import make_agent, version_of
from vlagents_ray.serve.guard import Guard
from vlagents_ray.serve.ingress import build_ingress
from vlagents_ray.serve.local import LocalDoor
from vlagents_ray.serve.metrics import Exporter
from vlagents_ray.serve.moving import Strays, export
from vlagents_ray.serve.peers import Peers
from vlagents_ray.serve.plasma import PlasmaDoor
from vlagents_ray.serve.ports import EVERYWHERE, HOST, LOOPBACK
from vlagents_ray.serve.spread import Load, Place
from vlagents_ray.serve.stats import LoadMeter, Visit
from vlagents_ray.serve.stream import StreamDoor
from vlagents_ray.wire.frames import decode_requests
from vlagents_ray.wire.messages import PROTOCOL_VERSION, SERVERS_MACHINE, Reply, boot_id

logger = logging.getLogger(__name__)

_WATCH_S = 0.25


class PolicyReplica:
    """Loads the policy when it starts.

    While no replica of the application can act, its door answers 503 at once, unless `answer_while_loading`
    is off. A replica that joins others loads in its first `reconfigure`, so that Serve routes to it only when
    it can act too.
    """

    async def __init__(self, args: dict[str, Any], gateway: Any = None) -> None:  # type: ignore[misc]
        """Serve awaits it. `gateway` is a handle that nobody uses: it makes the gateway a part of the application."""
        self._args = ServerArgs(**args)
        self._app = serve.get_replica_context().app_name
        self._code = code_of(names("policies").get(self._args.policy, self._args.policy))
        self._keys = self._args.access.keys()
        require_access(_http().host or EVERYWHERE, self._keys, self._args.access.insecure)
        self._limits = self._args.limits.limits()
        self._engine = Engine(
            self._args.checkpoints.of(partial(make_agent, self._args), self._args.config),
            max_batch_size=self._args.batch.max_size,
            patience=self._args.batch.patience,
            batch_sizes=self._args.batch.sizes or (),
            session_limit=self._args.sessions.limit,
            session_idle_s=self._args.sessions.idle_s,
            version=version_of(self._args),
            check=partial(require_fit, self._args.dialects),
        )
        self._meter = LoadMeter(self._engine.queue)
        self._metrics = Exporter(self._engine, _tags(self._args.policy))
        self._metrics.start()
        self._peers = Peers()
        self._strays = self._engine.strays = Strays(self._engine, self._peers)
        self._balance = Balance(self._engine, self._peers, self._load_of)
        self._local = None
        if hasattr(os, "memfd_create"):
            self._local = LocalDoor(self._engine, self._limits, self._admit if self._keys else None)
        self._plasma = PlasmaDoor(self._engine, self._limits) if self._local is not None else None
        self._stream = self._stream_door()
        for door in (self._local, self._plasma, self._stream):
            if door is not None:
                door.open()
        self._loading: asyncio.Future[None] = asyncio.get_running_loop().create_future()  # until `reconfigure`
        self._configured = False

    async def reconfigure(self, settings: dict[str, Any] | None, rank: Any) -> None:
        """Called by Serve with the file's `user_config`: before the replica is ready, and when that changes.

        What it raises the first time keeps the replica from starting. Later ones return at once, and raise nothing,
        as that would end the replica: what came of the swap is in the metadata and the log. `rank` is not used;
        who asks for it is called without a `user_config`, too.
        """
        config = {**self._args.config, **(settings or {})}
        if self._configured:
            logger.info("new settings, to be loaded beside the present ones: %s", config)
        self._engine.models.configure(config)
        if not self._configured:
            self._configured = True
            await self._start()

    async def _start(self) -> None:
        self._loading = asyncio.ensure_future(asyncio.to_thread(self._engine.start))
        if not self._args.answer_while_loading or await asyncio.to_thread(_others_run):
            await self._loading
        else:
            self._loading.add_done_callback(_log_failure)
        self._balance.start()
        self._watching = asyncio.ensure_future(self._watch_for_the_end())

    def __serve_build_asgi_app__(self) -> ASGIApp:
        dialects = dialect_routes(self._args.dialects, House(self._engine, self.metadata, self._limits))
        inside = build_ingress(self._engine, self.metadata, self._limits, self._near, dialects)
        slow_s, idle_s = self._args.limits.slow_s, self._args.sessions.idle_s
        return Guard(inside, self._keys, self._app, slow_s=slow_s, idle_s=idle_s)

    def _admit(self, token: str | None) -> Caller | None:
        return None if self._keys is None else self._keys.check(token, self._app)

    async def refusal(self) -> str | None:
        """Why the policy cannot act yet; None when it can. For whoever started the server, who is told all of it."""
        try:
            self._engine.check_health()
        except Exception as error:  # noqa: BLE001 - whatever a policy says is wrong with it
            return str(error)
        return None

    def metadata(self) -> dict[str, Any]:
        """What `GET /v1/metadata` and `RemoteAgent.metadata` say."""
        contract, models = self._engine.contract, self._engine.models
        return {
            "policy": self._args.policy,
            "checkpoint": resolved(models.config),
            "checkpoints": models.describe(),
            "config": models.config,
            "contract": None if contract is None else contract.to_json(),
            "protocol": PROTOCOL_VERSION,
            "version": importlib.metadata.version("vlagents-ray"),
            "code": None if self._code is None else self._code.to_json(),
            "dialects": describe(self._args.dialects),
            "local": None if self._local is None else asdict(self._local.address),
            "stream": None if self._stream is None else asdict(self._stream.address),
        }

    def _stream_door(self) -> StreamDoor | None:
        stream = self._args.stream
        if not stream.enabled:
            return None
        admit = self._admit if self._keys else None
        http = _http()  # if that is encrypted, nothing else shall be to see
        host = os.environ.get(HOST) or (LOOPBACK if http.ssl_certfile else http.host or EVERYWHERE)
        return StreamDoor(self._engine, self._limits, host, stream.ports, admit)

    async def attach(self, node: str = "", boot_id: str = "", must_be_near: bool = False) -> tuple[dict[str, Any], Any]:
        """For a client inside the cluster, on that node and machine: a replica's metadata, and its actor.

        The replica is the least loaded one, if it can be near to the client. A session must stay there,
        which a Serve handle does not promise; the client calls the actor's own entry point for every
        request after this one.
        """
        await asyncio.shield(self._loading)
        place = Place(node, boot_id, must_be_near)
        return await self._elsewhere(place) or self._introduction()

    async def welcome(self) -> tuple[dict[str, Any], Any]:
        """For another replica, which sends a client here: what to tell it."""
        self._balance.expect()
        return self._introduction()

    def _introduction(self) -> tuple[dict[str, Any], Any]:
        plasma = None if self._plasma is None else asdict(self._plasma.plasma)
        return self.metadata() | {"plasma": plasma}, ray.get_runtime_context().current_actor

    async def load(self) -> Load:
        """For other replicas, which compare it with theirs."""
        return self._balance.load()

    async def nodes(self) -> dict[str, int]:
        """Where a client does best to run: how many replicas that take sessions there are on which node."""
        loads = [self._balance.load(), *await asyncio.to_thread(self._peers.loads)]
        return dict(Counter(load.node for load in loads if load.accepts))

    async def _near(self, caller: str) -> dict[str, Any]:
        """The metadata of the least loaded replica on the machine with that boot id; there may be none: this one's."""
        place = Place(boot_id=boot_id() if caller == SERVERS_MACHINE else caller, must_be_near=True)
        metadata, _ = await self._elsewhere(place) or (self.metadata(), None)
        return {key: value for key, value in metadata.items() if key != "plasma"}

    async def _elsewhere(self, place: Place) -> tuple[dict[str, Any], Any] | None:
        """What another replica tells a client from `place`, if it suits the client better than this one."""
        invitation = await asyncio.wrap_future(self._balance.place(place))
        if invitation is None:
            return None
        found: tuple[dict[str, Any], Any] | None = await asyncio.to_thread(self._peers.answer, invitation)
        return found

    def _load_of(self, sessions: int) -> Load:
        accepts = self._loading.done() and self._engine.ready and not (self._engine.draining or _stopping())
        node = ray.get_runtime_context().get_node_id()
        return Load(self._peers.me, sessions, accepts, node, boot_id(), self._engine.version)

    async def lease(self, length: int) -> tuple[bytes, int]:
        """A plasma channel for frames of `length` bytes, for a client that `attach` told of the plasma door."""
        if self._plasma is None:
            raise PolicyUnavailable("plasma: this replica has no such door; use transport 'handle'")
        return await asyncio.to_thread(self._plasma.pool.lease, length)

    async def call(self, session_id: str, frame: Any) -> bytes:
        """A frame of requests from inside the cluster, a buffer, read in place from plasma."""
        visit = Visit(self._engine.stats, "handle")
        sender = Sender(self._engine, "handle", session_id, connected=False)
        try:
            requests = decode_requests(memoryview(frame), self._limits)
            visit.decoded(requests)
            replies = await sender.ask(requests)
        except VLAgentsError as error:
            replies = [Reply(error=error)]
        return visit.frame(replies)

    async def export_session(self, session_id: str) -> dict[str, Any] | None:
        """For another replica, which got a request of this session."""
        return await asyncio.to_thread(export, self._engine, session_id)

    async def import_session(self, session_id: str, state: dict[str, Any]) -> bool:
        """From another replica, which stops."""
        if self._engine.draining:
            return False
        try:
            await asyncio.to_thread(self._engine.adopt, session_id, state)
        except VLAgentsError as error:
            logger.info("session %s: not taken over: %s", session_id, error)
            return False
        return True

    def check_health(self) -> None:
        """Called by Serve; a replica whose policy did not load, or died, is replaced."""
        if self._loading.done():
            self._engine.check_health()

    def record_autoscaling_stats(self) -> dict[str, float]:
        """Called by Serve at regular times: the load since the last time, for `MeasuredLoad`."""
        load = self._meter.read()
        return {
            UTILISATION: load.utilisation,
            WAITING: load.waiting / self._args.batch.max_size,
            SESSIONS: float(len(self._engine.sessions)),
        }

    async def _watch_for_the_end(self) -> None:
        """Tell clients to go elsewhere, if there is an elsewhere, as soon as Serve wants this replica to stop."""
        while not _stopping():
            await asyncio.sleep(_WATCH_S)
        self._engine.draining = await asyncio.to_thread(_others_run)

    async def __del__(self) -> None:
        if not hasattr(self, "_engine"):
            return
        if hasattr(self, "_watching"):
            self._watching.cancel()
        if self._engine.draining:
            await asyncio.to_thread(self._strays.hand_over)
        self._balance.close()
        self._strays.close()
        await asyncio.to_thread(self._engine.close)
        await asyncio.to_thread(self._metrics.close)
        for door in (self._local, self._plasma, self._stream):
            if door is not None:
                door.close()


def _http() -> HTTPOptions:
    """Where Serve lets clients in, and its replicas listen."""
    from ray.serve.context import _get_global_client

    return _get_global_client().http_config


def _stopping() -> bool:
    """Has Serve begun to stop this replica? It tells the load balancer, but has no hook for the user's class."""
    worker = ray._private.worker.global_worker
    actor = worker.actors.get(worker.actor_id)
    return bool(actor._replica_impl._shutting_down)


def _others_run() -> bool:
    """Does the application already have a replica that takes requests?"""
    context = serve.get_replica_context()
    app = serve.status().applications.get(context.app_name)
    policy = None if app is None else app.deployments.get(context.deployment)
    return policy is not None and policy.replica_states.get("RUNNING", 0) > 0


def _tags(policy: str) -> dict[str, str]:
    """What Serve's own metrics are tagged with, and the policy."""
    context = serve.get_replica_context()
    return {
        "application": context.app_name,
        "deployment": context.deployment,
        "replica": context.replica_tag,
        "policy": policy,
    }


def _log_failure(loading: asyncio.Future[None]) -> None:
    if not loading.cancelled() and (error := loading.exception()) is not None:
        logger.error("%s", error, exc_info=error)
