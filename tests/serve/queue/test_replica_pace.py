"""The pace of a replica's robots, and the robots that it serves first."""

from __future__ import annotations

import pytest

from vlagents_ray.serve.queue.replica_pace import ReplicaPace, RobotPlan
from vlagents_ray.serve.queue.robots_load import (
    USABLE,
    CostCurve,
    RobotNeed,
    Room,
    robots_load,
)

PI0 = CostCurve(0.0293, 0.00806)  # pi0 on an H200, compiled
OF_50, OF_8 = RobotNeed(10.0, 50), RobotNeed(10.0, 8)


class Queue:
    """The queue of a replica whose batches take as long as those of π0."""

    def __init__(self) -> None:
        self.largest = 16
        self.room: Room | None = None
        self.waiting = 0
        self.others = False

    def had_others(self) -> bool:
        return self.others

    def curve(self) -> CostCurve:
        return PI0

    def depth_first(self) -> int:
        return self.waiting


class Robots:
    """The robots of a replica, and their simulated clock."""

    def __init__(self, *plans: RobotPlan) -> None:
        self.plans = list(plans)
        self.now = 100.0
        self.requests: list[RobotPlan] = []  # plans of robots whose requests wait
        self.queue = Queue()
        self.pace = ReplicaPace(self.queue, self._plans, lambda: self.now)

    def _plans(self) -> list[tuple[RobotPlan, bool]]:
        waiting = {id(plan) for plan in self.requests}
        return [(plan, id(plan) in waiting) for plan in self.plans]

    def read(self) -> list[bool]:
        """Let the pace read the plans again, and return whether each robot waits behind others."""
        self.now += 1.0
        self.pace.load()
        return [plan.waits_behind_others for plan in self.plans]


def plans(need: RobotNeed, number: int, began: float = 0.0) -> list[RobotPlan]:
    """Return the plans of robots whose episodes began one after the other."""
    return [RobotPlan(need, began=began + index) for index in range(number)]


def test_no_robot_waits_behind_others_where_there_is_room() -> None:
    robots = Robots(*plans(OF_50, 40))
    assert robots.read() == [False] * 40
    assert robots.pace.needed() == robots_load(PI0, {OF_50: 40}, 16).load < 0.2


def test_the_oldest_episodes_come_first_where_there_is_no_room() -> None:
    newest, oldest = plans(OF_50, 200, began=1000.0), plans(OF_50, 400)
    robots = Robots(*newest, *oldest)
    waits = robots.read()
    first = waits.count(False)
    assert waits == [False] * (first - 400) + [True] * (600 - first) + [False] * 400
    assert robots_load(PI0, {OF_50: first}, 16).in_time
    assert not robots_load(PI0, {OF_50: first + 1}, 16).in_time
    assert robots.pace.needed() == 1.0


def test_a_robot_comes_first_when_another_one_has_left() -> None:
    robots = Robots(*plans(OF_50, 600))
    first = robots.read().count(False)
    del robots.plans[:100]
    assert robots.read().count(False) == first


def test_batches_are_not_filled_so_far_that_the_first_robots_are_late() -> None:
    robots = Robots(*plans(OF_8, 30))
    robots.plans += plans(OF_8, 40, began=100.0)
    first = robots.read().count(False)
    size = robots_load(PI0, {OF_8: first}, 16).batch_size
    assert robots.queue.room is not None
    assert robots.queue.room.displaced == size < 16


@pytest.mark.parametrize("need", [OF_8, OF_50, RobotNeed(10.0, 4), RobotNeed(10.0, 1)])
@pytest.mark.parametrize("number", [1, 4, 16, 30, 300])
def test_other_clients_get_the_room_in_which_robots_are_in_time(
    need: RobotNeed, number: int
) -> None:
    robots = Robots(*plans(need, number))
    first = robots.read().count(False)
    room = robots.queue.room
    assert room is not None
    assert 0 <= room.alone <= room.beside <= 16
    if room.alone:
        assert 2 * PI0.cost_s(room.alone) <= need.longest_s
        assert first / need.longest_s * PI0.cost_s(room.alone) / room.alone < USABLE
    elif room.beside:
        assert number == 1
        assert PI0.cost_s(room.beside) <= need.longest_s
    if number == 1:
        assert room.beside > 0, "a lone robot shares its batches"


def test_the_pace_beside_other_clients_allows_for_their_larger_batches() -> None:
    latencies_s = []
    for others in (False, True):
        robots = Robots(*plans(OF_8, 2))
        robots.queue.others = others
        robots.read()
        latencies_s.append(robots.pace.load().latency_s)
    alone_s, beside_s = latencies_s
    assert beside_s > alone_s


@pytest.mark.parametrize("greedy", [RobotNeed(100.0, 1), RobotNeed(1000.0, 80)])
def test_a_robot_that_cannot_be_in_time_takes_no_share_of_the_others(greedy: RobotNeed) -> None:
    robots = Robots(*plans(greedy, 50), *plans(OF_50, 400, began=100.0))
    assert not any(robots.read())
    assert robots.pace.load().in_time


