"""Tests that the simulation of a fleet follows the rules of the chunk player and of the queue."""

from __future__ import annotations

import time

import pytest

from vlagents_ray.serve.fleet import CostCurve, RobotNeed
from vlagents_ray_fleet.simulation import Behaviour, Tally, World, starved_streams

EXACT = Behaviour(jitter=0.0, transport_jitter_s=0.0)
AT_WILL = Behaviour(jitter=0.0, transport_jitter_s=0.0, replan=False)


def lone(need: RobotNeed, costs: CostCurve, behaviour: Behaviour = EXACT) -> tuple[World, Tally]:
    """Simulate a single robot at a replica for 60 s, and return the world and the counts of
    ticks.
    """
    world = World(behaviour=behaviour, transport_s=0.0)
    world.add_replica("model", costs, 16)
    tally = Tally()
    world.add_stream("model", need, 0.0, 0.0, tally)
    world.run(60.0)
    world.finish()
    return world, tally


def test_a_robot_that_asks_at_will_replans_at_each_tick_within_an_answer() -> None:
    world, tally = lone(RobotNeed(10.0, 50), CostCurve(0.25), AT_WILL)
    assert tally.starved == 0
    # An answer that takes 250 ms is available at the third tick, and its rows are executed for
    # three ticks.
    assert tally.age_s(0.999) == pytest.approx(0.5, abs=0.002)
    [replica] = world.replicas["model"]
    assert replica.requests == pytest.approx(60 / 0.3, abs=2)


def test_robots_that_obey_the_server_have_fresher_actions_and_do_not_starve() -> None:
    ages_s, requests = [], []
    for behaviour in (AT_WILL, EXACT):
        world = World(behaviour=behaviour)
        replica = world.add_replica("model", CostCurve(0.0293, 0.00806), 16)
        tally = Tally()
        for index in range(120):
            world.add_stream("model", RobotNeed(10.0, 50), 0.005, index / 24, tally)
        world.run(60.0)
        world.finish()
        assert tally.starved == 0
        ages_s.append(tally.age_s(0.5))
        requests.append(replica.requests)
    assert ages_s[1] < 0.7 * ages_s[0]
    assert requests[1] < requests[0]


def test_single_actions_need_an_answer_within_a_tick() -> None:
    _, in_time = lone(RobotNeed(10.0, 1), CostCurve(0.09))
    assert in_time.share == 1.0
    _, late = lone(RobotNeed(10.0, 1), CostCurve(0.11))
    assert late.share == pytest.approx(0.5, abs=0.01)


def test_a_robot_without_rows_holds_still_with_its_plan() -> None:
    # An answer takes 1.5 s, and has rows for one second. A request that is sent when a plan begins
    # is answered too late, except for its last row. A robot without a plan executes all rows of its
    # answer.
    _, tally = lone(RobotNeed(10.0, 10), CostCurve(1.5))
    cycle_ticks = 15 + 15
    assert tally.share == pytest.approx(11 / cycle_ticks, abs=0.05)


def test_a_batch_has_the_waiting_robots_and_takes_the_time_of_its_size() -> None:
    world = World(behaviour=AT_WILL, transport_s=0.0)
    world.add_replica("model", CostCurve(0.03, 0.01), 4)
    for index in range(40):
        world.add_stream("model", RobotNeed(10.0, 50), 0.0, index / 300, Tally())
    world.run(30.0)
    [replica] = world.replicas["model"]
    assert replica.requests / replica.batches == pytest.approx(4, abs=0.2)
    assert replica.busy_s <= 30.1


def test_ticks_and_ages_are_counted_by_second() -> None:
    tally = Tally()
    tally.add(0.5, 10, 0.1, 0.2)
    tally.add(1.5, 5, 0.1, -1.0)
    in_time, starved = tally.by_second()
    assert list(in_time[:3]) == [5, 5, 0]
    assert list(starved[:3]) == [0, 5, 0]
    assert tally.share == pytest.approx(10 / 15)
    assert tally.age_s(1.0) == pytest.approx(1.1, abs=0.002)


@pytest.mark.parametrize("least_loaded", [True, False])
def test_robots_of_a_lost_replica_continue_at_another_one(least_loaded: bool) -> None:
    world = World(behaviour=EXACT, least_loaded=least_loaded)
    replicas = [world.add_replica("model", CostCurve(0.02, 0.002), 16, node) for node in range(3)]
    streams = [
        world.add_stream("model", RobotNeed(10.0, 20), 0.005, index / 50, Tally())
        for index in range(30)
    ]
    world.run(10.0)
    before = [stream.asks for stream in streams]
    replicas[0].fail(0.5)
    world.run(30.0)
    world.finish()
    assert all(stream.asks > asks + 5 for stream, asks in zip(streams, before, strict=True))
    assert replicas[0].sessions == 0
    assert sum(replica.sessions for replica in replicas) == 30
    assert starved_streams(streams, 0.95) == []


def test_a_replica_that_leaves_hands_over_its_robots_after_their_answers() -> None:
    world = World(behaviour=EXACT)
    replicas = [world.add_replica("model", CostCurve(0.02, 0.002), 16) for _ in range(2)]
    streams = [
        world.add_stream("model", RobotNeed(10.0, 20), 0.005, index / 20, Tally())
        for index in range(10)
    ]
    world.run(5.0)
    replicas[0].accepts = False
    world.run(15.0)
    assert replicas[0].sessions == 0
    assert replicas[1].sessions == 10
    assert sum(stream.starved for stream in streams) == 0


def test_a_replica_that_joins_gets_its_share_of_the_robots() -> None:
    world = World(behaviour=EXACT)
    world.add_replica("model", CostCurve(0.02, 0.002), 16)
    streams = [
        world.add_stream("model", RobotNeed(10.0, 20), 0.005, index / 20, Tally())
        for index in range(20)
    ]
    world.at(0.0, world.compare, "model", 0)
    world.run(4.0)
    newcomer = world.add_replica("model", CostCurve(0.02, 0.002), 16)
    world.run(15.0)
    assert newcomer.sessions == 10
    assert sum(stream.starved for stream in streams) == 0


def test_a_robot_notices_a_lost_machine_later_than_an_ended_connection() -> None:
    starved = []
    for detected_s in (0.1, 3.0):
        world = World(behaviour=EXACT)
        replicas = [world.add_replica("model", CostCurve(0.02), 16) for _ in range(2)]
        stream = world.add_stream("model", RobotNeed(10.0, 8), 0.005, 0.0, Tally())
        world.run(5.0)
        replicas[0].fail(detected_s)
        world.run(15.0)
        world.finish()
        starved.append(stream.starved)
    assert starved[0] == 0
    assert starved[1] == pytest.approx(10 * 3.0 - 8, abs=4)


@pytest.mark.slow
def test_a_hundred_thousand_requests_take_seconds() -> None:
    world = World()
    for _ in range(40):
        world.add_replica("model", CostCurve(0.0293, 0.00806), 16)
    for index in range(1000):
        world.add_stream("model", RobotNeed(10.0, 50), 0.005, index / 200, Tally())
    began = time.process_time()
    world.run(20.0)
    requests = sum(replica.requests for replica in world.replicas["model"])
    seconds = time.process_time() - began
    assert requests > 10_000
    assert requests / seconds > 10_000
