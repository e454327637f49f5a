"""Robots that share one policy in virtual time, with the real queue and the real pace of its
replica.

`PYTHONPATH=tests/support python -m tests.simulation.robots --seeds 100000` runs random worlds, and
checks each. With `--fleets` in place of `--seeds`, it prints the largest fleets in time, and the
robots in time of smaller and larger fleets: without slack, with the order by slack, and with the
pace as well. With `--successful`, it prints the largest fleets of successful robots, and the tasks
per GPU-hour, of these and of the loops and servers of other systems (`benchmarks.successful`).
"""

from __future__ import annotations

import argparse
import bisect
import heapq
import itertools
import json
import math
import random
import time
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from in_flight import AnySession, message_of_one

from benchmarks.robot_process import executed_by_waiting
from benchmarks.robots import RobotsPlan
from benchmarks.successful import CHECKPOINT, FleetSuccess, ServedRobot, curve_of
from vlagents_ray.protocol.messages import Priority, Request
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.queue.fair_queue import BEHIND_OTHERS_S, PATIENCE_S
from vlagents_ray.serve.queue.replica_pace import ReplicaPace, RobotPlan
from vlagents_ray.serve.queue.robots_load import (
    USABLE,
    CostCurve,
    RobotNeed,
    RobotsLoad,
    robots_load,
)
from vlagents_ray.serve.requests import Origin, PendingRequest
from vlagents_ray.success import SuccessCurve

PI0 = CostCurve(0.0293, 0.00806)  # pi0 on an H200, compiled
GRAPHS = CostCurve(0.0415, 0.0105)
SMALL = CostCurve(0.004, 0.0005)
LARGEST = 16
WIRE_S = 0.002  # network time of a message, one way
MEASURED_S = 30.0  # minimum duration of a measurement


class _NoFiles:
    """Replaces the poller on which the queue's thread waits."""

    def wake(self) -> None:
        pass

    hand_to_reader = reclaim = close = wake


@dataclass
class Robot:
    """A control loop with chunks: at each tick it executes a row, and may send a request."""

    name: str
    hz: float
    rows: int
    states_slack: bool = True
    lies: bool = False  # whether it claims in each request to be about to run out of rows
    obeys: bool = True  # whether it replans at the requested pace
    # Whether it executes half of a chunk, and then waits for the next one, like the loops of openpi
    # and vlagents.
    stops: bool = False
    source: str = ""
    executed: int = 0  # number of executed rows
    end: int = 0  # number of rows to the end of its plan, including executed ones
    begun: bool = False  # whether the first answer has arrived, for which its reset waits
    captured: float = 0.0  # tick of the observation of its current rows, s
    ticks: int = 0
    starved: int = 0
    ages: list[float] = field(default_factory=list)
    # The ticks of each wait of a robot that stops, and the delay of each answer, in rows.
    waits: list[float] = field(default_factory=list)
    delays: list[float] = field(default_factory=list)
    waiting: PendingRequest | None = None
    waits_until: float = 0.0  # time before which a request is useless, s
    inference_s: float = 0.0  # duration of its last batch
    late_s: float = 0.0  # time of its last starved tick, s
    plan: RobotPlan = field(default_factory=RobotPlan)

    def share_in_time(self) -> float:
        """Return the share of ticks that had an action."""
        return 1 - self.starved / self.ticks if self.ticks else 0.0

    def served(self) -> ServedRobot:
        """Return the service to the robot."""
        ticks = self.ticks + sum(self.waits)
        return ServedRobot(self.hz, ticks, self.starved, self.waits, self.delays)


@dataclass
class Simulation:
    """An environment that sends its next observation shortly after each answer."""

    name: str
    answered: int = 0
    longest_s: float = 0.0


