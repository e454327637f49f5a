"""Replicas of Serve applications in this Ray cluster, called as actors."""

from __future__ import annotations

import asyncio
import logging
import random
import time
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from typing import Any, Concatenate, NamedTuple, ParamSpec, Protocol, TypeVar

import ray
from ray import serve

from vlagents_ray.client.transports.serve_handle import call_replica
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.ray_tools import private
from vlagents_ray.serve.config.deployment import POLICY
from vlagents_ray.serve.scaling.rebalancer import ClientLocation, Rebalancer, ReplicaLoad
from vlagents_ray.serve.scaling.session_migration import (
    HeldSessions,
    Peer,
    PeerEnded,
    PeerUnreachable,
)

P = ParamSpec("P")
T = TypeVar("T")

logger = logging.getLogger(__name__)

_NAMESPACE = "serve"
# Time limit for a replica to answer that it is initialized. A replica that is still loading does
# not answer, and has no session. After a replica was killed, every search waits for its replacement
# to answer.
_INITIALIZED_S = 0.3
_TRANSFER_S = 600.0  # time limit for the answer to a request that contains weights
_QUICK_S = 0.3  # time limit for an answer while a client waits to connect
_STARTING_S = 0.05  # interval at which a replica checks whether it is initialized
_SILENT_S = 3.0  # time for which the load of a silent replica is not requested again, s
# Number of replicas whose loads are requested together, in addition to the replicas near a client.
# The replicas of a large server would otherwise be busy with one another, since each replica
# compares its load every few seconds, and for each new client. The lowest load among this number of
# replicas is rarely far above the lowest load of all replicas.
_MOST_ASKED = 32


class SiblingApi(Protocol):
    """The actor methods that the replicas of an application call on each other.

    An error of this package is returned, and not raised: Serve would log it with a traceback,
    although it is often expected, such as the error of a replica that is still loading.
    """

    async def expect_client(self) -> tuple[dict[str, Any], Any]:
        """Expect a client that another replica redirects to this replica; return the metadata for
        the client, and the actor.
        """

    async def peer(self, method: str, *args: Any) -> Any:
        """Call the method with the given name in `PEER_METHODS`; return its result, or its
        `VLAgentsError`.
        """

    async def call_part(self, part: str, method: str, *args: Any) -> Any:
        """Call a method in the `ReplicaPart.sibling_methods` of a part; return its result, or its
        `VLAgentsError`.
        """


class PeerMethod(NamedTuple):
    """A method that replicas call on each other."""

    part: type  # object of the replica that has the method
    call: Callable[..., Any]
    limit_s: float | None  # time limit for the answer


PEER_METHODS = {
    method.call.__qualname__: method
    for method in (
        PeerMethod(HeldSessions, HeldSessions.versions_of, None),
        PeerMethod(HeldSessions, HeldSessions.copy, None),
        PeerMethod(HeldSessions, HeldSessions.weights, _TRANSFER_S),
        PeerMethod(HeldSessions, HeldSessions.release, None),
        PeerMethod(HeldSessions, HeldSessions.take_over, None),
        PeerMethod(HeldSessions, HeldSessions.drop_older, None),
        PeerMethod(Rebalancer, Rebalancer.load, _QUICK_S),
        PeerMethod(Rebalancer, Rebalancer.replica_joined, _QUICK_S),
    )
}
"""The methods that replicas call on each other with `SiblingApi.peer`, by their qualified names:
for moves of sessions, and for loads.
"""


class PeerStarting(PeerUnreachable):
    """Raised if the other replica is not initialized yet, but will be soon."""


