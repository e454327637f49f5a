"""The pace of a replica's robots, and the robots that the replica admits."""

from __future__ import annotations

import math

import pytest

from vlagents_ray.serve.fleet import USABLE, CostCurve, RobotNeed, replica_load
from vlagents_ray.serve.queue.replica_pace import ReplicaPace, RobotPlan

PI0 = CostCurve(0.0293, 0.00806)  # pi0 on an H200, compiled
OF_50, OF_8 = RobotNeed(10.0, 50), RobotNeed(10.0, 8)


class Robots:
    """The robots of a replica, and their simulated clock."""

    def __init__(self, *plans: RobotPlan) -> None:
        self.plans = list(plans)
        self.now = 100.0
        self.waiting = 0
        self.pace = ReplicaPace(
            lambda: PI0, lambda: self.plans, 16, lambda: self.now, lambda: self.waiting
        )

    def read(self) -> list[bool | None]:
        """Let the pace read the plans again, and return the admitted robots."""
        self.now += 1.0
        self.pace.load()
        return [plan.is_admitted for plan in self.plans]


def stated(need: RobotNeed, number: int = 1, key: str = "") -> list[RobotPlan]:
    return [RobotPlan(need, is_stated=True, key=key) for _ in range(number)]


def test_all_robots_are_admitted_where_there_is_room() -> None:
    robots = Robots(*stated(OF_50, 40))
    assert robots.read() == [True] * 40


def test_the_oldest_robots_are_admitted_where_there_is_no_room() -> None:
    robots = Robots(*stated(OF_50, 600))
    admitted = robots.read()
    number = admitted.count(True)
    assert admitted == [True] * number + [False] * (600 - number)
    load = replica_load(PI0, {OF_50: number}, 16).load
    assert 0.95 * USABLE < load < USABLE, (
        "some capacity stays free, so that no robot is admitted and removed in turn"
    )


def test_a_robot_that_needs_less_is_admitted_beside_others_that_need_too_much() -> None:
    plans = [*stated(OF_8, 70), *stated(RobotNeed(1.0, 50), 1)]
    admitted = Robots(*plans).read()
    assert False in admitted
    assert admitted[-1] is True


def test_a_robot_that_is_admitted_stays_so_when_others_come() -> None:
    robots = Robots(*stated(OF_50, 400))
    assert robots.read() == [True] * 400
    robots.plans = [*stated(OF_50, 300), *robots.plans]
    assert robots.read()[300:] == [True] * 400


def test_a_robot_is_admitted_when_another_one_has_left() -> None:
    robots = Robots(*stated(OF_50, 600))
    number = robots.read().count(True)
    del robots.plans[:100]
    assert robots.read().count(True) == number


def test_batches_are_not_filled_so_far_that_admitted_robots_are_late() -> None:
    robots = Robots(*stated(OF_8, 30))
    robots.read()
    assert robots.pace.most_with_others == math.inf
    robots.plans += stated(OF_8, 40)
    admitted = robots.read().count(True)
    size = replica_load(PI0, {OF_8: admitted}, 16).batch_size
    assert robots.pace.most_with_others == size < 16


def test_a_reset_is_answered_by_the_robots_that_are_admitted() -> None:
    robots = Robots(*stated(OF_50, 600))
    robots.read()
    assert robots.pace.check(OF_50)["in_time"] is False
    del robots.plans[:300]
    assert robots.pace.check(OF_50)["in_time"] is True, "robots that are already late do not count"


def test_a_robot_that_held_still_executes_its_plan_from_the_answer_on() -> None:
    plan = RobotPlan(OF_50, is_stated=True)
    plan.observe(50, arrived=10.0, needed=10.0, now=14.0)
    assert plan.begins == 14.0
    plan.observe(50, arrived=20.0, needed=21.0, now=24.0)
    assert plan.begins == 23.0
    plan.observe(50, arrived=30.0, needed=33.0, now=30.2)
    assert plan.begins == 30.0


