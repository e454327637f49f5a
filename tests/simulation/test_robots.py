"""Robots that share a policy in virtual time: properties that hold for every seed, and the number
of robots in time.

`PYTHONPATH=tests/support python -m tests.simulation.robots --seeds 100000` runs more seeds, and
`--fleets` prints the largest fleets.
"""

from __future__ import annotations

import math
from typing import Any

import pytest

from tests.simulation.robots import (
    GRAPHS,
    PI0,
    SMALL,
    SYSTEMS,
    WAYS,
    Robot,
    World,
    beside_others,
    fleet,
    play,
    play_drawn,
    start_at_once,
)
from vlagents_ray.serve.engine.metrics_buffer import MetricsBuffer
from vlagents_ray.serve.in_time import WINDOW_S, RobotReport, RobotTimes, tolerated_age_ms
from vlagents_ray.serve.queue.robots_load import CostCurve
from vlagents_ray.serve.requests import PendingRequest
from vlagents_ray.success import Solved, SuccessCurve


@pytest.mark.slow
def test_no_request_is_lost_and_none_overtakes_an_urgent_one() -> None:
    answered = sum(play_drawn(seed).answered for seed in range(300))
    assert answered > 300 * 20, "the worlds had too few answers for a judgement"


@pytest.mark.parametrize("costs", [PI0, GRAPHS, SMALL])
@pytest.mark.parametrize("rows", [1, 8, 50])
def test_a_lone_robot_is_answered_as_soon_with_slack_as_without(
    costs: CostCurve, rows: int
) -> None:
    worlds = [
        World(costs, [Robot("lone", 10.0, rows)], seed=1, slack=slack).run(20.0)
        for slack in (False, True)
    ]
    before, after = worlds
    assert after.answered == before.answered
    assert after.robots[0].ages == before.robots[0].ages


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "robots"),
    [([(50, 10.0)], 330), ([(50, 10.0), (8, 10.0)], 56), ([(50, 10.0), (1, 5.0)], 24)],
)
def test_slack_serves_a_third_more_robots_with_chunks_of_50(
    kinds: list[tuple[int, float]], robots: int
) -> None:
    """Each number is more than 1.3 times the largest fleet without slack."""
    assert play(PI0, robots, True, *kinds).share() >= 0.98
    assert play(PI0, round(robots / 1.3), False, *kinds).share() < 0.98


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "most", "gain"),
    [
        ([(8, 10.0)], 46, 1.15),
        ([(50, 10.0), (8, 10.0)], 83, 1.8),
        ([(50, 10.0)], 400, 1.6),
    ],
)
def test_slack_and_pace_serve_more_robots_than_slack_and_these_more_than_none(
    kinds: list[tuple[int, float]], most: int, gain: float
) -> None:
    """Neither is worth its code alone: without the pace, the order by slack breaks down as soon as
    the replica is full, and without a rule for too many robots, all of them are late.
    """
    assert play(PI0, most, True, *kinds).share() >= 0.98
    assert play(PI0, round(most / gain), False, *kinds).share() < 0.98

    for part in (0.7, 1.05, 1.25):
        number = round(part * most)
        no_slack, no_pace, both = (
            play(PI0, number, slack, *kinds, obeys=obeys).in_time()
            for slack, obeys in WAYS.values()
        )
        assert both >= max(no_slack, no_pace), part
        assert both >= 0.9 * min(number, most), part


@pytest.mark.slow
@pytest.mark.parametrize(
    ("costs", "kinds", "robots"),
    [
        (PI0, [(50, 10.0)], 400),
        (PI0, [(8, 10.0)], 40),
        (PI0, [(50, 10.0), (8, 10.0)], 72),
        (PI0, [(50, 10.0), (1, 5.0)], 26),
        (GRAPHS, [(50, 10.0)], 290),
        (GRAPHS, [(8, 10.0)], 28),
        (SMALL, [(50, 10.0)], 400),
    ],
)
def test_robots_that_begin_at_once_do_not_ask_at_once_for_ever(
    costs: CostCurve, kinds: list[tuple[int, float]], robots: int
) -> None:
    """The sizes are about nine tenths of the largest fleets."""
    for robot in start_at_once(costs, robots, True, *kinds).robots:
        assert robot.starved <= 0.02 * robot.ticks, robot.name


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [[(50, 10.0)], [(8, 10.0)], [(50, 10.0), (8, 10.0)]])
def test_at_half_load_no_action_is_older_for_it(kinds: list[tuple[int, float]]) -> None:
    half = {50: 120, 8: 16}[kinds[0][0]] if len(kinds) == 1 else 19
    before, after = (play(PI0, half, slack, *kinds) for slack in (False, True))
    assert after.age_p95_s() <= before.age_p95_s() + 1e-6
    assert after.share() == before.share() == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("with_others", [False, True])