class World:
    """A policy, its queue, and the robots and simulations that use it."""

    def __init__(
        self,
        costs: CostCurve,
        robots: Iterable[Robot],
        *,
        seed: int = 0,
        simulations: int = 0,
        slack: bool = True,
        deadlines: float = 0.0,
        jitter: float = 0.02,
        begin_s: float | None = None,
        largest: int = LARGEST,
    ) -> None:
        self.largest = largest  # maximum size of a batch
        self.begin_s = begin_s  # time within which robots begin; None for the duration of one chunk
        self.draw = random.Random(seed)
        self.costs, self.slack = costs, slack
        self.deadlines, self.jitter = deadlines, jitter
        self.robots = list(robots)
        self.simulations = [Simulation(f"env{number}") for number in range(simulations)]
        self.now = 0.0
        self.measured_from = 0.0  # earlier ticks are not counted
        self.queue = BatchQueue(
            largest,
            sessions=AnySession(),
            clock=lambda: self.now,
            poller=_NoFiles(),  # type: ignore[arg-type]
        )
        self.queue.bind()
        self.pace = ReplicaPace(
            self.queue,
            lambda: [(robot.plan, robot.waiting is not None) for robot in self.robots],
            lambda: self.now,
        )
        self.busy = False
        self.batches: list[int] = []
        self.sent = self.answered = self.expired = 0
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._count = itertools.count()

    def at(self, when: float, call: Callable[[], None]) -> None:
        """Call `call` at that time."""
        heapq.heappush(self._due, (when, next(self._count), call))

    def run(self, seconds: float) -> World:
        """Run the world for so many seconds."""
        for index, robot in enumerate(self.robots):
            robot.plan.began = index - len(self.robots)  # their resets were before the first tick
            round_s = max(1.0, robot.rows / robot.hz)
            phase = self.draw.random() * (round_s if self.begin_s is None else self.begin_s)
            if robot.stops:
                self.at(phase, lambda robot=robot: self._stop(robot))
            else:
                self.at(phase, lambda robot=robot, phase=phase: self._tick(robot, phase, 0))
        for simulation in self.simulations:
            self.at(self.draw.random() * 0.1, lambda one=simulation: self._simulate(one))
        while self._due and self._due[0][0] <= seconds:
            self.now, _, call = heapq.heappop(self._due)
            call()
        return self

    def _tick(self, robot: Robot, phase: float, tick: int) -> None:
        """Send a request if it is due according to the rules of `ChunkPlayer`, and execute
        a row.
        """
        period_s = 1 / robot.hz
        at = phase + tick * period_s
        self.at(at + period_s, lambda: self._tick(robot, phase, tick + 1))

        known = robot.end - robot.executed
        slack_s = max(0.0, known * period_s - 2 * WIRE_S)
        starves = known <= 1 or slack_s <= robot.inference_s + 2 * period_s
        if robot.waiting is None and (starves or self.now >= robot.waits_until):
            self._ask(robot, slack_s, at)

        if not robot.begun:
            return
        is_measured = self.now >= self.measured_from
        robot.ticks += is_measured
        if known > 0:
            robot.executed += 1
            if is_measured:
                robot.ages.append(self.now - robot.captured)
        else:
            robot.starved += is_measured
            robot.late_s = self.now

    def _stop(self, robot: Robot) -> None:
        """Stop, request the next chunk, and execute half of its rows."""
        at, period_s = self.now, 1 / robot.hz
        rows = executed_by_waiting(robot.rows)

        def move() -> None:
            waited_s = self.now - at
            if at >= self.measured_from:
                robot.ticks += rows
                robot.waits.append(waited_s * robot.hz)
                robot.delays.append(0)
                robot.ages += [waited_s + row * period_s for row in range(rows)]
            robot.begun = True
            self.at(self.now + rows * period_s, lambda: self._stop(robot))

        self._ask(robot, 0.0, at, move)

    def _ask(
        self, robot: Robot, slack_s: float, at: float, done: Callable[[], None] | None = None
    ) -> None:
        arrived = self.now + WIRE_S
        row = robot.executed
        pending = PendingRequest(
            robot.name,
            Request("act"),
            message_of_one(),
            Priority.ROBOT,
            arrived,
            origin=Origin(connection=robot.source),
        )
        if robot.states_slack and self.slack:
            pending.needed = arrived + (0.0 if robot.lies else slack_s)
            pending.waits_behind_others = robot.plan.waits_behind_others
        if self.deadlines and self.draw.random() < self.deadlines:
            pending.deadline = arrived + self.draw.choice([0.05, 0.3, 2.0])
        done = done or (lambda: self._receive(robot, row, at))
        pending.observer_data = {"done": done, "robot": robot}
        robot.waiting = pending
        self.sent += 1
        self.at(arrived, lambda: self._put(pending))

    def _simulate(self, simulation: Simulation) -> None:
        pending = PendingRequest(
            simulation.name, Request("act"), message_of_one(), Priority.SIMULATION, self.now
        )

        def done() -> None:
            simulation.answered += 1
            simulation.longest_s = max(simulation.longest_s, self.now - pending.arrived)
            self.at(self.now + 0.005, lambda: self._simulate(simulation))

        pending.observer_data = {"done": done}
        self.sent += 1
        self._put(pending)

    def _put(self, pending: PendingRequest) -> None:
        pending.observer_data["class"] = self._class_of(pending)
        self.queue.put(pending)
        if not self.busy:
            self._turn()

    def _class_of(self, pending: PendingRequest) -> int:
        """Return the class of a request at this time: 0 for urgent robots, 1 for robots that can
        wait, 2 for displaced robots, 3 for robots without slack, and 4 for simulations.
        """
        if pending.priority is Priority.SIMULATION:
            return 4
        if self.now - pending.arrived > BEHIND_OTHERS_S:
            return 0
        if not pending.needed:
            return 3
        if pending.waits_behind_others:
            return 2
        costs_s = self.queue.window.costs_s
        return 1 if costs_s and pending.needed > self.now + 2 * costs_s[-1] else 0

    def _turn(self) -> None:
        taken = self.queue.take()
        assert taken is not None
        for late in taken.expired:
            assert late.deadline < self.now, "a useful request was dropped"
            self.expired += 1
            if "robot" in late.observer_data:
                late.observer_data["robot"].waiting = None
        if not taken.batch:
            return
        self._check(taken.batch)
        self.busy = True
        self.batches.append(len(taken.batch))
        self.queue.begin(taken.batch)
        took = self.costs.cost_s(len(taken.batch)) * self.draw.uniform(1, 1 + self.jitter)
        self.at(self.now + took, lambda: self._finish(taken.batch, took))

    def _check(self, batch: list[PendingRequest]) -> None:
        """Check the properties of each batch."""
        assert len(batch) <= self.largest
        assert len({pending.session_id for pending in batch}) == len(batch), (
            "two requests of one session"
        )
        # The class of a robot that can wait changes as time passes.
        first_left = min(
            (
                max(self._class_of(pending), pending.observer_data["class"])
                for pending in self.queue._waiting.heads()
                if not pending.over and pending.deadline >= self.now
            ),
            default=4,
        )
        classes = sorted(
            min(self._class_of(pending), pending.observer_data["class"]) for pending in batch
        )
        if first_left == 3 and classes[-1] == 4:
            classes.pop()  # a simulation that has waited for too long
            assert 4 not in classes, "robots without slack are left out"
        assert max(classes, default=0) <= first_left, "a later class is served first"

        room = self.queue.room
        if room is not None and max(classes, default=0) >= 3:
            # One held request may be added to a batch of robots.
            most = max(room.beside, bisect.bisect(classes, 2) + 1) if classes[0] < 3 else room.alone
            assert len(batch) <= most, "the batch is too large for the robots"

    def _finish(self, batch: list[PendingRequest], took: float) -> None:
        self.queue.end()
        self.busy = False
        for pending in batch:
            self.answered += 1
            pending.over = True
            robot: Robot | None = pending.observer_data.get("robot")
            if robot is None:
                pending.observer_data["done"]()
                continue
            replan_s = 0.0
            if pending.needed:
                robot.plan.observe(robot.rows, pending.arrived, pending.needed, self.now)
                replan_s = self.pace.replan_s(robot.plan)
            arrives = self.now + WIRE_S
            robot.inference_s = took
            self.at(
                arrives, lambda pending=pending, replan_s=replan_s: self._answer(pending, replan_s)
            )
        if self.pace.robots:
            self.pace.load()
        self._turn()

    def _answer(self, pending: PendingRequest, replan_s: float) -> None:
        robot: Robot = pending.observer_data["robot"]
        robot.waiting = None
        if robot.obeys:
            robot.waits_until = self.now + replan_s
        pending.observer_data["done"]()

    def _receive(self, robot: Robot, row: int, captured: float) -> None:
        """Replace the plan by the rows of an answer, like `ChunkBuffer.add`."""
        robot.begun = True
        end = row + robot.rows
        if end == robot.executed == robot.end:
            end += 1  # the last row may be executed one tick late
        has_row = end > robot.executed and end > robot.end
        if has_row:
            robot.end, robot.captured = end, captured
        if self.now >= self.measured_from:
            robot.delays.append(robot.executed - row if has_row else math.inf)

    def check_all_answered(self) -> None:
        """Check that no request is lost, and that no simulation waits forever beside robots without
        known needs.
        """
        under_way = sum(robot.waiting is not None for robot in self.robots)
        under_way += len(self.simulations) if self.now > 0.2 else 0
        missing = self.sent - self.answered - self.expired
        assert 0 <= missing <= under_way, f"{missing} requests without an answer, {under_way} sent"

        if any(robot.plan.need is not None for robot in self.robots):
            return
        # Every second batch has a slot for a simulation that has waited for long.
        longest_batch_s = self.costs.cost_s(self.largest) * (1 + self.jitter)
        bound_s = PATIENCE_S + 2 * (len(self.simulations) + 1) * longest_batch_s
        for simulation in self.simulations:
            assert simulation.longest_s <= bound_s, f"{simulation.name} waited for too long"

    def in_time(self) -> int:
        """Return the robots of which at least 98 % of the ticks had an action."""
        return sum(robot.share_in_time() >= 0.98 for robot in self.robots)

    def success(self, curve: SuccessCurve) -> FleetSuccess:
        """Return the number of successful robots, and the tasks per GPU-hour."""
        return FleetSuccess.from_robots([robot.served() for robot in self.robots], curve)

    def share(self) -> float:
        """Return the lowest share in time of all robots."""
        return min(robot.share_in_time() for robot in self.robots)

    def age_p95_s(self) -> float:
        """Return the 95th percentile of the age of executed actions, in s."""
        ages = sorted(age for robot in self.robots for age in robot.ages)
        return ages[int(0.95 * len(ages))] if ages else math.nan


