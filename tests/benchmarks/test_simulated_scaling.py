"""The number of replicas follows the needs of robots, in virtual time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.simulated_scaling import (
    SimulatedFleet,
    burst,
    changes,
    seconds_late,
    simulate,
    slow_rise,
    square_wave,
)
from vlagents_ray.serve.config.deployment import AutoscalingArgs
from vlagents_ray.serve.fleet import CostCurve, RobotNeed, most_robots
from vlagents_ray.serve.scaling.slo_load import most_on_replica, slo_load

FLEET = SimulatedFleet()


def test_a_burst_gets_all_its_replicas_at_once_and_is_in_time_after_one_start() -> None:
    trace = simulate(burst, 600, FLEET)
    assert changes(trace) == [1, 3]
    # One second of delay, one until the next step of the simulation, and the start of the replicas.
    start_s = 2.0 + FLEET.start_s + FLEET.move_s
    assert seconds_late(trace) <= start_s
    assert all(step.missed == 0 for step in trace if step.at >= 60 + start_s)


def test_a_square_wave_of_load_keeps_its_replicas() -> None:
    trace = simulate(square_wave, 3600, FLEET)
    assert changes(trace) == [1, 2]
    assert all(step.missed == 0 for step in trace if step.at >= 240)


def test_a_slow_rise_misses_no_tick() -> None:
    trace = simulate(slow_rise, 1800, FLEET)
    assert changes(trace) == [1, 2, 3, 4]
    assert seconds_late(trace) == 0


@pytest.mark.slow
@pytest.mark.parametrize("robots", range(1, 40))
def test_any_steady_number_of_robots_has_a_steady_number_of_replicas(robots: int) -> None:
    scaling = AutoscalingArgs(downscale_delay_s=10.0, max_replicas=100)
    fleet = replace(FLEET, autoscaling=scaling)
    trace = simulate(lambda _: robots, 600, fleet)
    assert len(changes(trace)) <= 2
    assert trace[-1].missed == 0


def test_late_robots_get_one_more_replica_which_stays() -> None:
    """Robots may need more than they declare, for example when a policy has become slower."""
    fleet = replace(
        FLEET,
        autoscaling=AutoscalingArgs(downscale_delay_s=30.0, max_replicas=16),
        hidden_late=lambda replicas, robots: robots if replicas * 4 < robots else 0,
    )
    trace = simulate(lambda now: 6 if now < 1200 else 1, 2400, fleet)
    assert changes(trace) == [1, 2, 1]

    trace = simulate(lambda now: 0 if 600 <= now < 1200 else 6, 1800, fleet)
    assert changes(trace) == [1, 2, 1, 2]
    again = next(step.at for step in trace if step.at >= 1200 and step.requested == 2)
    assert again <= 1205, "the need for two replicas must be remembered while the robots are away"


@pytest.mark.slow
def test_robots_that_more_replicas_do_not_help_get_one_more_at_most() -> None:
    late_always = replace(FLEET, hidden_late=lambda _, robots: robots)
    assert changes(simulate(lambda _: 6, 3000, late_always)) == [1, 2]
    assert changes(simulate(lambda _: 1, 3000, late_always)) == [1], (
        "a robot needs only one replica"
    )


def test_the_load_of_robots_does_not_depend_on_where_they_are() -> None:
    need, fast = FLEET.need, RobotNeed(hz=10.0, rows=1)
    together = slo_load(FLEET.costs, {need: 6, fast: 3}, 16)
    apart = slo_load(FLEET.costs, {need: 6}, 16) + slo_load(FLEET.costs, {fast: 3}, 16)
    assert together == pytest.approx(apart)
    assert slo_load(FLEET.costs, {need: 7}, 16) == pytest.approx(0.9)
    assert slo_load(FLEET.costs, {RobotNeed(hz=1000.0): 2}, 16) == pytest.approx(1.8)
    assert slo_load(FLEET.costs, {}, 16) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("rows", [1, 8, 50])
@pytest.mark.parametrize("hz", [1.0, 5.0, 10.0, 30.0])
@pytest.mark.parametrize("age_s", [None, 0.1, 0.2, 0.5, 2.0])
@pytest.mark.parametrize("costs", [FLEET.costs, CostCurve(0.002, 0.0001), CostCurve(0.05, 0.04)])
def test_the_robots_of_a_full_replica_are_those_of_the_search(
    rows: int, hz: float, age_s: float | None, costs: CostCurve
) -> None:
    need = RobotNeed(hz, rows, age_s)
    assert most_on_replica(costs, need, 16) == most_robots(costs, need, 16)


def test_no_need_makes_the_load_slow_or_infinite() -> None:
    for hz in (5e-324, 1e-300, 1e300):
        assert 0 <= slo_load(FLEET.costs, {RobotNeed(hz, 1000): 1}, 16) <= 1
