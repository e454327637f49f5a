"""The methods of a replica for new weights, which learners and other replicas call."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Mapping
from typing import Any

import ray

from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.scaling.sibling_replicas import SiblingReplicas
from vlagents_ray.serve.scaling.weight_push import OwnWeights, Values, WeightPusher, WeightsReplica
from vlagents_ray.serve.weights.updates import HeldVersion, NewestVersion, PushOptions, PushResult
from vlagents_ray.weights.safetensors import ValueSpec

logger = logging.getLogger(__name__)

_CATCH_UP_S = 10.0  # interval of the questions whether this replica has missed a version


class ReplicaWeights:
    """A part of `PolicyReplica`: its weights, and pushes that it coordinates."""

    def _open_weights(self, engine: Engine, peers: SiblingReplicas) -> None:
        self._weights_here = engine.weights
        self._own_weights = OwnWeights(peers.own_name, engine.weights)
        self._weights_of_others = peers.other_weights
        self._pusher = WeightPusher(self._own_weights, peers.other_weights)

    async def _follow_others(self) -> None:
        """Take the others' versions before this replica is ready, and later whenever it has missed one."""
        await self._catch_up()
        self._catching_up = asyncio.ensure_future(self._keep_catching_up())

    async def _keep_catching_up(self) -> None:
        while True:
            await asyncio.sleep(_CATCH_UP_S)
            await self._catch_up()

    async def _catch_up(self) -> None:
        try:
            await self._pusher.catch_up()
        except Exception:
            logger.exception("the newest weights were not taken from the other replicas; tried again later")

    async def push_weights(self, values: Values, options: PushOptions) -> PushResult:
        """Let all replicas act with new weights; called by a learner."""
        return await self._pusher.push(values, options)

    async def push_received(self, named: Mapping[str, Any], options: PushOptions) -> PushResult:
        """Let all replicas act with new weights, which this one has received over the network."""
        if not await self._weights_of_others():
            return await self._pusher.push(named, options)
        reference = await asyncio.to_thread(ray.put, named)  # a copy, for which no robot on this event loop waits
        return await self._pusher.push([reference], options)

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Check weights that are to be received."""
        return self._weights_here.read_header(header, options)

    async def versions_of_weights(self) -> list[int]:
        """Return the newest version of each replica that can be reached; called by a learner."""
        replicas: list[WeightsReplica] = [self._own_weights, *await self._weights_of_others()]
        found = await asyncio.gather(*(replica.newest_weights() for replica in replicas), return_exceptions=True)
        return [newest.number for newest in found if isinstance(newest, NewestVersion)]

    async def newest_weights(self) -> NewestVersion:
        """Return the newest version that acts here."""
        return await self._own_weights.newest_weights()

    async def stage_weights(self, number: int, values: Values, options: PushOptions) -> str:
        """Check and hold a version."""
        return await self._own_weights.stage_weights(number, values, options)

    async def commit_weights(self, number: int, options: PushOptions) -> None:
        """Act with the staged version."""
        await self._own_weights.commit_weights(number, options)

    async def drop_weights(self, number: int) -> None:
        """Drop the staged version."""
        await self._own_weights.drop_weights(number)

    async def held_weights(self) -> list[HeldVersion]:
        """Return the pushed versions that new episodes act with."""
        return await self._own_weights.held_weights()
