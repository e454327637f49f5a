"""Robots that share one policy, in virtual time: the real queue, and the real pace of its replica.

`python -m tests.simulation.robots --seeds 100000` plays drawn worlds, and checks each; `python -m
tests.simulation.robots --fleets` prints the largest fleets in time, with the queue's use of slack
and without it.
"""

from __future__ import annotations

import argparse
import heapq
import itertools
import math
import random
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from in_flight import AnySession, message_of_one

from vlagents_ray.protocol.messages import Priority, Request
from vlagents_ray.serve.fleet import CostCurve, RobotNeed, most_robots
from vlagents_ray.serve.queue.batch_queue import BatchQueue
from vlagents_ray.serve.queue.fair_queue import PATIENCE_S
from vlagents_ray.serve.queue.replica_pace import ReplicaPace, RobotPlan
from vlagents_ray.serve.requests import Origin, PendingRequest

PI0 = CostCurve(0.0293, 0.00806)  # pi0 on an H200, compiled
GRAPHS = CostCurve(0.0415, 0.0105)
SMALL = CostCurve(0.004, 0.0005)
LARGEST = 16
WIRE_S = 0.002  # of a message, one way


class _NoFiles:
    """In place of what the queue's thread waits on."""

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
    states_slo: bool = True  # whether its rate is known from its reset on
    lies: bool = False  # whether it says that it is about to run out of rows
    obeys: bool = True  # whether it replans at the pace that it is told
    source: str = ""
    planned: int = -1  # the last tick that has a row
    began: float = math.inf  # tick of the first row
    captured: float = 0.0  # tick of the observation of its rows, s
    ticks: int = 0
    starved: int = 0
    held: int = 0  # ticks without a row, at which the plan waits with the robot
    last_starved: float = 0.0  # time of the last of them, s
    ages: list[float] = field(default_factory=list)
    waiting: PendingRequest | None = None
    waits_until: float = 0.0  # time before which a request is of no use, s
    round_trip_s: float = 0.0
    plan: RobotPlan = field(default_factory=RobotPlan)

    def __post_init__(self) -> None:
        if self.states_slo:
            self.plan = RobotPlan(RobotNeed(self.hz, self.rows), is_stated=True)


@dataclass
class Simulation:
    """An environment that sends its next observation a moment after each answer."""

    name: str
    answered: int = 0
    longest_s: float = 0.0


