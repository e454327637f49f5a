"""Pushes of new weights to all replicas.

Every replica stores a version before any replica uses it. The replica that receives a push
coordinates it. The coordinator stages the version at all replicas, and commits the version only if
all replicas have stored it. Otherwise, the coordinator drops the version, and nothing has changed.
A replica that starts later, or that has missed a commit, gets the versions from the other replicas
(`WeightPusher.catch_up`). If the coordinator dies before the first commit, the replicas drop the
staged version by themselves. If the coordinator dies between two commits, the replicas without a
commit catch up.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from vlagents_ray.errors import InvalidInput, InvalidWeights, PolicyUnavailable, VLAgentsError
from vlagents_ray.serve.scaling.session_migration import PeerEnded, PeerUnreachable
from vlagents_ray.serve.weights import (
    HeldVersion,
    NewestVersion,
    PushMode,
    PushOptions,
    Rest,
    WeightUpdates,
)
from vlagents_ray.weights.shared_values import NotShared, SharedValues

Values = Mapping[str, Any] | list[Awaitable[Mapping[str, Any]]] | SharedValues
"""The values of a push.

They are a mapping by name; or a list with one reference to such a mapping in Ray's object store,
which each replica reads in place; or handles of a learner's memory on the GPU of all replicas.
"""

logger = logging.getLogger(__name__)

# The largest difference between consecutive versions if a learner chooses the numbers, such as the
# steps of its training.
_MOST_AHEAD = 10**9
_ATTEMPTS = 3  # number of attempts to commit at a replica that cannot be reached


@dataclass(frozen=True, slots=True)
class PushResult:
    """The result of a successful push."""

    version: int
    fingerprint: str  # fingerprint, the same at all replicas
    replicas: tuple[str, ...]  # names of the replicas that use the version


class WeightsReplica(Protocol):
    """A replica as the target of a push: the methods of its `WeightUpdates`.

    Each method may also raise `PeerEnded` if the replica has ended, and `PeerUnreachable` if it
    does not answer.
    """

    name: str  # name of the replica, for messages

    async def newest(self) -> NewestVersion:
        """Return the newest version of the replica."""

    async def stage(self, number: int, values: Values, options: PushOptions) -> str:
        """Check and store a new version, and return its fingerprint."""

    async def commit(self, number: int, options: PushOptions) -> None:
        """Use the staged version."""

    async def drop(self, number: int) -> None:
        """Drop the staged version."""

    async def pushed_versions(self) -> list[HeldVersion]:
        """Return the versions for a replica that has missed them."""

    async def rest(self, rest: Rest) -> None:
        """Make the replica sleep, restore its memory, or wake."""


class ThisReplica(WeightsReplica):
    """The local replica as the target of a push.

    Calls run on other threads, since they may be slow.
    """

    def __init__(self, name: str, updates: WeightUpdates) -> None:
        self.name, self._updates = name, updates

    async def newest(self) -> NewestVersion:
        return await asyncio.to_thread(self._updates.newest)

    async def stage(self, number: int, values: Values, options: PushOptions) -> str:
        """Check and store a new version. Values in Ray's object store are fetched first."""
        if isinstance(values, list):
            [reference] = values
            values = await reference
        return await asyncio.to_thread(self._updates.stage, number, values, options)

    async def commit(self, number: int, options: PushOptions) -> None:
        await asyncio.to_thread(self._updates.commit, number, options)

    async def drop(self, number: int) -> None:
        await asyncio.to_thread(self._updates.drop, number)

    async def pushed_versions(self) -> list[HeldVersion]:
        return await asyncio.to_thread(self._updates.pushed_versions)

    async def rest(self, rest: Rest) -> None:
        await asyncio.to_thread(self._updates.rest, rest)


