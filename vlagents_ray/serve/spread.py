"""Which replica a new session goes to, and how many sessions a replica has too many. Pure decisions."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

_SLACK = 0.25  # of the mean, and one session at least: a smaller difference is not worth a move


@dataclass(slots=True)
class Load:
    """What one replica holds, as it says itself."""

    replica: str  # the name of its actor
    sessions: int  # held, and expected from clients that were sent to it just now
    accepts: bool  # its policy is loaded, and it does not stop
    node: str  # Ray's id of its node
    boot_id: str  # of its machine
    version: tuple[str, str]  # of the policy and what its sessions share; a session moves between equal ones


@dataclass(frozen=True, slots=True)
class Place:
    """Where a client runs, as far as it knows, so that a replica near to it is preferred."""

    node: str = ""  # Ray's id; empty outside the cluster
    boot_id: str = ""
    must_be_near: bool = False  # the client's transport reaches no other machine

    def is_near(self, load: Load) -> bool:
        """Is that replica on this node, or at least this machine?"""
        return (self.node != "" and self.node == load.node) or (self.boot_id != "" and self.boot_id == load.boot_id)


def choose(loads: Sequence[Load], place: Place) -> Load | None:
    """The least loaded replica, one near to the client unless it is clearly more loaded; of equals, the first.

    None if no replica accepts sessions, or none near to a client that needs one.
    """
    accepting = [load for load in loads if load.accepts]
    near = min((load for load in accepting if place.is_near(load)), key=_sessions, default=None)
    least = min(accepting, key=_sessions, default=None)
    if place.must_be_near or least is None or (near and near.sessions <= _tolerated(least.sessions)):
        return near
    return least


def surplus(mine: int, others: Iterable[int], leaving: int = 0) -> int:
    """How many of its `mine` sessions a replica should send away, if `others` are what the other replicas hold.

    None within the mean + 25 %, or + one session; `leaving` of them are on their way already.
    """
    loads = [mine, *others]
    mean = sum(loads) / len(loads)
    if mine - leaving <= _tolerated(mean):
        return 0
    return mine - leaving - -(-sum(loads) // len(loads))


def pick(connections: Sequence[int], count: int) -> list[int]:
    """Which connections, given the sessions of each, to send away so that `count` sessions leave, at most.

    Sessions of one connection move together, so one with more sessions than that stays.
    """
    chosen = []
    for index in sorted(range(len(connections)), key=lambda i: -connections[i]):
        if connections[index] <= count:
            chosen.append(index)
            count -= connections[index]
    return chosen


def _tolerated(sessions: float) -> float:
    return sessions + max(1.0, _SLACK * sessions)


def _sessions(load: Load) -> int:
    return load.sessions