def test_a_robot_that_held_still_is_told_to_ask_before_its_rows_run_out() -> None:
    plans = stated(OF_50, 300)
    robots = Robots(*plans)
    plans[0].observe(50, arrived=robots.now - 4.0, needed=robots.now - 4.0, now=robots.now)
    late_s = robots.pace.replan_s(plans[0])
    plans[1].observe(50, arrived=robots.now - 0.2, needed=robots.now + 1.0, now=robots.now)
    usual_s = robots.pace.replan_s(plans[1])
    assert usual_s + 0.2 <= late_s < 5.0 - 2 * PI0.cost_s(16)


def test_a_robot_whose_rate_is_unknown_waits_until_the_others_are_answered() -> None:
    plan = RobotPlan()
    robots = Robots(plan)
    plan.observe(50, arrived=robots.now, needed=robots.now, now=robots.now)
    assert robots.pace.replan_s(plan) == 0.0
    robots.waiting = 160
    assert robots.pace.replan_s(plan) == pytest.approx(10 * PI0.cost_s(16))


def test_the_rate_of_a_robot_is_that_of_its_rows_although_it_held_still() -> None:
    plan = RobotPlan()
    plan.observe(50, arrived=10.0, needed=10.0, now=14.0)
    plan.observe(50, arrived=14.1, needed=19.0, now=14.3)
    assert plan.need == OF_50


def test_a_robot_that_is_not_admitted_asks_when_its_rows_have_run_out() -> None:
    robots = Robots(*stated(OF_50, 600))
    robots.read()
    last = robots.plans[-1]
    last.observe(50, arrived=robots.now - 3.0, needed=robots.now - 3.0, now=robots.now)
    assert robots.pace.replan_s(last) == pytest.approx(5.0 - 0.05)


@pytest.mark.parametrize("hog", [OF_50, OF_8, RobotNeed(10.0, 1), RobotNeed(1.0, 1)])
@pytest.mark.parametrize("first", [True, False])
def test_the_robots_of_one_key_do_not_make_those_of_another_wait(
    hog: RobotNeed, first: bool
) -> None:
    """A key's share does not depend on the number of the other key's robots, on their declared
    needs, or on the order of arrival.
    """
    theirs, ours = stated(hog, 2000, "hog/"), stated(OF_8, 8, "lab/")
    robots = Robots(*theirs)
    robots.read()
    assert robots.pace.check(OF_8, "lab/")["in_time"] is True
    assert robots.pace.check(hog, "hog/")["in_time"] is False

    robots.plans = [*ours, *theirs] if first else [*theirs, *ours]
    for _ in range(3):
        robots.read()
        assert all(plan.is_admitted for plan in ours)
    admitted = sum(plan.is_admitted is True for plan in theirs)
    servable = hog.interval_s(2 * PI0.cost_s(1)) > 0
    assert (0 < admitted < 2000) if servable else admitted == 0, "they get the remaining capacity"


def test_what_one_key_does_not_need_is_for_the_others() -> None:
    alone = Robots(*stated(OF_50, 600, "hog/"))
    number = alone.read().count(True)
    beside = Robots(*stated(OF_50, 600, "hog/"), *stated(OF_50, 10, "lab/"))
    assert abs(beside.read().count(True) - number) <= 1


def test_robots_that_have_gone_without_a_word_or_are_paused_do_not_count() -> None:
    gone, here = stated(OF_50, 600), stated(OF_50, 300)
    robots = Robots(*gone, *here)
    for plan in gone:
        plan.heard = robots.now
    assert False in robots.read()

    robots.now += 20.0
    robots.read()
    assert all(plan.is_admitted for plan in here)
    assert robots.pace.load().in_time

    gone[0].heard = robots.now  # this robot continues
    robots.read()
    assert gone[0].is_admitted
    assert {plan.is_admitted for plan in gone[1:]} == {None}