def test_robots_lose_no_tick_to_other_clients(with_others: bool) -> None:
    """The share of a robot alone may differ from one run to the next. It is therefore compared with
    the lowest share of three runs. At the limit of a replica it differs by several points, so only
    the mean counts there.
    """
    for seed in range(25):
        beside = beside_others(seed, with_others=with_others)
        if beside.replica.is_at_its_limit():
            assert beside.mean_lost <= 0.02, seed
        else:
            assert beside.lost <= 0.01, seed
        assert beside.simulations_hz > 0, seed
        if beside.replica.load < 0.5 and beside.replica.robots > 16:
            assert beside.least_others > 0.8, seed


def test_a_robot_that_claims_to_have_no_slack_gains_nothing_over_today() -> None:
    ages_s = []
    for slack in (False, True):
        robots = fleet(100, (50, 10.0))
        robots[0].lies = True
        robots[0].obeys = False
        world = World(PI0, robots, seed=3, slack=slack)
        world.measured_from = 10.0
        world.run(40.0)
        assert world.share() == 1.0
        ages_s.append(sum(robots[1].ages) / len(robots[1].ages))
    assert ages_s[1] <= ages_s[0], "the other robots have no older actions because of it"


def test_the_needs_of_robots_are_read_from_their_requests() -> None:
    robots = fleet(200, (50, 10.0))
    world = World(PI0, robots, seed=4).run(30.0)
    needs = {robot.plan.need for robot in robots}
    assert all(need is not None and need.rows == 50 for need in needs)
    assert all(need is not None and abs(need.hz - 10.0) <= 1.0 for need in needs)
    assert world.queue.depth() <= 32, "robots must wait before they send, not in the queue"


@pytest.mark.slow
def test_robots_that_all_start_at_once_are_soon_in_time() -> None:
    world = World(PI0, fleet(400, (50, 10.0)), seed=1, begin_s=0.5)
    world.measured_from = 10.0
    assert world.run(60.0).share() >= 0.98


def test_robots_of_the_oldest_episodes_are_in_time_where_there_are_too_many() -> None:
    kinds = [(50, 10.0), (8, 10.0)]
    world = World(PI0, fleet(120, *kinds), seed=1)
    world.measured_from = 20.0
    world.run(60.0)
    first = [robot for robot in world.robots if not robot.plan.waits_behind_others]
    assert 0.7 * 96 <= len(first) < 96
    assert world.robots[:80] == first[:80], "the robots began in this order"
    assert sum(robot.starved <= 0.02 * robot.ticks for robot in first) >= 0.9 * len(first)
    assert min(robot.ticks - robot.starved for robot in world.robots) > 0, "each robot gets actions"


CURVE = SuccessCurve(
    "tabletop", 20.0, "async", {}, {0: Solved(500, 500, 25.0), 3: Solved(490, 500, 30.0)}
)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("rows", [8, 50])
def test_the_delay_of_an_answer_is_the_time_for_which_a_moving_robot_waits_for_it(
    name: str, rows: int
) -> None:
    """A lone robot is answered after one batch and two ways of the network: within one tick."""
    robot = SYSTEMS[name].play(1, (rows, 10.0)).robots[0]
    assert set(robot.delays) == {0 if SYSTEMS[name].stops else 1}
    assert all(0.41 < wait < 0.43 for wait in robot.waits)
    assert bool(robot.waits) == SYSTEMS[name].stops
    assert robot.starved == 0
    assert robot.served().is_successful(CURVE.tolerated)


def test_a_loop_waits_for_the_batches_before_its_own() -> None:
    costs = CostCurve(0.3, 0.0)
    robot = Robot("waits", 10.0, 8, stops=True)
    world = World(costs, [robot], jitter=0.0).run(30.0)
    # 0.3 s, and 4 ms of the network.
    assert {round(wait, 6) for wait in robot.waits} == {3.04}
    assert robot.ticks == 4 * len(robot.waits)
    assert robot.served().ticks == pytest.approx(7.04 * len(robot.waits))
    # A wait is chosen for three ticks, and 0.04 of 7.04 are less than 2 %.
    assert world.success(CURVE).successful == 1
    moving = 4 / 7.04
    assert world.success(CURVE).tasks_per_gpu_hour == pytest.approx(moving / 25 * 36_000)


