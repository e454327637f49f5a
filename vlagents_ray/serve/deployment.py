"""The Ray Serve deployment around an engine: one replica, one policy, one batch queue."""

from __future__ import annotations

import asyncio
import importlib.metadata
import logging
import os
from dataclasses import asdict
from typing import Any

import numpy as np
import ray
from ray import serve
from starlette.applications import Starlette

from vlagents_ray.errors import PolicyUnavailable, VLAgentsError
from vlagents_ray.registry import policy_class
from vlagents_ray.serve.batching import Rank
from vlagents_ray.serve.calls import ask
from vlagents_ray.serve.config import ServerArgs
from vlagents_ray.serve.engine import Engine
from vlagents_ray.serve.ingress import build_ingress
from vlagents_ray.serve.local import LocalDoor
from vlagents_ray.serve.plasma import PlasmaDoor
from vlagents_ray.wire.frames import decode_request, encode_reply
from vlagents_ray.wire.messages import PROTOCOL_VERSION, Reply

logger = logging.getLogger(__name__)


class PolicyReplica:
    """Loads the policy when it starts.

    While no replica of the application can act, its door answers 503 at once. A replica that joins
    others loads in its constructor, so that Serve routes to it only when it can act too.
    """

    async def __init__(self, args: dict[str, Any]) -> None:  # type: ignore[misc]  # Serve awaits it
        self._args = ServerArgs(**args)
        agent = policy_class(self._args.policy).from_config(self._args.config)
        self._limits = self._args.limits.limits()
        self._engine = Engine(
            agent,
            max_batch_size=self._args.batch.max_size,
            session_limit=self._args.sessions.limit,
            session_idle_s=self._args.sessions.idle_s,
        )
        self._local = LocalDoor(self._engine, self._limits) if hasattr(os, "memfd_create") else None
        self._plasma = PlasmaDoor(self._engine, self._limits) if self._local is not None else None
        for door in (self._local, self._plasma):
            if door is not None:
                door.open()
        self._loading = asyncio.ensure_future(asyncio.to_thread(self._engine.start))
        if await asyncio.to_thread(_others_run):
            await self._loading
        else:
            self._loading.add_done_callback(_log_failure)

    def __serve_build_asgi_app__(self) -> Starlette:
        return build_ingress(self._engine, self.metadata, self._limits)

    def metadata(self) -> dict[str, Any]:
        """What `GET /v1/metadata` and `RemoteAgent.metadata` say."""
        contract = self._engine.contract
        return {
            "policy": self._args.policy,
            "checkpoint": self._args.config.get("checkpoint"),
            "config": self._args.config,
            "contract": None if contract is None else contract.to_json(),
            "protocol": PROTOCOL_VERSION,
            "version": importlib.metadata.version("vlagents-ray"),
            "local": None if self._local is None else asdict(self._local.address),
        }

    async def attach(self) -> tuple[dict[str, Any], Any]:
        """For a client inside the cluster: the metadata, and this replica's actor, once it can act.

        A session must stay on one replica, which a Serve handle does not promise; the client calls
        the actor's own entry point for every request after this one.
        """
        await asyncio.shield(self._loading)
        plasma = None if self._plasma is None else asdict(self._plasma.plasma)
        return self.metadata() | {"plasma": plasma}, ray.get_runtime_context().current_actor

    async def lease(self, length: int) -> tuple[bytes, int]:
        """A plasma channel for frames of `length` bytes, for a client that `attach` told of the plasma door."""
        if self._plasma is None:
            raise PolicyUnavailable("plasma: this replica has no such door; use transport 'handle'")
        return await asyncio.to_thread(self._plasma.pool.lease, length)

    async def call(self, session_id: str, frame: np.ndarray) -> bytes:
        """One request from inside the cluster: a frame as (N,) uint8, read in place from plasma."""
        request_id = ""
        try:
            request = decode_request(frame.data, self._limits)
            request_id = request.request_id
            reply = await ask(self._engine, session_id, request, Rank.SIMULATION)
        except VLAgentsError as error:
            reply = Reply(request_id, error=error)
        return encode_reply(reply)

    def check_health(self) -> None:
        """Called by Serve; a replica whose policy did not load, or died, is replaced."""
        if self._loading.done():
            self._engine.require_ready()

    async def __del__(self) -> None:
        if hasattr(self, "_engine"):
            await asyncio.to_thread(self._engine.close)
            for door in (self._local, self._plasma):
                if door is not None:
                    door.close()


def _others_run() -> bool:
    """Does the application already have a replica that takes requests?"""
    app = serve.status().applications.get(serve.get_replica_context().app_name)
    return app is not None and any(d.replica_states.get("RUNNING", 0) > 0 for d in app.deployments.values())


def _log_failure(loading: asyncio.Future[None]) -> None:
    if not loading.cancelled() and (error := loading.exception()) is not None:
        logger.error("%s", error, exc_info=error)
