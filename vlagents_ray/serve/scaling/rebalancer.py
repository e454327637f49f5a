"""Balances sessions over the replicas: new sessions go to the replica with the fewest sessions, and
surplus sessions are moved.

A connection stays at its replica until it ends, and so does a client that sends HTTP requests to a
replica's own port. A new replica alone would therefore not relieve the other replicas. Therefore
each replica compares its number of sessions with the other replicas every few seconds. If its
number is clearly above its share, it requests some clients to reconnect. Their sessions then move
in the same way as when a replica stops (`vlagents_ray.serve.scaling.session_migration`).

Clients that read JSON at the server's port, and clients of dialects, cannot be requested to
reconnect. The load balancer's hash of their session's name selects their replica, again after each
change of the replicas. A WebSocket of a dialect stays at its replica until it ends.
"""

from __future__ import annotations

import asyncio
import logging
import random
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Protocol

from vlagents_ray.serve.engine.engine import Engine

# Tolerated excess over the mean, as a share of the mean; at least one session is tolerated.
_SLACK = 0.25
logger = logging.getLogger(__name__)
PERIOD_S = 3.0  # interval of the comparisons
_EXPECTED_S = 3.0  # time after which a client that was sent here is no longer expected
_SETTLE_S = 6.0  # time for which a connection counts as leaving after a request to reconnect
_RECONNECT_S = 20.0  # shortest time between two requests to reconnect on one connection
# Time after its last request for which a session counts as active, s; only replies can request a
# reconnection.
_ACTIVE_S = 30.0
_AT_ONCE = 32  # largest number of sessions to send away after one comparison


@dataclass(slots=True)
class ReplicaLoad:
    """The load of one replica, as reported by that replica."""

    replica: str  # name of the replica's actor
    sessions: int  # its sessions, and the expected sessions of clients that were just sent to it
    accepts: bool  # whether its policy is loaded, and the replica is not stopping
    node: str  # Ray's id of the replica's node
    boot_id: str  # boot id of the replica's machine
    # Version of the policy and its shared objects; sessions move only between equal versions.
    version: tuple[str, str]


@dataclass(frozen=True, slots=True)
class ClientLocation:
    """The location of a client, as far as the client reports its location. Replicas near the client
    are preferred.
    """

    node: str = ""  # Ray's id of the client's node; empty outside the cluster
    boot_id: str = ""  # boot id of the client's machine; empty if it is unknown
    must_be_near: bool = False  # whether the client's transport reaches only the client's machine

    def is_near(self, load: ReplicaLoad) -> bool:
        """Return whether a replica runs on the client's node, or on the client's machine."""
        return (self.node != "" and self.node == load.node) or (
            self.boot_id != "" and self.boot_id == load.boot_id
        )


def choose_replica(loads: Sequence[ReplicaLoad], location: ClientLocation) -> ReplicaLoad | None:
    """Return the replica with the fewest sessions near the client. If another replica has clearly
    fewer sessions, return the replica with the fewest sessions of all.

    Among equally loaded replicas, the first is chosen. The result is None if no replica accepts
    sessions, or if the client needs a near replica and there is none.
    """
    accepting = [load for load in loads if load.accepts]
    least_loaded = min(accepting, key=attrgetter("sessions"), default=None)
    near = min(
        (load for load in accepting if location.is_near(load)),
        key=attrgetter("sessions"),
        default=None,
    )
    if location.must_be_near or least_loaded is None:
        return near
    if near is not None and near.sessions <= _tolerated(least_loaded.sessions):
        return near
    return least_loaded