class WeightPusher:
    """Pushes new weights to all replicas, on the event loop of one of them."""

    def __init__(
        self,
        this_replica: WeightsReplica,
        siblings: Callable[[], Awaitable[Sequence[WeightsReplica]]],
    ) -> None:
        """Push to a replica and to its siblings.

        Args:
            this_replica: The replica in this process.
            siblings: A function that returns the other replicas. It is called for each push.
        """
        self._this_replica, self._siblings = this_replica, siblings
        self._pushing = asyncio.Lock()
        self._answered: set[str] = set()  # names of the replicas that answered the last call

    async def push(self, values: Values, options: PushOptions) -> PushResult:
        """Make all replicas use new weights, or none of them.

        Args:
            values: The new weights.
            options: The options of `Publisher.push`.

        Returns:
            The version, and the replicas that use it. Replicas that have ended meanwhile are not
            included, nor are replicas that did not commit and will catch up.

        Raises:
            InvalidInput: The number of the version is not above the newest number, or is far above
                it.
            InvalidWeights: The replicas hold different values.
            NotShared: The GPU of the values is not readable by a replica.
            PolicyUnavailable: A replica cannot be reached; nothing was changed.
            VLAgentsError: The errors of `ModelWeights.stage`.
        """
        async with self._pushing:
            newest = {
                self._this_replica: await self._this_replica.newest(),
                **await self._loaded(await self._siblings()),
            }
            number = _number_of_push(newest.values(), options)
            if isinstance(values, SharedValues):
                _require_gpu(values.gpu, newest)

            fingerprints = await self._stage(newest, number, values, options)

            commits = [self._commit(replica, number, options) for replica in fingerprints]
            committed = await asyncio.gather(*commits)
            acting = []
            for replica, acts in zip(fingerprints, committed, strict=True):
                if acts:
                    acting.append(replica.name)
            return PushResult(number, fingerprints[self._this_replica], tuple(sorted(acting)))

    async def _stage(
        self,
        replicas: Iterable[WeightsReplica],
        number: int,
        values: Values,
        options: PushOptions,
    ) -> dict[WeightsReplica, str]:
        """Stage a version at all replicas, or at none.

        Returns:
            The fingerprint of the values at each replica, without replicas that have ended.
        """
        fingerprints: dict[WeightsReplica, str] = {}

        async def stage(replica: WeightsReplica) -> None:
            fingerprints[replica] = await replica.stage(number, values, options)

        replicas = list(replicas)
        try:
            results = await asyncio.gather(*map(stage, replicas), return_exceptions=True)
            for replica, result in zip(replicas, results, strict=True):
                if isinstance(result, PeerUnreachable):
                    raise _unreachable(replica) from result
                if isinstance(result, BaseException) and not isinstance(result, PeerEnded):
                    raise result
            different = set(fingerprints.values())
            if len(different) > 1:
                raise InvalidWeights(
                    "weights: the replicas hold different values, "
                    f"{sorted(different)}; push them again"
                )
        except BaseException:
            # The version is dropped only where staging succeeded. Where it failed, another push may
            # have staged a version with the same number.
            drops = [replica.drop(number) for replica in fingerprints]
            await asyncio.gather(*drops, return_exceptions=True)
            raise
        return fingerprints

    async def rest(self, rest: Rest) -> None:
        """Make all replicas sleep, restore their memory, or wake.

        If one replica cannot sleep, none does.

        Raises:
            PolicyUnavailable: A replica cannot be reached.
            VLAgentsError: The errors of `WeightUpdates.rest`.
        """
        async with self._pushing:
            replicas = [self._this_replica, *await self._loaded(await self._siblings())]
            calls = [replica.rest(rest) for replica in replicas]
            results = await asyncio.gather(*calls, return_exceptions=True)

            succeeded = []
            failed: list[tuple[WeightsReplica, BaseException]] = []
            for replica, error in zip(replicas, results, strict=True):
                if error is None:
                    succeeded.append(replica)
                elif type(error) is not PeerEnded:
                    failed.append((replica, error))
            if not failed:
                return

            if rest.step == "sleep":
                wakes = [replica.rest(Rest("wake")) for replica in succeeded]
                await asyncio.gather(*wakes, return_exceptions=True)

            replica, error = failed[0]
            if isinstance(error, PeerUnreachable):
                raise _unreachable(replica) from error
            raise error

    async def catch_up(self) -> None:
        """Get the newest versions from the other replicas if they are newer than this replica's
        version.

        A replica calls this before it is ready, and regularly, since it may have missed a commit.
        """
        async with self._pushing:
            this_replica = self._this_replica
            current = best = await this_replica.newest()
            source = None
            for replica in await self._siblings():
                try:
                    newest = await replica.newest()
                except (PeerEnded, PeerUnreachable, VLAgentsError):
                    continue  # The other replica has no newer version.
                if newest.number > best.number and newest.model == current.model:
                    best, source = newest, replica
            if source is None:
                return

            last = current.number
            for version in await source.pushed_versions():
                if version.number <= current.number:
                    continue
                # Sessions change at once if a version since the last one was pushed with "keep".
                was_kept = last < version.kept <= version.number
                mode: PushMode = "keep" if was_kept else "next_episode"
                last = version.number
                options = PushOptions(mode=mode, allow_same=True, pin=version.pinned)
                await this_replica.stage(version.number, version.values, options)
                await this_replica.commit(version.number, options)
            logger.info("took version %d of the weights from %s", best.number, source.name)

    async def _commit(self, replica: WeightsReplica, number: int, options: PushOptions) -> bool:
        """Commit at one replica, and return whether the replica uses the version.

        A replica that does not use it will catch up.
        """
        for _ in range(_ATTEMPTS):
            try:
                await replica.commit(number, options)
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
        """Return the newest versions of the replicas that have loaded their policy.

        The other replicas will catch up. A replica that does not answer may be loading. A replica
        that has answered before has loaded its policy: if it does not answer, it is unreachable.
        """
        loaded: dict[WeightsReplica, NewestVersion] = {}
        calls = [replica.newest() for replica in replicas]
        answers = await asyncio.gather(*calls, return_exceptions=True)
        for replica, answer in zip(replicas, answers, strict=True):
            if isinstance(answer, NewestVersion):
                loaded[replica] = answer
            elif isinstance(answer, PeerUnreachable) and replica.name in self._answered:
                raise _unreachable(replica) from answer
            elif not isinstance(answer, PeerEnded | PeerUnreachable | PolicyUnavailable):
                raise answer

        self._answered = {replica.name for replica in loaded}
        return loaded


