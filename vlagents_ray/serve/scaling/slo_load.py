"""The share of a replica that its robots need to be in time, for autoscaling and rebalancing."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

from vlagents_ray.serve.engine.engine import Engine
from vlagents_ray.serve.fleet import USABLE, CostCurve, RobotNeed
from vlagents_ray.serve.sessions import Session

# Maximum result of `most_on_replica`.
_MOST = 1_000_000
PARTS = 1_000_000  # unit of `loads_by_connection`, as a share of a replica
# Time after which no other replica still counts a session that moved here, s. Ray Serve notices the
# end of a killed replica with a check every 5 s.
MOVED_S = 6.0
_KEPT_S = 0.25  # time for which a load is kept


class RobotsLoad(NamedTuple):
    """The load of a replica's robots."""

    robots: int = 0  # sessions whose needs are known
    # Number of replicas that the robots need with a load of `USABLE` each, times `USABLE`.
    load: float = 0.0
    # The part of the load that has just moved from other replicas, which may still count it.
    moved_load: float = 0.0


def robots_load(engine: Engine) -> RobotsLoad:
    """Return the load of a replica's robots, which is 0 before the first batch."""
    needs: Counter[RobotNeed] = Counter()
    moved: Counter[RobotNeed] = Counter()
    since = engine.clock() - MOVED_S
    for session in engine.sessions.all():
        need = session.plan.need
        if need is None:
            continue
        needs[need] += 1
        if session.moved_in > since:
            moved[need] += 1

    costs = engine.queue.window.curve()
    if costs is None:
        return RobotsLoad(needs.total())
    size = engine.settings.max_batch_size
    return RobotsLoad(needs.total(), slo_load(costs, needs, size), slo_load(costs, moved, size))


class RobotsLoadMeter:
    """Reads the load of a replica's robots at most a few times per second, even if other replicas
    request it more often. Thread-safe.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        # The time at which the load was read, s, the number of sessions at that time, and the load.
        # This is one tuple, which readers replace as a whole.
        self._last = (-math.inf, 0, RobotsLoad())

    def read(self) -> RobotsLoad:
        """Return the load of the current sessions, which is at most `_KEPT_S` old."""
        now, sessions = self._engine.clock(), len(self._engine.sessions)
        read_at, sessions_then, load = self._last
        if now - read_at > _KEPT_S or sessions != sessions_then:
            load = robots_load(self._engine)
            self._last = (now, sessions, load)
        return load


def loads_by_connection(engine: Engine, sessions: Iterable[Session[Any]]) -> Counter[str]:
    """Return the load of the sessions by connection, in `PARTS`, since a `Counter` has integer
    values.
    """
    costs = engine.queue.window.curve()
    loads: Counter[str] = Counter()
    if costs is None:
        return loads
    shares: dict[RobotNeed, float] = {}
    for session in sessions:
        need = session.plan.need
        if need is None:
            continue
        if need not in shares:
            shares[need] = slo_load(costs, {need: 1}, engine.settings.max_batch_size)
        loads[session.origin.connection] += int(PARTS * shares[need])
    return loads


def slo_load(costs: CostCurve, needs: Mapping[RobotNeed, int], max_batch_size: int) -> float:
    """Return the load of robots that are spread over replicas.

    This differs from the load of the replica that serves them now (`fleet.replica_load`): batches
    are smaller if robots are spread, so the sum of such loads would depend on the number of
    replicas. Here, each robot counts as its share of a replica that is full of such robots, so the
    sum over all replicas does not change when sessions move. A robot that cannot be in time even
    alone counts as one replica.

    Args:
        costs: The duration of batches.
        needs: The number of robots with each need.
        max_batch_size: The largest batch of a replica.
    """
    load = 0.0
    for need, robots in needs.items():
        load += USABLE * robots / max(1, most_on_replica(costs, need, max_batch_size))
    return load


def most_on_replica(costs: CostCurve, need: RobotNeed, max_batch_size: int) -> int:
    """Return the largest number of equal robots that a replica can serve in time, up to `_MOST`.

    It is computed as in `fleet.most_robots`, but without a search. Its duration must not depend on
    the needs, since clients choose them.
    """
    alone_s = need.interval_s(costs.cost_s(1))
    most = 1 if USABLE * alone_s >= costs.cost_s(1) else 0
    for size in range(1, max_batch_size + 1):
        # A request waits for the running batch, and then for its own batch.
        interval_s = need.interval_s(2 * costs.cost_s(size))
        robots = min(_MOST, USABLE * interval_s * size / costs.cost_s(size))
        if robots >= max(2, size):  # batches are no larger than the number of robots
            most = max(most, math.floor(robots + 1e-9))
    return most
