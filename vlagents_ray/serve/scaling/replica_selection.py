"""The choice of a replica for a new session, and the number of surplus sessions of a replica; pure functions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_SLACK = 0.25  # tolerated excess over the mean, as a share of the mean; at least one session is tolerated


@dataclass(slots=True)
class ReplicaLoad:
    """The load of one replica, as that replica reports it."""

    replica: str  # name of its actor
    sessions: int  # sessions held, and those expected from clients that were just sent to it
    accepts: bool  # whether its policy is loaded, and it is not stopping
    node: str  # Ray's id of its node
    boot_id: str  # boot id of its machine
    version: tuple[str, str]  # version of the policy and its shared objects; sessions only move between equal ones


@dataclass(frozen=True, slots=True)
class ClientLocation:
    """The location of a client, as far as the client knows it; replicas near to it are preferred."""

    node: str = ""  # Ray's id of its node; empty outside the cluster
    boot_id: str = ""  # boot id of its machine; empty if unknown
    must_be_near: bool = False  # whether the client's transport only reaches its own machine

    def is_near(self, load: ReplicaLoad) -> bool:
        """Return whether that replica runs on the client's node, or on its machine."""
        return (self.node != "" and self.node == load.node) or (self.boot_id != "" and self.boot_id == load.boot_id)


def choose_replica(loads: Sequence[ReplicaLoad], place: ClientLocation) -> ReplicaLoad | None:
    """Return the least loaded replica near to the client, or the least loaded one if that has clearly fewer sessions.

    Among equally loaded replicas, the first is chosen. The result is None if no replica accepts sessions, or if the
    client needs a near one and there is none.
    """
    accepting = [load for load in loads if load.accepts]
    near = min((load for load in accepting if place.is_near(load)), key=_sessions, default=None)
    least = min(accepting, key=_sessions, default=None)
    if place.must_be_near or least is None or (near and near.sessions <= _tolerated(least.sessions)):
        return near
    return least


def excess_sessions(mine: int, others: Iterable[int], leaving: int = 0) -> int:
    """Return how many sessions a replica should send away.

    Args:
        mine: Number of sessions that this replica holds.
        others: Numbers of sessions that the other replicas hold.
        leaving: Number of this replica's sessions that are leaving already.

    Returns:
        The excess over the mean, rounded down; 0 if it is at most 25 % of the mean or one session.
    """
    loads = [mine, *others]
    mean = sum(loads) / len(loads)
    if mine - leaving <= _tolerated(mean):
        return 0
    return mine - leaving - -(-sum(loads) // len(loads))


def choose_connections(connections: Sequence[int], count: int) -> list[int]:
    """Choose the connections to send away so that at most `count` sessions leave.

    All sessions of a connection move together, so a connection with more than `count` sessions stays.

    Args:
        connections: Number of sessions of each connection.
        count: Largest number of sessions to send away.

    Returns:
        Indices into `connections`.
    """
    chosen = []
    for index in sorted(range(len(connections)), key=lambda i: -connections[i]):
        if connections[index] <= count:
            chosen.append(index)
            count -= connections[index]
    return chosen


def _tolerated(sessions: float) -> float:
    return sessions + max(1.0, _SLACK * sessions)


def _sessions(load: ReplicaLoad) -> int:
    return load.sessions