class SiblingReplica(Peer):
    """A proxy of another replica, for moves of sessions and for parts of replicas."""

    def __init__(self, name: str, actor: Any, initialized: set[str]) -> None:
        """Create the proxy of an actor.

        Args:
            initialized: Names of the replicas that are known to be initialized; the name of this
                replica is added when it is initialized.
        """
        self.name, self._actor, self._initialized = name, actor, initialized

    async def ask(
        self,
        method: Callable[Concatenate[HeldSessions, P], Awaitable[T]],
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Call a method of `HeldSessions`; raise `PeerEnded` or `PeerUnreachable`."""
        try:
            result: T = await self.call(method, *args)
        except VLAgentsError as error:  # the server has another version of this package
            raise PeerUnreachable(str(error)) from error
        return result

    async def call(self, method: Callable[..., Any], *args: Any) -> Any:
        """Call one of `PEER_METHODS`; raise `PeerEnded`, `PeerUnreachable` or the method's own
        errors.
        """
        name = method.__qualname__
        return await self._ask_actor(PEER_METHODS[name].limit_s, SiblingApi.peer, name, *args)

    async def call_part(self, part: str, method: str, *args: Any, limit_s: float | None) -> Any:
        """Call a method of a part of the other replica, within a time limit; raises the same errors
        as `call`.
        """
        return await self._ask_actor(limit_s, SiblingApi.call_part, part, method, *args)

    async def _ask_actor(
        self, limit_s: float | None, method: Callable[..., Any], *args: Any
    ) -> Any:
        try:
            if self.name not in self._initialized:
                # A request to a replica that is not initialized makes Serve log a traceback.
                if not await asyncio.wait_for(
                    private.replica_is_initialized(self._actor), _INITIALIZED_S
                ):
                    raise PeerStarting("the replica is not initialized yet")
                self._initialized.add(self.name)
            answer = await asyncio.wait_for(call_replica(self._actor, method, *args), limit_s)
        except ray.exceptions.ActorDiedError as error:
            raise PeerEnded(str(error)) from error
        except (ray.exceptions.RayError, TimeoutError, asyncio.TimeoutError) as error:
            # The replica hangs or has another version, or the network is partitioned.
            raise PeerUnreachable(str(error) or f"no answer within {limit_s} s") from error
        if isinstance(answer, VLAgentsError):
            raise answer
        return answer


class ReplicasInCluster:
    """The replicas of applications; each call looks them up again, since they may change."""

    def __init__(self, apps: Collection[str], but: str = "") -> None:
        """Call the replicas of `apps`, except the replica whose full name is `but`."""
        self._apps, self._but = apps, but
        self._initialized: set[str] = set()

    async def others(self) -> list[SiblingReplica]:
        """Return proxies of the replicas."""
        actors = dict(await asyncio.to_thread(lambda: list(self._actors())))
        self._initialized &= actors.keys()  # without replicas that have ended
        return [SiblingReplica(name, actor, self._initialized) for name, actor in actors.items()]

    def _actors(self) -> Iterator[tuple[str, Any]]:
        """Yield the name and the actor of each replica."""
        prefixes = tuple(f"SERVE_REPLICA::{app}#{POLICY}#" for app in self._apps)
        for entry in ray.util.list_named_actors(all_namespaces=True):
            name = entry["name"]
            if entry["namespace"] == _NAMESPACE and name.startswith(prefixes) and name != self._but:
                try:
                    yield name, ray.get_actor(name, namespace=_NAMESPACE)
                except ValueError:  # the replica has ended
                    continue


class SiblingReplicas(ReplicasInCluster):
    """The other replicas of this replica's application."""

    def __init__(self) -> None:
        context = serve.get_replica_context()
        self.own_name = context.replica_id.to_full_id_str()
        super().__init__([context.app_name], but=self.own_name)
        # Time until which a silent replica gets no request, s, by the replica's name.
        self._silent: dict[str, float] = {}
        # Actors by the replica's name; a replica always has the same actor.
        self._last_loads: dict[str, ReplicaLoad] = {}

    async def loads(self) -> list[ReplicaLoad]:
        """Return the loads of the replicas that answer within 0.3 s."""
        return await self._loads_of(await self._audible())

    async def some_loads(self, near: Collection[ClientLocation] = ()) -> list[ReplicaLoad]:
        """Return the loads of replicas that answer within 0.3 s: the replicas near these locations,
        and 32 other replicas.
        """
        audible = await self._audible()
        self._last_loads = {
            replica.name: self._last_loads[replica.name]
            for replica in audible
            if replica.name in self._last_loads
        }
        if len(audible) <= _MOST_ASKED:
            return await self._loads_of(audible)

        asked, others = [], []
        for replica in audible:
            last = self._last_loads.get(replica.name)
            # A replica whose location is unknown may be near.
            if last is None or any(location.is_near(last) for location in near):
                asked.append(replica)
            else:
                others.append(replica)
        asked += random.sample(others, min(_MOST_ASKED, len(others)))
        return await self._loads_of(asked)

    async def _audible(self) -> list[SiblingReplica]:
        """Return the other replicas, except replicas that did not answer a moment ago."""
        now = time.monotonic()
        self._silent = {name: until for name, until in self._silent.items() if until > now}
        return [replica for replica in await self.others() if replica.name not in self._silent]

    async def _loads_of(self, asked: Sequence[SiblingReplica]) -> list[ReplicaLoad]:
        now = time.monotonic()
        answers = await asyncio.gather(
            *(replica.call(Rebalancer.load) for replica in asked), return_exceptions=True
        )
        for replica, answer in zip(asked, answers, strict=True):
            if isinstance(answer, ReplicaLoad):
                self._last_loads[replica.name] = answer
            elif not isinstance(answer, PeerStarting):
                logger.info("another replica does not answer: %s", answer)
                self._silent[replica.name] = now + _SILENT_S
        return [answer for answer in answers if isinstance(answer, ReplicaLoad)]

    async def announce_this_replica(self) -> None:
        """Make 32 other replicas compare their sessions with this replica, which has just joined
        them. The number is limited so that the replicas of a large server are not busy with one
        another. All other replicas notice the new replica within a few seconds.
        """
        this_actor = ray.get_runtime_context().current_actor
        while not await private.replica_is_initialized(this_actor):
            await asyncio.sleep(_STARTING_S)

        others = await self.others()
        asked = random.sample(others, min(_MOST_ASKED, len(others)))
        calls = (replica.call(Rebalancer.replica_joined, self.own_name) for replica in asked)
        await asyncio.gather(*calls, return_exceptions=True)

    def forget_silence(self, replica: str) -> None:
        """Request the load of a replica again, although the replica did not answer a moment ago."""
        self._silent.pop(replica, None)

    async def announce_client(self, replica: str) -> Any:
        """Announce a client to another replica; return its answer for the client, None if the
        replica does not answer within 0.3 s.
        """
        try:
            actor = await asyncio.to_thread(ray.get_actor, replica, namespace=_NAMESPACE)
            return await asyncio.wait_for(call_replica(actor, SiblingApi.expect_client), _QUICK_S)
        except (ValueError, ray.exceptions.RayError, TimeoutError, asyncio.TimeoutError) as error:
            logger.info("another replica does not answer: %s", error)  # the replica may have ended
            return None