def fleet(number: int, *kinds: tuple[int, float]) -> list[Robot]:
    """Return `number` robots, with the kinds (rows, hz) in turn."""
    return [
        Robot(f"robot{index}", kinds[index % len(kinds)][1], kinds[index % len(kinds)][0])
        for index in range(number)
    ]


def play(
    costs: CostCurve,
    number: int,
    slack: bool,
    *kinds: tuple[int, float],
    obeys: bool = True,
    stops: bool = False,
    batch: int = LARGEST,
) -> World:
    """Run a fleet for long enough to settle.

    Args:
        costs: The durations of batches.
        number: The number of robots.
        slack: Whether the queue uses the slack of the robots.
        kinds: The kinds of robots, which take turns: rows of a chunk, and Hz.
        obeys: Whether the robots replan at the requested pace.
        stops: Whether the robots wait for each chunk.
        batch: The maximum size of a batch.
    """
    longest_s = max(rows / hz for rows, hz in kinds)
    robots = fleet(number, *kinds)
    for robot in robots:
        robot.obeys, robot.stops = obeys, stops
    world = World(costs, robots, seed=number, slack=slack, largest=batch)
    world.measured_from = 4 * longest_s + 2
    # With a shorter measurement, a robot with only two late ticks would have less than 98 % in
    # time.
    measured_s = max(MEASURED_S, 6 * longest_s + 4)
    return world.run(world.measured_from + measured_s)