def _number_of_push(newest: Iterable[NewestVersion], options: PushOptions) -> int:
    """Return the number of the next version, from the newest version of each replica.

    Raises:
        PolicyUnavailable: The replicas have loaded different checkpoints.
        InvalidInput: The learner's number is not above the newest number, or is far above it.
    """
    versions = list(newest)
    if len({version.model for version in versions}) > 1:
        raise PolicyUnavailable(
            "weights: the replicas are changing their checkpoint; push again in a while"
        )

    last = max(version.number for version in versions)
    number = last + 1 if options.version is None else options.version
    if number <= last:
        raise InvalidInput(
            f"version: expected one above {last}, the newest that acts, got {number}"
        )
    if number > last + _MOST_AHEAD:
        raise InvalidInput(
            f"version: expected at most {_MOST_AHEAD} above {last}, the newest that acts, got "
            f"{number}; versions never go back, so that a number beyond would end all numbered "
            "pushes"
        )
    return number


def _require_gpu(gpu: str, replicas: Mapping[WeightsReplica, NewestVersion]) -> None:
    """Raise `NotShared` unless all replicas can read the memory of this GPU."""
    for replica, newest in replicas.items():
        if gpu in newest.gpus:
            continue
        readable = "no GPU's memory"
        if newest.gpus:
            readable = f"only memory of GPU {', '.join(newest.gpus)}"
        raise NotShared(
            f"replica {replica.name} can copy {readable}, but the learner's memory is on GPU {gpu}"
        )


def _unreachable(replica: WeightsReplica) -> PolicyUnavailable:
    return PolicyUnavailable(
        f"weights: replica {replica.name} cannot be reached, so that nothing was changed; push "
        "again"
    )