@pytest.mark.parametrize("name", SYSTEMS)
@pytest.mark.parametrize("number", [3, 60])
def test_the_figures_of_a_fleet_are_those_of_a_direct_count(name: str, number: int) -> None:
    world = SYSTEMS[name].play(number, (8, 10.0))
    successful, tasks = 0, 0.0
    for robot in world.robots:
        executed = [delay for delay in robot.delays if delay < math.inf]
        within = sum(delay <= 3 for delay in executed)
        ticks = robot.ticks + sum(robot.waits)
        late = robot.starved + sum(wait - 3 for wait in robot.waits if wait > 3)
        if executed and within >= 0.98 * len(robot.delays) and late <= 0.02 * ticks:
            successful += 1
        moved = robot.ticks - robot.starved
        rates = [CURVE.tasks_per_hour(delay) / 2 for delay in executed]  # 10 Hz in place of 20
        tasks += moved / ticks * sum(rates) / len(rates) if rates else 0.0
    assert world.success(CURVE).successful == successful
    assert world.success(CURVE).tasks_per_gpu_hour == pytest.approx(tasks)


class ReportingWorld(World):
    """Robots that report the age of their last action in each request, as chunk players do, and a
    replica that counts these reports with its answers.
    """

    def begin(self, tolerated_age_ms: float | None) -> ReportingWorld:
        """Begin to count, with the largest age that the policy tolerates."""
        self.stats = MetricsBuffer()
        self.stats.enable()
        self.tolerated_age_ms = tolerated_age_ms
        self.times = {robot.name: RobotTimes() for robot in self.robots}
        self.asked = dict.fromkeys(self.times, 0)  # number of ages before the last request
        # Time of the answer, s, and reported age, ms.
        self.counted: dict[str, list[tuple[float, float]]] = {name: [] for name in self.times}
        return self

    def _ask(self, robot: Robot, *args: Any, **kwargs: Any) -> None:
        super()._ask(robot, *args, **kwargs)
        new_ages_s = robot.ages[self.asked[robot.name] :]
        self.asked[robot.name] = len(robot.ages)
        age_ms = 1e3 * new_ages_s[-1] if new_ages_s else None
        assert robot.waiting is not None
        robot.waiting.observer_data["report"] = RobotReport(len(new_ages_s), 0, age_ms)

    def _finish(self, batch: list[PendingRequest], took: float) -> None:
        for pending in batch:
            name, report = pending.session_id, pending.observer_data["report"]
            report = report.compared(self.tolerated_age_ms)
            self.stats.report("robot", report)
            self.times[name].add(report, self.now)
            if report.age_ms is not None:
                self.counted[name].append((self.now, report.age_ms))
        super()._finish(batch, took)


@pytest.mark.parametrize("stops", [False, True])
@pytest.mark.parametrize(("rows", "number"), [(8, 3), (8, 45), (8, 70), (50, 100)])
def test_the_share_within_the_tolerance_is_that_of_a_direct_count(
    rows: int, number: int, stops: bool
) -> None:
    curve = SuccessCurve(
        "e", 10.0, "async", {"execute": 4}, {0: Solved(500, 500, 25.0), 3: Solved(490, 500, 30.0)}
    )
    tolerated_ms = tolerated_age_ms([curve])
    assert tolerated_ms == 700
    robots = fleet(number, (rows, 10.0))
    for robot in robots:
        robot.stops = stops
    world = ReportingWorld(PI0, robots, seed=number).begin(tolerated_ms)
    world.run(25.0)

    ages_ms = [age_ms for counted in world.counted.values() for _, age_ms in counted]
    within = sum(age_ms <= tolerated_ms for age_ms in ages_ms)
    collected = world.stats.collect()
    assert (collected.compared["robot"], collected.tolerated["robot"]) == (len(ages_ms), within)
    for name, times in world.times.items():
        lately = [age for when, age in world.counted[name] if when > world.now - WINDOW_S]
        expected = sum(age <= tolerated_ms for age in lately) / len(lately) if lately else None
        assert times.within_tolerance(world.now) == expected


def test_without_a_curve_nothing_is_within_the_tolerance_or_beyond_it() -> None:
    assert tolerated_age_ms([]) is None
    world = ReportingWorld(PI0, fleet(3, (8, 10.0)), seed=1).begin(tolerated_age_ms([]))
    world.run(5.0)
    collected = world.stats.collect()
    assert collected.ages_ms
    assert not collected.compared
    assert not collected.tolerated
    assert {times.within_tolerance(world.now) for times in world.times.values()} == {None}