def test_a_robot_that_held_still_executes_its_plan_from_the_answer_on() -> None:
    plan = RobotPlan(OF_50)
    plan.observe(50, arrived=10.0, needed=10.0, now=14.0)
    assert plan.begins == 14.0
    plan.observe(50, arrived=20.0, needed=21.0, now=24.0)
    assert plan.begins == 23.0
    plan.observe(50, arrived=30.0, needed=33.0, now=30.2)
    assert plan.begins == 30.0


def test_a_robot_that_held_still_is_told_to_ask_before_its_rows_run_out() -> None:
    robots = Robots(*plans(OF_50, 300))
    held, other, *_ = robots.plans
    held.observe(50, arrived=robots.now - 4.0, needed=robots.now - 4.0, now=robots.now)
    late_s = robots.pace.replan_s(held)
    other.observe(50, arrived=robots.now - 0.2, needed=robots.now + 1.0, now=robots.now)
    usual_s = robots.pace.replan_s(other)
    assert usual_s + 0.2 <= late_s < 5.0 - 2 * PI0.cost_s(16)


def test_a_robot_whose_rate_is_unknown_waits_until_the_others_are_answered() -> None:
    plan = RobotPlan()
    robots = Robots(plan)
    plan.observe(50, arrived=robots.now, needed=robots.now, now=robots.now)
    assert robots.pace.replan_s(plan) == 0.0
    robots.queue.waiting = 160
    assert robots.pace.replan_s(plan) == pytest.approx(10 * PI0.cost_s(16))


def test_two_robots_whose_rates_are_unknown_keep_their_distance() -> None:
    first, second = RobotPlan(), RobotPlan()
    robots = Robots(first, second)
    for plan in robots.plans:
        plan.observe(50, arrived=robots.now - 0.5, needed=robots.now, now=robots.now)
    assert robots.pace.replan_s(second) == pytest.approx(0.5)


def test_two_robots_whose_rates_are_known_have_a_pace() -> None:
    robots = Robots(*plans(OF_50, 2))
    plan = robots.plans[0]
    for needed_s in (0.0, 1.0):
        plan.observe(50, robots.now, robots.now + needed_s, robots.now + 0.1)
    assert robots.pace.replan_s(plan) > 0.0
    del robots.plans[1]
    robots.read()
    assert robots.pace.replan_s(plan) == 0.0


def test_the_rate_of_a_robot_is_that_of_its_rows_although_it_held_still() -> None:
    plan = RobotPlan()
    plan.observe(50, arrived=10.0, needed=10.0, now=14.0)
    plan.observe(50, arrived=14.1, needed=19.0, now=14.3)
    assert plan.need == OF_50


def test_a_robot_that_waits_behind_others_asks_when_its_rows_have_run_out() -> None:
    robots = Robots(*plans(OF_50, 600))
    robots.read()
    last = robots.plans[-1]
    last.observe(50, arrived=robots.now - 3.0, needed=robots.now - 3.0, now=robots.now)
    assert robots.pace.replan_s(last) == pytest.approx(5.0 - 0.05)


def test_robots_that_have_gone_without_a_word_or_are_paused_do_not_count() -> None:
    gone, here = plans(OF_50, 600), plans(OF_50, 300, began=1000.0)
    robots = Robots(*gone, *here)
    for plan in gone:
        plan.heard = plan.asked = robots.now
    assert True in robots.read()

    robots.now += 20.0
    robots.read()
    assert not any(plan.waits_behind_others for plan in here)
    assert robots.pace.load().load == robots_load(PI0, {OF_50: 300}, 16).load < USABLE
    assert not any(plan.waits_behind_others for plan in gone), "a robot that continues is first"


def test_a_robot_whose_request_waits_behind_others_still_counts() -> None:
    robots = Robots(*plans(OF_50, 600))
    robots.read()
    for plan in robots.plans:
        plan.heard = robots.now
    robots.now += 30.0
    for plan in robots.plans:
        if plan.waits_behind_others:
            robots.requests.append(plan)
        else:
            plan.heard = robots.now
    waits = robots.read()
    assert waits.count(True) > 150
    assert waits == sorted(waits)


def test_nothing_remains_of_a_fleet_that_was_too_large() -> None:
    robots = Robots(*plans(OF_50, 600))
    robots.read()
    robots.plans = [RobotPlan(began=1000.0)]
    robots.read()
    assert (robots.pace.needed(), robots.queue.room) == (0.0, None)


def test_the_room_of_robots_that_have_left_is_free_after_the_next_batch() -> None:
    robots = Robots(*plans(OF_8, 30))
    robots.read()
    assert robots.queue.room is not None
    robots.plans = []
    robots.now += 1.0
    robots.pace.load()
    assert robots.queue.room is None