def largest(costs: CostCurve, slack: bool, *kinds: tuple[int, float], obeys: bool = True) -> int:
    """Return the largest fleet in which 98 % of each robot's ticks have an action."""

    return largest_that(
        lambda number: play(costs, number, slack, *kinds, obeys=obeys).share() >= 0.98
    )


def largest_that(fits: Callable[[int], bool]) -> int:
    """Return the size of the largest fleet that fits, to within 1 %; 0 if not even one robot
    does.
    """
    low, high = 0, 1
    while fits(high):
        low, high = high, 2 * high
    while high - low > max(1, low // 100):
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def start_at_once(costs: CostCurve, number: int, slack: bool, *kinds: tuple[int, float]) -> World:
    """Run a fleet whose robots all begin within 0.1 s, for a minute."""
    robots = fleet(number, *kinds)
    return World(costs, robots, seed=number, slack=slack, begin_s=0.1).run(60.0)


def print_starts() -> None:
    """Print the late ticks of robots that all begin at the same time."""
    print("robots  rows     slack  starved s per robot (mean, most)  s until none is starved")
    for kinds, numbers in (
        (((50, 10.0),), (64, 128, 192, 256, 320, 400)),
        (((8, 10.0),), (16, 32, 40)),
        (((50, 10.0), (8, 10.0)), (48, 64, 80, 96)),
    ):
        rows = ",".join(str(rows) for rows, _ in kinds)
        for number, slack in itertools.product(numbers, (False, True)):
            robots = start_at_once(PI0, number, slack, *kinds).robots
            starved_s = [robot.starved / robot.hz for robot in robots]
            last_s = max(robot.late_s for robot in robots)
            in_time = sum(robot.starved <= 0.02 * robot.ticks for robot in robots)
            print(
                f"{number:6}  {rows:8} {slack!s:6} {sum(starved_s) / number:6.2f} "
                f"{max(starved_s):6.2f}  {last_s:6.1f}  {in_time} robots in time for 98 % of a minute",
                flush=True,
            )


# The ways to serve robots: whether the queue uses their slack, and whether they obey the pace.
WAYS = {"no slack": (False, True), "slack": (True, False), "slack and pace": (True, True)}


def print_fleets() -> None:
    """Print the largest fleets in time, and the robots in time of smaller and larger fleets. Their
    sizes are shares of the largest fleet with slack and pace.
    """
    print("fleet          way             largest  in time of 70 %, 105 %, 125 %")
    for name, kinds in {
        "8 rows": [(8, 10.0)],
        "50 and 8 rows": [(50, 10.0), (8, 10.0)],
        "50 rows": [(50, 10.0)],
    }.items():
        most = {
            way: largest(PI0, slack, *kinds, obeys=obeys) for way, (slack, obeys) in WAYS.items()
        }
        for way, (slack, obeys) in WAYS.items():
            in_time = []
            for part in (0.7, 1.05, 1.25):
                number = round(part * most["slack and pace"])
                world = play(PI0, number, slack, *kinds, obeys=obeys)
                in_time.append(f"{world.in_time()} of {number}")
            print(f"{name:14} {way:15} {most[way]:7}  {', '.join(in_time)}", flush=True)


@dataclass(frozen=True)
class System:
    """A server, and the loop of its robots."""

    slack: bool  # whether the server uses the slack of the robots
    stops: bool  # whether robots wait for each chunk
    batch: int  # maximum size of a batch

    def play(self, number: int, *kinds: tuple[int, float]) -> World:
        """Run a fleet."""
        return play(PI0, number, self.slack, *kinds, stops=self.stops, batch=self.batch)

    def largest(self, tolerated: int, *kinds: tuple[int, float]) -> int:
        """Return the largest fleet of which each robot is successful, given the tolerated delay of
        the policy, in rows.
        """

        def fits(number: int) -> bool:
            robots = self.play(number, *kinds).robots
            return all(robot.served().is_successful(tolerated) for robot in robots)

        return largest_that(fits)


SYSTEMS = {
    "this server, chunk player": System(slack=True, stops=False, batch=LARGEST),
    "batches by arrival, chunk player": System(slack=False, stops=False, batch=LARGEST),
    "one request at a time, chunk player": System(slack=False, stops=False, batch=1),
    "this server, waiting loop": System(slack=True, stops=True, batch=LARGEST),
    "batches by arrival, waiting loop": System(slack=False, stops=True, batch=LARGEST),
    "one request at a time, waiting loop": System(slack=False, stops=True, batch=1),
}
"""Plain Ray Serve computes batches in the order of arrival. The servers of openpi and vlagents
compute one request at a time, and their loops wait for each chunk.
"""


LOADS = (0.25, 0.7, 1.05)  # numbers of robots, relative to the capacity (`RobotsPlan.capacity`)
TOLERATED = (1, 2, 3, 5, 8)  # tolerated delays of policies, in rows


def successful(checkpoint: Path) -> dict[str, Any]:
    """Return the largest fleets of successful robots by the tolerated delay of the policy, and, if
    the success of a checkpoint was measured, the tasks per GPU-hour of fleets of fixed sizes.

    The result is JSON. It is also printed.

    Args:
        checkpoint: The folder of the checkpoint.
    """
    curves = {loop: curve_of(checkpoint, loop) for loop in ("player", "waiting")}
    entries = []
    for rows, (name, system) in itertools.product((8, 50), SYSTEMS.items()):
        kind = (rows, 10.0)
        largest = {str(delay): system.largest(delay, kind) for delay in TOLERATED}
        print(f"simulated, {rows} rows, {name}: largest successful fleets {largest}", flush=True)

        fleets = []
        curve = curves["waiting" if system.stops else "player"]
        if curve is not None:
            for load in LOADS:
                number = round(load * RobotsPlan().capacity(str(rows)))
                found = system.play(number, kind).success(curve)
                fleets.append({"robots": number, **asdict(found)})
                print(f"  {number} robots: {found}", flush=True)
        entries.append({"rows": rows, "system": name, "largest": largest, "fleets": fleets})
    return {
        "curves": {
            loop: None if curve is None else curve.to_json() for loop, curve in curves.items()
        },
        "systems": entries,
    }


@dataclass(frozen=True)
class SharedReplica:
    """A policy, and the robots that share it with other clients."""

    costs: CostCurve
    kinds: list[int]  # rows of a chunk, which the robots take in turn
    hz: float
    robots: int
    without_slack: int  # number of robots that declare nothing

    @classmethod
    def drawn(cls, seed: int) -> SharedReplica:
        """Draw a replica whose full batches take a part of the shortest chunk."""
        draw = random.Random(seed)
        kinds = draw.choice([[8], [50], [8, 50]])
        hz = draw.choice([5.0, 10.0, 20.0])
        full_s = min(kinds) / hz * math.exp(draw.uniform(math.log(0.03), 0.0))
        rows_part = draw.uniform(0.05, 1.0)  # share of a full batch that depends on its rows
        # A robot is in time alone.
        full_s *= min(1.0, 0.4 * min(kinds) / hz / (full_s * (1 - rows_part * (1 - 1 / LARGEST))))
        costs = CostCurve(full_s * (1 - rows_part), full_s * rows_part / LARGEST)

        replica = cls(costs, kinds, hz, 1, draw.choice([0, 0, 4, 16]))
        target = draw.uniform(0.05, 1.1)
        while replica.robots < 60:
            larger = replace(replica, robots=replica.robots + 1)
            if larger.load > target:
                break
            replica = larger
        return replica

    @cached_property
    def alone(self) -> RobotsLoad:
        """The load of the robots alone."""
        return robots_load(self.costs, self.needs(), LARGEST)

    @property
    def load(self) -> float:
        """The load of the robots alone, as a share of the largest usable load."""
        return self.alone.load / USABLE

    def needs(self) -> Counter[RobotNeed]:
        """Return the number of robots with each need."""
        rows = (self.kinds[index % len(self.kinds)] for index in range(self.robots))
        return Counter(RobotNeed(self.hz, number) for number in rows)

    def is_at_its_limit(self) -> bool:
        """Return whether robots are late now and then even without other clients: because there are
        many of them, or because two batches take nearly as long as a half of their chunks.
        """
        slowest_s = min(need.slowest_answer_s for need in self.needs())
        return self.load > 0.9 or self.alone.latency_s > slowest_s

    def run(self, seed: int, simulations: int = 0, *, with_others: bool = False) -> World:
        """Run the robots until each has executed some chunks, and count a minute of ticks."""
        robots = fleet(self.robots, *((rows, self.hz) for rows in self.kinds))
        if with_others:
            others = fleet(self.without_slack, *((rows, self.hz) for rows in self.kinds))
            for other in others:
                other.name, other.states_slack = f"other {other.name}", False
            robots += others
        world = World(self.costs, robots, seed=seed, simulations=simulations)
        world.measured_from = 4 * max(self.kinds) / self.hz + 2
        return world.run(world.measured_from + MEASURED_S)


@dataclass(frozen=True)
class Beside:
    """The robots of a shared replica, alone and beside other clients."""

    replica: SharedReplica
    lost: float  # largest share of ticks in time that a robot loses, from the worst run alone
    mean_lost: float  # mean share that the robots lose
    simulations_hz: float  # answers per second of all simulations
    least_others: float  # lowest share in time of the robots that declare nothing


def beside_others(seed: int, simulations: int = 16, *, with_others: bool) -> Beside:
    """Run the replica of a seed alone, with three random sequences, and beside other clients."""
    replica = SharedReplica.drawn(seed)
    alone = [replica.run(seed + 1000 * run).robots for run in range(3)]
    shared = replica.run(seed, simulations, with_others=with_others)
    robots, others = shared.robots[: replica.robots], shared.robots[replica.robots :]

    lost, mean_lost = [], 0.0
    for index, robot in enumerate(robots):
        shares = [before[index].share_in_time() for before in alone]
        lost.append(min(shares) - robot.share_in_time())
        mean_lost += sum(shares) / len(shares) - robot.share_in_time()

    answered = sum(simulation.answered for simulation in shared.simulations)
    least_others = min((other.share_in_time() for other in others), default=1.0)
    return Beside(replica, max(lost), mean_lost / len(robots), answered / shared.now, least_others)


def print_beside(first: int, seeds: int, with_others: bool) -> None:
    """Print the ticks that robots lose beside other clients, and the service of these."""
    print("seed robots  load  most lost, mean lost %  simulations/s  least of others %")
    for seed in range(first, first + seeds):
        beside = beside_others(seed, with_others=with_others)
        print(
            f"{seed:4} {beside.replica.robots:6} {beside.replica.load:5.2f} "
            f"{100 * beside.lost:10.2f} {100 * beside.mean_lost:10.2f} "
            f"{beside.simulations_hz:14.1f} {100 * beside.least_others:8.1f}",
            flush=True,
        )


def drawn(seed: int) -> World:
    """Return a random world of a few seconds: robots that obey and that do not, robots with false
    claims, simulations, and deadlines.
    """
    draw = random.Random(seed)
    robots = []
    for number in range(draw.choice([1, 3, 8, 20, 40])):
        robot = Robot(
            f"robot{number}",
            draw.choice([5.0, 10.0]),
            draw.choice([1, 8, 50]),
            states_slack=draw.random() < 0.7,
            lies=draw.random() < 0.1,
            obeys=draw.random() < 0.8,
            source=draw.choice(["", "", "cell"]),
        )
        robots.append(robot)
    return World(
        draw.choice([PI0, GRAPHS, SMALL]),
        robots,
        seed=seed,
        simulations=draw.choice([0, 0, 2, 20]),
        deadlines=draw.choice([0.0, 0.0, 0.3]),
    )


def play_drawn(seed: int) -> World:
    """Run the world of a seed; raise an `AssertionError` that names the seed if a check fails."""
    world = drawn(seed)
    try:
        world.run(3.0)
        world.check_all_answered()
    except AssertionError as error:
        raise AssertionError(
            f"seed {seed}: {error}\nagain: PYTHONPATH=tests/support python -m "
            f"tests.simulation.robots --first {seed} --seeds 1"
        ) from error
    return world


def main() -> None:
    """Run seeds, or print the largest fleets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=0, help="number of worlds to run")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument(
        "--fleets", action="store_true", help="print the largest fleets that are in time"
    )
    parser.add_argument(
        "--starts", action="store_true", help="print fleets whose robots all start at once"
    )
    parser.add_argument(
        "--beside", action="store_true", help="print what the robots of seeds lose beside others"
    )
    parser.add_argument(
        "--others", action="store_true", help="with --beside: also robots that send no slack"
    )
    parser.add_argument(
        "--successful", action="store_true", help="print the largest fleets of successful robots"
    )
    parser.add_argument(
        "--checkpoint",
        type=Path,
        default=CHECKPOINT,
        help="the checkpoint whose success is assumed",
    )
    parser.add_argument("--out", type=Path, help="with --successful: file for the figures, as JSON")
    options = parser.parse_args()
    if options.beside:
        print_beside(options.first, options.seeds, options.others)
        return
    if options.successful:
        found = successful(options.checkpoint)
        if options.out is not None:
            options.out.write_text(json.dumps(found, indent=1) + "\n")
        return

    began = time.monotonic()
    answered = 0
    for seed in range(options.first, options.first + options.seeds):
        answered += play_drawn(seed).answered
        if seed % 1000 == 999:
            print(f"{seed + 1} seeds, {time.monotonic() - began:.0f} s", flush=True)
    print(f"{options.seeds} seeds, {answered} answers")
    if options.starts:
        print_starts()
    if options.fleets:
        print_fleets()


if __name__ == "__main__":
    main()
