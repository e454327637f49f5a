"""New weights for all replicas of an application: every replica holds a version before any replica
acts with it.

The replica that receives a push coordinates it. It stages the version at all replicas, and commits
it only if all of them hold it; otherwise it drops it, and nothing has changed. A replica that
starts later, or has missed a commit, gets the versions of the others (`WeightPusher.catch_up`). If
the coordinator dies before the commits, the replicas drop the staged version by themselves; if it
dies between two commits, the replicas without a commit catch up.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from vlagents_ray.errors import InvalidInput, InvalidWeights, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.scaling.session_migration import PeerEnded, PeerUnreachable
from vlagents_ray.serve.weights import (
    NewestVersion,
    PushMode,
    PushOptions,
    Rest,
    WeightUpdates,
)
from vlagents_ray.weights.shared_values import NotShared, SharedValues

T = TypeVar("T")

Values = Mapping[str, Any] | list[Awaitable[Mapping[str, Any]]] | SharedValues
"""Values by name; a list of one reference to them in Ray's object store, which each replica reads
in place; or handles of a learner's memory on the GPU of all replicas."""

logger = logging.getLogger(__name__)

# Maximum step from one version to the next if a learner numbers them, such as by its training step.
_MOST_AHEAD = 10**9
_ATTEMPTS = 3  # attempts to commit at a replica that cannot be reached


@dataclass(frozen=True, slots=True)
class PushResult:
    """The result of a successful push."""

    version: int
    fingerprint: str  # the same at all replicas
    replicas: tuple[str, ...]  # names of the replicas that act with the version


class WeightsReplica(Protocol):
    """A replica's interface for a push."""

    name: str  # for messages

    async def weights(self, method: Callable[..., T], *args: Any) -> T:
        """Call a method of the replica's `WeightUpdates`; also raise `PeerEnded` and
        `PeerUnreachable`.
        """


class ThisReplica(WeightsReplica):
    """The local replica as the target of a push."""

    def __init__(self, name: str, updates: WeightUpdates) -> None:
        self.name, self._updates = name, updates

    async def weights(self, method: Callable[..., T], *args: Any) -> T:
        """Call the method on another thread, since it may be slow."""
        values = []
        for argument in args:
            # A list holds one reference to values in Ray's object store.
            values.append(await argument[0] if isinstance(argument, list) else argument)
        return await asyncio.to_thread(method, self._updates, *values)


