"""The part of a replica that accepts new weights.

It has the routes for learners on other machines, the methods for learners in the cluster, and the
methods that the replicas call on each other.

The part is enabled by default. `parts: {weights: null}` in a deployment file disables it: the
server then serves its checkpoints, and accepts no pushes.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import ray
from ray.util.metrics import Histogram
from starlette.routing import BaseRoute

from vlagents_ray.serve.replica.metrics import MS_BOUNDARIES, series
from vlagents_ray.serve.replica.part import PartContext, ReplicaPart, SiblingPart
from vlagents_ray.serve.weights import (
    HeldVersion,
    NewestVersion,
    PushOptions,
    Rest,
)
from vlagents_ray.weights.safetensors import ValueSpec
from vlagents_ray_learn.weight_push import (
    PushResult,
    ThisReplica,
    Values,
    WeightPusher,
    WeightsReplica,
)
from vlagents_ray_learn.weights_endpoint import PATH, weights_routes

logger = logging.getLogger(__name__)

# The interval at which the replica checks whether it has missed a version of the weights.
_CATCH_UP_S = 10.0
_ANSWER_S = 3.0  # time limit for an answer, since a replica that is loading does not answer
_TRANSFER_S = 600.0  # time limit for the answer to a call that contains weights
_SUMMARY = (
    "New weights from a learner, with a key of the scope `weights`; see "
    "`vlagents_ray_learn.Publisher`. The versions that act."
)  # description of the routes, for `GET /docs`


class WeightsPart(ReplicaPart):
    """Accepts new weights from learners for all replicas of the application.

    Learners call `push`, `rest_all` and `versions` of any replica. That replica coordinates the
    other replicas, and calls their `newest`, `stage`, `commit`, `drop`, `pushed_versions` and
    `rest`.
    """

    sibling_methods: ClassVar[Mapping[str, float | None]] = {
        # Methods for the replica that coordinates a push.
        "newest": _ANSWER_S,
        "stage": _TRANSFER_S,
        "commit": _ANSWER_S,
        "drop": _ANSWER_S,
        "pushed_versions": _TRANSFER_S,
        "rest": _TRANSFER_S,
        # Methods for learners in the cluster, which set the time limits of these calls.
        "push": None,
        "rest_all": None,
        "versions": None,
    }

    def __init__(self, settings: Any, context: PartContext) -> None:
        super().__init__(settings, context)
        self._updates = context.engine.weights
        self._this_replica = ThisReplica(context.replica, self._updates)
        self._pusher = WeightPusher(self._this_replica, self._other_replicas)
        self._push_ms = series(
            context.metric_tags,
            Histogram,
            "weight_push_ms",
            "Time until all replicas act with weights.",
            boundaries=MS_BOUNDARIES,
        )

    async def before_ready(self) -> None:
        """Get the versions of the other replicas, so that all replicas use the same versions."""
        await self._catch_up()

    async def run(self) -> None:
        """Get the versions of the other replicas whenever this replica has missed a version."""
        while True:
            await asyncio.sleep(_CATCH_UP_S)
            await self._catch_up()

    def routes(self) -> Sequence[BaseRoute]:
        """Return the routes for learners on other machines."""
        context = self.context
        return weights_routes(self, context.slow_s, open_to_network=context.open_to_network)

    def describe(self) -> Mapping[str, Any]:
        """Return the paths for learners, for `GET /docs` and for a `Publisher`."""
        return {"paths": [f"WS {PATH}", f"GET {PATH}"], "summary": _SUMMARY}

    # The following methods are for learners, which call any replica.

    async def push(self, values: Values, options: PushOptions) -> PushResult:
        """Make all replicas use new weights, or none of them."""
        begun = time.perf_counter()
        result = await self._pusher.push(values, options)
        self._push_ms.observe(1e3 * (time.perf_counter() - begun))
        return result

    async def push_received(self, values: Mapping[str, Any], options: PushOptions) -> PushResult:
        """Make all replicas use new weights that this replica has received over the network."""
        if not await self._other_replicas():
            return await self.push(values, options)
        # The values are copied on another thread, so that robots on this event loop do not wait.
        reference = await asyncio.to_thread(ray.put, values)
        return await self.push([reference], options)

    def read_header(self, header: bytes, options: PushOptions) -> dict[str, ValueSpec]:
        """Check the header of new weights before they are received.

        Returns:
            The types and shapes of the announced values, by name.

        Raises:
            InvalidWeights: The values do not fit the policy.
        """
        return self._updates.current().read_header(header, options)

    async def rest_all(self, rest: Rest) -> None:
        """Make all replicas sleep, restore their memory, or wake."""
        await self._pusher.rest(rest)

    async def versions(self) -> list[int]:
        """Return the newest version of each replica that can be reached."""
        replicas: list[WeightsReplica] = [self._this_replica, *await self._other_replicas()]
        calls = [replica.newest() for replica in replicas]
        answers = await asyncio.gather(*calls, return_exceptions=True)
        return [newest.number for newest in answers if isinstance(newest, NewestVersion)]

    # The following methods are for the replica that coordinates a push or a rest, or that catches
    # up; see `WeightUpdates`.

    def newest(self) -> NewestVersion:
        """Return the newest version of this replica."""
        return self._updates.newest()

    async def stage(self, number: int, values: Values, options: PushOptions) -> str:
        """Check and store a new version at this replica, and return its fingerprint."""
        return await self._this_replica.stage(number, values, options)

    def commit(self, number: int, options: PushOptions) -> None:
        """Use the staged version at this replica."""
        self._updates.commit(number, options)

    def drop(self, number: int) -> None:
        """Drop the staged version of this replica."""
        self._updates.drop(number)

    def pushed_versions(self) -> list[HeldVersion]:
        """Return the versions for a replica that has missed them."""
        return self._updates.pushed_versions()

    def rest(self, rest: Rest) -> None:
        """Make this replica sleep, restore its memory, or wake."""
        self._updates.rest(rest)

    async def _other_replicas(self) -> list[WeightsReplica]:
        return [_OtherReplica(sibling) for sibling in await self.siblings()]

    async def _catch_up(self) -> None:
        """Get missed versions. An error is logged, and the next check tries again."""
        try:
            await self._pusher.catch_up()
        except Exception:
            logger.exception(
                "the newest weights were not taken from the other replicas; tried again later"
            )


class _OtherReplica(WeightsReplica):
    """Another replica as the target of a push. It is reached through its `WeightsPart`."""

    def __init__(self, sibling: SiblingPart) -> None:
        self.name, self._sibling = sibling.name, sibling

    async def newest(self) -> NewestVersion:
        newest: NewestVersion = await self._sibling.call(WeightsPart.newest)
        return newest

    async def stage(self, number: int, values: Values, options: PushOptions) -> str:
        fingerprint: str = await self._sibling.call(WeightsPart.stage, number, values, options)
        return fingerprint

    async def commit(self, number: int, options: PushOptions) -> None:
        await self._sibling.call(WeightsPart.commit, number, options)

    async def drop(self, number: int) -> None:
        await self._sibling.call(WeightsPart.drop, number)

    async def pushed_versions(self) -> list[HeldVersion]:
        versions: list[HeldVersion] = await self._sibling.call(WeightsPart.pushed_versions)
        return versions

    async def rest(self, rest: Rest) -> None:
        await self._sibling.call(WeightsPart.rest, rest)
