"""The share of a replica that its robots need, from the durations of its batches and the needs of
the robots.

A robot executes one row of an action chunk at each tick, and needs the next chunk before it has
executed the last row. A request waits for the batch that is running when the request arrives, and
then for its own batch. Its answer therefore takes the time of two batches. The longer this takes,
the fewer rows of the answer are left to execute.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vlagents_ray.errors import ConfigError

USABLE = 0.9
"""The largest load at which robots are in time. Requests arrive in bursts, so the queue of a
replica with a load of 1 grows without bound. In the simulation of six kinds of robots that all
start within 3 s, at least 98.1 % of a minute's ticks were in time at 0.9, and 91.6 % at 1.0.
"""

# The largest load with which robots are in time if other requests fill all batches. Without them,
# most batches are smaller than the load assumes.
_USABLE_BESIDE = 0.75
# Load up to which the next batch has room for each robot's request.
_ROOMY = 0.5

# Number of ticks of the slowest robot after which another row may be added to a batch of robots
# although there is no room. Such a row makes a robot late by at most one tick of them.
_HELD_TICKS = 100

# Share of its longest interval after which a robot replans if the replica has room for that. The
# margin is needed because arrivals are uneven, and requests are sent only at ticks.
_RELAXED = 0.75


@dataclass(frozen=True, slots=True)
class CostCurve:
    """The duration of a batch as a function of its number of rows: a line, or a table of measured
    sizes.

    Raises:
        ConfigError: A duration is not a finite number above 0, or the sizes in the table are not in
            ascending order.
    """

    fixed_s: float = 0.0  # duration of a batch without rows, s
    row_s: float = 0.0  # additional duration of each row, s
    table: tuple[tuple[int, float], ...] = ()
    """Pairs of a number of rows and the duration, s. If the table is set, the line is not used.
    Between two sizes the duration is interpolated; above the largest size it grows as between the
    last two sizes.
    """

    def __post_init__(self) -> None:
        sizes = [size for size, _ in self.table]
        if sizes != sorted(set(sizes)) or (sizes and sizes[0] < 1):
            raise ConfigError(
                f"costs: expected batch sizes of at least 1 in ascending order, got {sizes}"
            )
        durations = [duration for _, duration in self.table] or [self.fixed_s + self.row_s]
        is_positive = all(math.isfinite(duration) and duration > 0 for duration in durations)
        if not is_positive or self.fixed_s < 0 or self.row_s < 0:
            raise ConfigError(
                "costs: expected a duration of a batch above 0 s, got "
                f"{self.table or (self.fixed_s, self.row_s)}"
            )

    def cost_s(self, rows: int) -> float:
        """Return the duration of a batch of `rows` rows, s."""
        if not self.table:
            return self.fixed_s + self.row_s * rows

        sizes = [size for size, _ in self.table]
        if rows <= sizes[0] or len(sizes) == 1:
            return self.table[0][1]
        above = min(bisect.bisect_left(sizes, rows), len(sizes) - 1)
        (size, duration), (next_size, next_duration) = self.table[above - 1 : above + 1]
        return duration + (next_duration - duration) * (rows - size) / (next_size - size)


@dataclass(frozen=True, slots=True)
class RobotNeed:
    """The requirements of a robot for the answers of its policy.

    Raises:
        ConfigError: A value is out of range.
    """

    hz: float  # ticks per second
    rows: int = 1  # number of rows of an answer

    def __post_init__(self) -> None:
        if not (math.isfinite(self.hz) and self.hz > 0):
            raise ConfigError(f"hz: expected a rate above 0, got {self.hz}")
        if self.rows < 1:
            raise ConfigError(f"rows: expected at least 1, got {self.rows}")

    def interval_s(self, latency_s: float) -> float:
        """Return the longest time between two requests with which the robot is in time, s.

        Args:
            latency_s: The time from the capture of an observation to the first tick at which its
                answer can be executed, s.

        Returns:
            The interval; 0 if the robot cannot be in time with this latency.
        """
        left_s = self.longest_s - latency_s
        if self.rows == 1:
            # Each tick needs its own answer, which must arrive before the next tick.
            return 1 / self.hz if left_s >= 0 else 0.0
        # With more than one request per tick, the policy would compute actions that are never
        # executed.
        return max(left_s, 1 / self.hz) if left_s > 0 else 0.0

    @property
    def slowest_answer_s(self) -> float:
        """The longest time from a request to its answer with which the robot is in time, s.

        A robot sends its next request at the first tick after an answer. Its rows must therefore
        last for two answers and a tick.
        """
        return 1 / self.hz if self.rows == 1 else (self.rows - 1) / self.hz / 2

    @property
    def longest_s(self) -> float:
        """The longest time from the capture of an observation until the next answer, s."""
        return self.rows / self.hz


class RobotsLoad(NamedTuple):
    """The share of a replica that its robots need."""

    load: float
    """Requests per second that the robots need, as a share of the requests per second that the
    replica can answer in time; `inf` if a robot could not be in time at this replica even alone.
    """
    batch_size: int  # size of the batches with which the load is smallest
    latency_s: float  # time from a request to its answer with batches of that size, s
    # Time between two requests of each robot that can wait so long, with which the load of the
    # replica is at most `USABLE`, s.
    interval_s: float = math.inf

    @property
    def in_time(self) -> bool:
        """Whether all robots can be in time."""
        return self.load <= USABLE

    def replan_s(self, need: RobotNeed) -> float:
        """Return the time between two requests of a robot with which the load of the replica is at
        most `USABLE`, s; 0 if the robot may send requests as often as it needs.

        All robots replan equally often, except robots that must replan more often to be in time. No
        robot thus has fresher actions at the expense of another robot. The nearer the replica is to
        its limit, the larger is the part of its plan that each robot executes before it replans.
        """
        share = min(1.0, max(_RELAXED, self.load / USABLE))
        return min(self.interval_s, share * need.interval_s(self.latency_s))


IDLE = RobotsLoad(0.0, 1, 0.0, 0.0)


def robots_load(
    costs: CostCurve, needs: Mapping[RobotNeed, int], max_batch_size: int
) -> RobotsLoad:
    """Compute the load of a replica with the batch size that minimizes the load.

    Small batches answer sooner, and large batches answer more requests per second.

    Args:
        costs: The duration of the replica's batches.
        needs: The number of robots with each need.
        max_batch_size: The largest batch of the replica.
    """
    robots = sum(needs.values())
    if not robots:
        return IDLE

    sizes = np.arange(1, min(max_batch_size, robots) + 1)
    costs_s = np.array([costs.cost_s(size) for size in sizes.tolist()])
    latencies_s = np.array([answer_s(costs, size, robots) for size in sizes.tolist()])
    needed_hz = _needed_hz(needs, latencies_s)
    too_late = np.flatnonzero(np.isinf(needed_hz))
    # Larger batches take even longer.
    usable_sizes = int(too_late[0]) if len(too_late) else len(sizes)
    if not usable_sizes:
        return RobotsLoad(math.inf, 1, float(latencies_s[0]))

    loads = (needed_hz * costs_s / sizes)[:usable_sizes]
    best = int(np.argmin(loads))
    load, latency_s, size = float(loads[best]), float(latencies_s[best]), int(sizes[best])
    share = max(_RELAXED, load / USABLE)
    paced_s = [(share * need.interval_s(latency_s), count) for need, count in needs.items()]
    usable_hz = USABLE * size / costs.cost_s(size)
    return RobotsLoad(load, size, latency_s, _common_interval_s(paced_s, usable_hz))


class Room(NamedTuple):
    """The room that the robots of a replica leave to other requests in its batches."""

    displaced: int  # the most rows of a batch with displaced robots, see `FairQueue`
    # The most rows of a batch with other requests, alone and together with requests of the robots.
    alone: int
    beside: int
    # Interval between two single rows that are added to batches of robots if `beside` is 0, s.
    held_s: float
    load: RobotsLoad  # load of the robots while other requests use the room


def room_for_others(
    costs: CostCurve, needs: Mapping[RobotNeed, int], max_batch_size: int, load: RobotsLoad
) -> Room:
    """Compute the largest batches with other requests with which the robots are in time.

    A batch of other requests may begin just before a robot's request arrives, and the other
    requests fill the batches of robots. An answer thus takes the time of two such batches, or of
    three if the next batch may have no room for a request. If even a single other request would
    make robots late, other requests are only answered together with the only robot, whose next
    request cannot arrive during that batch.

    Args:
        costs: The duration of the replica's batches.
        needs: The number of robots with each need.
        max_batch_size: The largest batch of the replica.
        load: The load of the robots without other requests.
    """
    robots = sum(needs.values())
    if not robots:
        return Room(max_batch_size, max_batch_size, max_batch_size, 0.0, load)

    sizes = np.arange(1, max_batch_size + 1)
    costs_s = np.array([costs.cost_s(size) for size in sizes.tolist()])

    held_s = _HELD_TICKS / min(need.hz for need in needs)

    def loads(latencies_s: np.ndarray) -> np.ndarray:
        shares: np.ndarray = _needed_hz(needs, latencies_s) * costs_s / sizes
        return shares

    def largest(latencies_s: np.ndarray) -> int:
        slowest_s = min(need.slowest_answer_s for need in needs)
        in_time = (loads(latencies_s) <= _USABLE_BESIDE) & (latencies_s <= slowest_s)
        return max(sizes[in_time].tolist(), default=0)

    has_room = (sizes >= robots) | (loads(2 * costs_s) <= _ROOMY)
    latencies_s = np.where(has_room, 2, 3) * costs_s
    alone = beside = largest(latencies_s)
    if beside == 0 and robots == 1:
        latencies_s = costs_s
        beside = largest(latencies_s)
    if beside == 0:
        return Room(load.batch_size, 0, 0, held_s, load)

    index = beside - 1
    # The robots leave the time that they do not need to the other requests: their pace has no upper
    # limit.
    beside_others = RobotsLoad(float(loads(latencies_s)[index]), beside, float(latencies_s[index]))
    return Room(load.batch_size, alone, beside, held_s, beside_others)


def _needed_hz(needs: Mapping[RobotNeed, int], latencies_s: np.ndarray) -> np.ndarray:
    """Return the requests per second that robots need at each latency (S,), computed as in
    `RobotNeed.interval_s`; `inf` at latencies with which a robot cannot be in time.

    A replica computes this on the thread of its policy, for up to thousands of different robots and
    for each size of its batches. The vectorized computation takes a tenth of the time.
    """
    periods_s = np.array([1 / need.hz for need in needs])
    longest_s = np.array([need.longest_s for need in needs])
    has_one_row = np.array([need.rows == 1 for need in needs])
    counts = np.array(list(needs.values()))

    left_s = longest_s - latencies_s[:, np.newaxis]  # (S, number of needs)
    is_in_time = np.where(has_one_row, left_s >= 0, left_s > 0)
    intervals_s = np.where(has_one_row, periods_s, np.maximum(left_s, periods_s))
    needed_hz = (counts / intervals_s).sum(axis=1)
    return np.where(is_in_time.all(axis=1), needed_hz, math.inf)


def _common_interval_s(longest_s: Sequence[tuple[float, int]], usable_hz: float) -> float:
    """Return the time between two requests with which all robots together send `usable_hz` requests
    per second, s. Robots whose longest time is shorter send requests more often.

    Args:
        longest_s: Pairs of a longest time between two requests, s, and the number of robots with
            it.
        usable_hz: The requests per second; the result is `inf` if the robots need more.
    """
    robots = sum(count for _, count in longest_s)
    for interval_s, count in sorted(longest_s):
        common_s = robots / usable_hz if usable_hz > 0 else math.inf
        if common_s <= interval_s:
            return common_s
        usable_hz -= count / interval_s
        robots -= count
    return math.inf


def answer_s(costs: CostCurve, size: int, robots: int) -> float:
    """Return the longest time from the arrival of a request to its answer, s: the duration of the
    batch that is running then, and of the request's own batch. If there is only one robot, no batch
    is running.
    """
    return costs.cost_s(size) * (1 if robots == 1 else 2)