class WeightPusher:
    """Pushes new weights to all replicas, on the event loop of one of them."""

    def __init__(
        self,
        this_replica: WeightsReplica,
        siblings: Callable[[], Awaitable[Sequence[WeightsReplica]]],
    ) -> None:
        """Push to `this_replica` and to its `siblings`, which are looked up for each push."""
        self._this_replica, self._siblings = this_replica, siblings
        self._pushing = asyncio.Lock()
        self._known: set[str] = set()  # names of replicas that have answered

    async def push(self, values: Values, options: PushOptions) -> PushResult:
        """Make all replicas act with new weights, or none of them."""
        async with self._pushing:
            newest = {
                self._this_replica: await self._this_replica.weights(WeightUpdates.newest),
                **await self._loaded(await self._siblings()),
            }
            if len({version.model for version in newest.values()}) > 1:
                raise PolicyUnavailable(
                    "weights: the replicas are changing their checkpoint; push again in a while"
                )

            last = max(version.number for version in newest.values())
            number = last + 1 if options.version is None else options.version
            if number <= last:
                raise InvalidInput(
                    f"version: got {number}, want one above {last}, the newest that acts"
                )
            if number > last + _MOST_AHEAD:
                raise InvalidInput(
                    f"version: got {number}, want at most {_MOST_AHEAD} above {last}, the newest "
                    "that acts: versions never go back, so that a number beyond would end all "
                    "numbered pushes"
                )

            if isinstance(values, SharedValues):
                _require_gpu(values.gpu, newest)
            staged: dict[WeightsReplica, str] = {}  # fingerprints of the staged values

            async def stage(replica: WeightsReplica) -> None:
                staged[replica] = await replica.weights(
                    WeightUpdates.stage, number, values, options
                )

            try:
                results = await asyncio.gather(*map(stage, newest), return_exceptions=True)
                for replica, result in zip(newest, results, strict=True):
                    if isinstance(result, PeerUnreachable):
                        raise _unreachable(replica) from result
                    if isinstance(result, BaseException) and not isinstance(result, PeerEnded):
                        raise result
                fingerprints = set(staged.values())
                if len(fingerprints) > 1:
                    raise InvalidWeights(
                        "weights: the replicas hold different values, "
                        f"{sorted(fingerprints)}; push them again"
                    )
            except BaseException:
                # Where staging failed, another push may have staged a version of the same number.
                await asyncio.gather(
                    *(replica.weights(WeightUpdates.drop, number) for replica in staged),
                    return_exceptions=True,
                )
                raise

            committed = await asyncio.gather(
                *(self._commit(replica, number, options) for replica in staged)
            )

            acting = sorted(
                replica.name for replica, acts in zip(staged, committed, strict=True) if acts
            )
            return PushResult(number, staged[self._this_replica], tuple(acting))

    async def rest(self, rest: Rest) -> None:
        """Let all replicas take a step of a rest; if one cannot sleep, none does."""
        async with self._pushing:
            replicas = [self._this_replica, *await self._loaded(await self._siblings())]
            results = await asyncio.gather(
                *(replica.weights(WeightUpdates.rest, rest) for replica in replicas),
                return_exceptions=True,
            )
            answers = dict(zip(replicas, results, strict=True))
            failed = {
                replica: error
                for replica, error in answers.items()
                if error is not None and type(error) is not PeerEnded
            }
            if not failed:
                return

            if rest.step == "sleep":
                asleep = [replica for replica in replicas if answers[replica] is None]
                wakes = [replica.weights(WeightUpdates.rest, Rest("wake")) for replica in asleep]
                await asyncio.gather(*wakes, return_exceptions=True)

            replica, error = next(iter(failed.items()))
            if isinstance(error, PeerUnreachable):
                raise _unreachable(replica) from error
            raise error

    async def catch_up(self) -> None:
        """Get the newest versions of the other replicas if they are newer than this replica's.

        A replica calls this before it is ready, and regularly, since it may have missed a commit.
        """
        async with self._pushing:
            current = best = await self._this_replica.weights(WeightUpdates.newest)
            source = None
            for replica in await self._siblings():
                try:
                    newest = await replica.weights(WeightUpdates.newest)
                except (PeerEnded, PeerUnreachable, VLAgentsError):
                    continue  # the replica has no newer version
                if newest.number > best.number and newest.model == current.model:
                    best, source = newest, replica
            if source is None:
                return

            last = current.number
            for version in await source.weights(WeightUpdates.held):
                if version.number > current.number:
                    mode: PushMode = (
                        "keep" if last < version.kept <= version.number else "next_episode"
                    )
                    last = version.number
                    options = PushOptions(mode=mode, allow_same=True, pin=version.pinned)
                    await self._this_replica.weights(
                        WeightUpdates.stage, version.number, version.values, options
                    )
                    await self._this_replica.weights(WeightUpdates.commit, version.number, options)
            logger.info("took version %d of the weights from %s", best.number, source.name)

    async def _commit(self, replica: WeightsReplica, number: int, options: PushOptions) -> bool:
        """Commit at one replica, and return whether it acts with the version; otherwise it will
        catch up.
        """
        for _ in range(_ATTEMPTS):
            try:
                await replica.weights(WeightUpdates.commit, number, options)
            except PeerEnded:
                return False
            except PeerUnreachable as error:
                logger.warning(
                    "version %d of the weights: %s has not committed: %s",
                    number,
                    replica.name,
                    error,
                )
            else:
                return True
        return False

    async def _loaded(
        self, replicas: Sequence[WeightsReplica]
    ) -> dict[WeightsReplica, NewestVersion]:
        """Return the newest versions of the replicas that have loaded their policy; the others will
        catch up.

        A replica that does not answer may be loading. One that has answered before has loaded, so
        it counts as unreachable.
        """
        loaded: dict[WeightsReplica, NewestVersion] = {}
        answers = await asyncio.gather(
            *(replica.weights(WeightUpdates.newest) for replica in replicas), return_exceptions=True
        )
        for replica, answer in zip(replicas, answers, strict=True):
            if isinstance(answer, NewestVersion):
                loaded[replica] = answer
            elif isinstance(answer, PeerUnreachable) and replica.name in self._known:
                raise _unreachable(replica) from answer
            elif not isinstance(answer, PeerEnded | PeerUnreachable | PolicyUnavailable):
                raise answer

        self._known = {replica.name for replica in loaded}
        return loaded


def _require_gpu(gpu: str, replicas: Mapping[WeightsReplica, NewestVersion]) -> None:
    for replica, newest in replicas.items():
        if gpu not in newest.gpus:
            reads = (
                f"only memory of GPU {', '.join(newest.gpus)}" if newest.gpus else "no GPU's memory"
            )
            raise NotShared(
                f"replica {replica.name} can copy {reads}, and the learner's is on GPU {gpu}"
            )


def _unreachable(replica: WeightsReplica) -> PolicyUnavailable:
    return PolicyUnavailable(
        f"weights: replica {replica.name} cannot be reached, so that nothing was changed; push "
        "again"
    )