class World:
    """A policy, its queue, and those that use it."""

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
    ) -> None:
        self.begin_s = begin_s  # time within which robots begin; None: one round of their chunks
        self.draw = random.Random(seed)
        self.costs, self.slack = costs, slack
        self.deadlines, self.jitter = deadlines, jitter
        self.robots = list(robots)
        self.simulations = [Simulation(f"env{number}") for number in range(simulations)]
        self.now = 0.0
        self.measured_from = 0.0  # ticks before are not counted
        self.queue = BatchQueue(
            LARGEST,
            sessions=AnySession(),
            clock=lambda: self.now,
            poller=_NoFiles(),  # type: ignore[arg-type]
        )
        self.queue.bind(driven=True)
        self.pace = ReplicaPace(
            self.queue.window.curve,
            lambda: [robot.plan.need for robot in self.robots],
            LARGEST,
            lambda: self.now,
            self.queue.depth,
        )
        self.busy = False
        self.batches: list[int] = []
        self.sent = self.answered = self.expired = 0
        self._due: list[tuple[float, int, Callable[[], None]]] = []
        self._count = itertools.count()

    def at(self, when: float, call: Callable[[], None]) -> None:
        """Call something at that time."""
        heapq.heappush(self._due, (when, next(self._count), call))

    def run(self, seconds: float) -> World:
        """Play so long."""
        for robot in self.robots:
            round_s = max(1.0, robot.rows / robot.hz)
            phase = self.draw.random() * (round_s if self.begin_s is None else self.begin_s)
            self.at(phase, lambda robot=robot, phase=phase: self._tick(robot, phase, 0))
        for simulation in self.simulations:
            self.at(self.draw.random() * 0.1, lambda one=simulation: self._simulate(one))
        while self._due and self._due[0][0] <= seconds:
            self.now, _, call = heapq.heappop(self._due)
            call()
        return self

    def _tick(self, robot: Robot, phase: float, tick: int) -> None:
        period = 1 / robot.hz
        at = phase + tick * period
        if tick <= robot.planned:
            if self.now >= self.measured_from and robot.rows > 1:
                robot.ages.append(self.now - robot.captured)
            if self.now >= self.measured_from:
                robot.ticks += 1
        elif robot.planned < 0:
            robot.held += 1
        else:
            robot.held += 1
            robot.last_starved = self.now
            if self.now >= self.measured_from:
                robot.ticks += 1
                robot.starved += 1
        self.at(at + period, lambda: self._tick(robot, phase, tick + 1))

        slack_s = max(0.0, phase + (robot.planned + 1) * period - at) if robot.planned >= 0 else 0.0
        if robot.rows == 1:
            slack_s = period
        starves = slack_s < robot.round_trip_s + period
        if robot.waiting is not None or (self.now < robot.waits_until and not starves):
            return
        held = robot.held
        self._ask(robot, slack_s, at, lambda: self._receive(robot, tick - held, at))

    def _ask(self, robot: Robot, slack_s: float, at: float, done: Callable[[], None]) -> None:
        arrived = self.now + WIRE_S
        pending = PendingRequest(
            robot.name,
            Request("act"),
            message_of_one(),
            Priority.ROBOT,
            arrived,
            origin=Origin(connection=robot.source),
        )
        if robot.states_slack and self.slack:
            slack_s = 0.0 if robot.lies else max(0.0, slack_s - 2 * WIRE_S)
            pending.needed = arrived + slack_s
        if self.deadlines and self.draw.random() < self.deadlines:
            pending.deadline = arrived + self.draw.choice([0.05, 0.3, 2.0])
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
        costs_s = self.queue.window.costs_s
        pending.observer_data["patient"] = (
            pending.priority is Priority.ROBOT
            and bool(costs_s)
            and pending.needed > self.now + 2 * costs_s[-1]
        )
        self.queue.put(pending)
        if not self.busy:
            self._turn()

    def _turn(self) -> None:
        taken = self.queue.take()
        assert taken is not None
        for late in taken.expired:
            assert late.deadline < self.now, "a request was dropped that was of use"
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
        """What must be true of each batch."""
        assert len(batch) <= LARGEST
        assert len({pending.session_id for pending in batch}) == len(batch), (
            "two of pending session"
        )
        costs_s = self.queue.window.costs_s
        if not costs_s:
            return
        urgent_s = self.now + 2 * costs_s[-1]
        left = [
            pending
            for pending in self.queue._waiting.heads()
            if pending.priority is Priority.ROBOT
            and pending.needed <= urgent_s
            and not pending.over
            and pending.deadline >= self.now
        ]
        patient = [
            pending
            for pending in batch
            if pending.observer_data["patient"] and pending.needed > urgent_s
        ]
        assert not (left and patient), "an urgent request is behind pending that can wait"

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
            robot.plan.observe(robot.rows, pending.arrived, pending.needed)
            replan_s = 0.0
            if pending.needed and robot.plan.need is not None:
                replan_s = self.pace.replan_s(robot.plan.need, pending.arrived, pending.needed)
            arrives = self.now + WIRE_S
            # Without the wait in the queue, which is long only for those who have the time.
            robot.round_trip_s = 2 * WIRE_S + took
            self.at(
                arrives, lambda pending=pending, replan_s=replan_s: self._answer(pending, replan_s)
            )
        self._turn()

    def _answer(self, pending: PendingRequest, replan_s: float) -> None:
        robot: Robot = pending.observer_data["robot"]
        robot.waiting = None
        if robot.obeys:
            robot.waits_until = self.now + replan_s
        pending.observer_data["done"]()

    def _receive(self, robot: Robot, executed: int, at: float) -> None:
        """The rows of an answer: those of actions that were executed since its observation are
        skipped.
        """
        tick = executed + robot.held
        if robot.rows == 1:
            tick += 1
            robot.ages.append(self.now - at)
        last = tick + robot.rows - 1
        if last > robot.planned:
            robot.planned, robot.captured = last, at

    def check_all_answered(self) -> None:
        """Nothing is lost, and no simulation waits for ever."""
        under_way = sum(robot.waiting is not None for robot in self.robots)
        under_way += len(self.simulations) if self.now > 0.2 else 0
        missing = self.sent - self.answered - self.expired
        assert 0 <= missing <= under_way, f"{missing} requests without an answer, {under_way} sent"

        # Each second batch has a slot for a simulation that has waited for long.
        longest_batch_s = self.costs.cost_s(LARGEST) * (1 + self.jitter)
        bound_s = PATIENCE_S + 2 * (len(self.simulations) + 1) * longest_batch_s
        for simulation in self.simulations:
            assert simulation.longest_s <= bound_s, f"{simulation.name} waited for too long"

    def share(self) -> float:
        """The lowest share in time of a robot."""
        return min(
            (1 - robot.starved / robot.ticks if robot.ticks else 0.0) for robot in self.robots
        )

    def mean_share(self) -> float:
        """The share in time of all robots together."""
        ticks = sum(robot.ticks for robot in self.robots)
        return 1 - sum(robot.starved for robot in self.robots) / max(1, ticks)

    def age_p95_s(self) -> float:
        """Of executed actions."""
        ages = sorted(age for robot in self.robots for age in robot.ages)
        return ages[int(0.95 * len(ages))] if ages else math.nan