def excess_sessions(mine: int, siblings: Iterable[int], leaving: int = 0) -> int:
    """Return the number of sessions that a replica should send away, without the `leaving`
    sessions. The result is the excess over the mean, rounded down; 0 if that is at most 25 % of the
    mean or one session.

    Args:
        mine: Number of sessions of the replica.
        siblings: Numbers of sessions of the other replicas.
        leaving: Number of the replica's sessions that are about to move away.
    """
    loads = [mine, *siblings]
    mean = sum(loads) / len(loads)
    if mine - leaving <= _tolerated(mean):
        return 0
    return mine - leaving - -(-sum(loads) // len(loads))


def choose_connections(connections: Counter[str], count: int) -> set[str]:
    """Choose the connections to send away, from the number of sessions of each connection. At most
    `count` sessions leave. All sessions of a connection move together, so a connection with more
    sessions stays.
    """
    chosen = set()
    for connection, sessions in connections.most_common():
        if sessions <= count:
            chosen.add(connection)
            count -= sessions
    return chosen


def _tolerated(sessions: float) -> float:
    return sessions + max(1.0, _SLACK * sessions)


class Siblings(Protocol):
    """The other replicas of the application:
    `vlagents_ray.serve.scaling.sibling_replicas.SiblingReplicas`.
    """

    async def some_loads(self, near: Collection[ClientLocation] = ()) -> list[ReplicaLoad]:
        """Return the loads of replicas that answer quickly: the replicas near these locations, and
        some other replicas.
        """

    async def announce_client(self, replica: str) -> Any:
        """Announce a client to another replica. Return the replica's answer for the client; None if
        it does not answer quickly.
        """

    def forget_silence(self, replica: str) -> None:
        """Request the load of a replica again, although the replica did not answer a moment ago."""


class Rebalancer:
    """Compares the number of sessions of one replica with the other replicas, and chooses replicas
    for new clients. It runs on one event loop.
    """

    def __init__(
        self, engine: Engine, siblings: Siblings, own_load: Callable[[int], ReplicaLoad]
    ) -> None:
        """Balance the sessions of `engine` and `siblings`.

        Args:
            engine: The engine of this replica.
            siblings: The other replicas.
            own_load: Returns the load of this replica with the given number of sessions.
        """
        self._engine, self._siblings, self._own_load = engine, siblings, own_load
        # Times at which clients without a session so far were sent here.
        self._expected: deque[float] = deque()
        self._opened = 0
        self._sibling_loads: list[ReplicaLoad] = []
        self._asked_at = float("-inf")  # time of the last request for the loads of other replicas
        # Locations of the clients for which these loads were requested.
        self._asked_near: set[ClientLocation] = set()
        # Locations of clients that arrived after that request.
        self._wanted_near: set[ClientLocation] = set()
        self._uneven = False  # whether the last comparison found too many sessions here
        # Names of the replicas in the comparisons so far; None before the first comparison.
        self._compared: set[str] | None = None
        self._placing = asyncio.Lock()  # held while a replica for a client is chosen
        self._joined = asyncio.Event()  # whether a replica has joined since the last comparison

    async def run(self) -> None:
        """Compare the numbers of sessions periodically, and when a replica joins, until
        cancelled.
        """
        while True:
            with suppress(asyncio.TimeoutError):
                await asyncio.wait_for(self._joined.wait(), random.uniform(0.8, 1.2) * PERIOD_S)
            self._joined.clear()
            try:
                await self.compare()
            except Exception:
                logger.exception("sessions were not compared")

    def load(self) -> ReplicaLoad:
        """Return the current load of this replica, including the clients that were sent here."""
        opened = self._engine.sessions.opened
        arrived, self._opened = opened - self._opened, opened
        oldest = time.monotonic() - _EXPECTED_S
        while self._expected and (arrived > 0 or self._expected[0] < oldest):
            self._expected.popleft()
            arrived -= 1
        return self._own_load(len(self._engine.sessions) + len(self._expected))

    def replica_joined(self, replica: str) -> None:
        """Compare the sessions now, since another replica has joined."""
        self._siblings.forget_silence(replica)
        self._joined.set()

    def expect_client(self) -> None:
        """Record that a client was sent here."""
        self.load()
        self._expected.append(time.monotonic())

    async def redirect(self, *locations: ClientLocation) -> Any:
        """Choose the replica for a new client, and announce the client there.

        Args:
            *locations: Locations of the client in order of preference; the first location for which
                a replica is suitable is used.

        Returns:
            The result of `Siblings.announce_client`; None if the client stays here.
        """
        arrived = time.monotonic()
        self._wanted_near |= set(locations)
        async with self._placing:
            # Clients that arrived before the last request to the replicas use its answers.
            if arrived > self._asked_at or not self._asked_near.issuperset(locations):
                self._asked_near, self._wanted_near = self._wanted_near, set()
                try:
                    self._sibling_loads = await self._siblings.some_loads(self._asked_near)
                except Exception:
                    # Errors of the other replicas must not keep a client from connecting.
                    logger.exception("the loads of the other replicas could not be read")
                    self._sibling_loads = []
                self._asked_at = time.monotonic()
            chosen = self._choose(locations)
        return None if chosen is None else await self._siblings.announce_client(chosen)

    def _choose(self, locations: Sequence[ClientLocation]) -> str | None:
        """Return the name of the replica for a client, and count the client there; None for this
        replica.
        """
        mine = self.load()
        loads = [mine, *self._sibling_loads]
        random.shuffle(loads)  # the random order decides among equally loaded replicas

        choices = (choose_replica(loads, location) for location in locations)
        chosen = next((choice for choice in choices if choice is not None), None)
        if chosen is None:
            return None
        if chosen is mine:
            self.expect_client()
            return None
        # The client's need is not known; this holds until the replica's load is read again.
        chosen.sessions += 1
        return chosen.replica

    async def compare(self) -> None:
        """Compare the loads, and request clients to reconnect if this replica had too many sessions
        twice in a row, or if a replica has joined.
        """
        drain_list, sessions = self._engine.drain_list, self._engine.sessions
        drain_list.forget_older(_RECONNECT_S)
        sessions.drop_idle()

        mine = self.load()
        movable: Counter[str] = Counter()  # number of sessions by connection
        excess = 0
        has_joined = False
        if mine.sessions > 1 and mine.accepts:  # a single session is never too many
            siblings = [load for load in await self._siblings.some_loads() if load.accepts]
            has_joined = self._have_joined(siblings)
            mine = self.load()  # sessions may have begun or ended while the others answered
            if siblings and all(load.version == mine.version for load in siblings):
                movable, excess = self._excess(mine, siblings)

        # A temporary imbalance may end by itself, but a replica that has joined would stay empty.
        if excess <= 0 or not (self._uneven or has_joined):
            drain_list.mark(set())
        else:
            for connection in drain_list.asked_within(_RECONNECT_S):
                del movable[connection]
            drain_list.mark(choose_connections(movable, min(excess, _AT_ONCE)))
            logger.info(
                "%d sessions, %d more than a fair share: some clients are requested to reconnect",
                mine.sessions,
                excess,
            )
        self._uneven = excess > 0

    def _have_joined(self, siblings: Sequence[ReplicaLoad]) -> bool:
        """Return whether some of the replicas were not in any comparison before, and
        record them.
        """
        names = {load.replica for load in siblings}
        is_first, before = self._compared is None, self._compared or set()
        self._compared = names | before
        return not is_first and not names <= before

    def _excess(
        self, mine: ReplicaLoad, siblings: Sequence[ReplicaLoad]
    ) -> tuple[Counter[str], int]:
        """Return the number of sessions of each connection that can be requested to reconnect, and
        the number of sessions that this replica should send away.

        Args:
            mine: The load of this replica.
            siblings: The loads of the other replicas.
        """
        movable = self._engine.sessions.movable_by_connection(_ACTIVE_S)
        # The connections that were requested to reconnect, and have not left yet.
        asked = self._engine.drain_list.asked_within(_SETTLE_S)
        leaving = sum(count for connection, count in movable.items() if connection in asked)
        return movable, excess_sessions(
            mine.sessions, [load.sessions for load in siblings], leaving
        )