def fleet(number: int, *kinds: tuple[int, float]) -> list[Robot]:
    """So many robots, of each kind (rows, hz) in turns."""
    return [
        Robot(f"robot{index}", kinds[index % len(kinds)][1], kinds[index % len(kinds)][0])
        for index in range(number)
    ]


def play(costs: CostCurve, number: int, slack: bool, *kinds: tuple[int, float]) -> World:
    """A fleet, long enough to have settled."""
    longest_s = max(rows / hz for rows, hz in kinds)
    world = World(costs, fleet(number, *kinds), seed=number, slack=slack)
    world.measured_from = 4 * longest_s + 2
    return world.run(world.measured_from + 6 * longest_s + 4)


def largest(costs: CostCurve, slack: bool, *kinds: tuple[int, float]) -> int:
    """The largest fleet of which 98 % of all robots' ticks have an action."""

    def fits(number: int) -> bool:
        return play(costs, number, slack, *kinds).share() >= 0.98

    low, high = 0, 2
    while fits(high):
        low, high = high, 2 * high
    while high - low > max(1, low // 100):
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def start_at_once(costs: CostCurve, number: int, slack: bool, *kinds: tuple[int, float]) -> World:
    """A fleet whose robots all begin within 0.1 s, for a minute."""
    robots = fleet(number, *kinds)
    return World(costs, robots, seed=number, slack=slack, begin_s=0.1).run(60.0)


def print_starts() -> None:
    """Print what robots miss that all begin at once."""
    print("robots  rows     slack  starved s a robot (mean, most)  s until none is starved")
    for kinds, numbers in (
        (((50, 10.0),), (64, 128, 192, 256, 320, 400)),
        (((8, 10.0),), (16, 32, 40)),
        (((50, 10.0), (8, 10.0)), (48, 64, 80, 96)),
    ):
        rows = ",".join(str(rows) for rows, _ in kinds)
        for number, slack in itertools.product(numbers, (False, True)):
            robots = start_at_once(PI0, number, slack, *kinds).robots
            starved_s = [robot.starved / robot.hz for robot in robots]
            last_s = max(robot.last_starved for robot in robots)
            in_time = sum(robot.starved <= 0.02 * robot.ticks for robot in robots)
            print(
                f"{number:6}  {rows:8} {slack!s:6} {sum(starved_s) / number:6.2f} "
                f"{max(starved_s):6.2f}  {last_s:6.1f}  {in_time} with 98 % of a minute",
                flush=True,
            )


def print_fleets() -> None:
    """Print the largest fleets in time and the age of actions at half load."""
    print("costs  fleet              arithmetic  today  slack  ratio  age p95 at half: today slack")
    fleets = {
        "50 rows": [(50, 10.0)],
        "8 rows": [(8, 10.0)],
        "50 and 8 rows": [(50, 10.0), (8, 10.0)],
        "50 and 1 row": [(50, 10.0), (1, 5.0)],
        "1 row at 5 Hz": [(1, 5.0)],
    }
    for label, costs in (("pi0", PI0), ("graphs", GRAPHS)):
        for name, kinds in fleets.items():
            needs = [RobotNeed(hz, rows) for rows, hz in kinds]
            bound: float = most_robots(costs, needs[0], LARGEST) if len(needs) == 1 else math.nan
            before, after = (largest(costs, slack, *kinds) for slack in (False, True))
            ages = [
                play(costs, max(1, before // 2), slack, *kinds).age_p95_s()
                for slack in (False, True)
            ]
            print(
                f"{label:6} {name:18} {bound:10} {before:6} {after:6} {after / max(1, before):6.2f}"
                f"  {ages[0]:.3f} {ages[1]:.3f} s",
                flush=True,
            )


def drawn(seed: int) -> World:
    """A world of a few seconds: robots that obey and that do not, liars, simulations, deadlines."""
    draw = random.Random(seed)
    robots = []
    for number in range(draw.choice([1, 3, 8, 20, 40])):
        robot = Robot(
            f"robot{number}",
            draw.choice([5.0, 10.0]),
            draw.choice([1, 8, 50]),
            states_slack=draw.random() < 0.7,
            states_slo=draw.random() < 0.5,
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
    """Play the world of a seed; what is wrong with it is an `AssertionError` that names the seed."""
    world = drawn(seed)
    try:
        world.run(3.0)
        world.check_all_answered()
    except AssertionError as error:
        raise AssertionError(
            f"seed {seed}: {error}\nagain: python -m tests.simulation.robots --first {seed} "
            "--seeds 1"
        ) from error
    return world


def main() -> None:
    """Play seeds, or print the largest fleets."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=0, help="number of worlds to play")
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--fleets", action="store_true", help="print the largest fleets in time")
    parser.add_argument("--starts", action="store_true", help="print starts of all robots at once")
    options = parser.parse_args()

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
