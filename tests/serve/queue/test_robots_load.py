"""The calculation of how many robots a replica serves in time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.queue.robots_load import (
    IDLE,
    USABLE,
    CostCurve,
    RobotNeed,
    answer_s,
    robots_load,
)

PI0 = CostCurve(0.0293, 0.00806)  # pi0 on an H200, compiled
CHUNKS_OF_50 = RobotNeed(10.0, 50)

costs = st.builds(CostCurve, st.floats(1e-3, 0.2), st.floats(1e-4, 0.05))
needs = st.builds(
    RobotNeed,
    st.sampled_from([1.0, 5.0, 10.0, 50.0]),
    st.sampled_from([1, 8, 16, 50]),
)


def test_a_line_and_its_table_cost_the_same() -> None:
    table = CostCurve(table=tuple((rows, PI0.cost_s(rows)) for rows in (1, 4, 16)))
    for rows in (1, 2, 4, 9, 16, 32):
        assert table.cost_s(rows) == pytest.approx(PI0.cost_s(rows))


def test_a_table_is_not_extended_below_its_smallest_size() -> None:
    assert CostCurve(table=((4, 0.1), (8, 0.2))).cost_s(1) == 0.1


@pytest.mark.parametrize(
    "wrong",
    [
        {"fixed_s": 0.0},
        {"fixed_s": -1.0, "row_s": 2.0},
        {"fixed_s": math.nan},
        {"table": ((2, 0.1), (1, 0.2))},
        {"table": ((1, 0.1), (1, 0.2))},
        {"table": ((0, 0.1),)},
        {"table": ((1, 0.0),)},
    ],
)
def test_a_curve_that_cannot_be_is_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=r"costs: expected .* got"):
        CostCurve(**wrong)


@pytest.mark.parametrize("wrong", [{"hz": 0.0}, {"hz": math.nan}, {"hz": 1.0, "rows": 0}])
def test_a_need_that_cannot_be_is_refused(wrong: dict) -> None:
    with pytest.raises(ConfigError, match=r"expected .* got"):
        RobotNeed(**wrong)


def test_a_robot_replans_before_its_rows_are_executed() -> None:
    assert CHUNKS_OF_50.interval_s(0.5) == pytest.approx(4.5)
    assert CHUNKS_OF_50.interval_s(5.0) == 0.0
    assert CHUNKS_OF_50.interval_s(4.95) == 0.1  # once per tick


def test_a_robot_with_single_actions_asks_once_a_tick() -> None:
    lone = RobotNeed(10.0, 1)
    assert lone.interval_s(0.1) == 0.1
    assert lone.interval_s(0.11) == 0.0


def test_nobody_is_no_load() -> None:
    assert robots_load(PI0, {}, 16) == IDLE


def test_a_policy_that_is_slower_than_a_tick_serves_no_robot() -> None:
    slow = robots_load(CostCurve(0.2), {RobotNeed(10.0, 1): 1}, 16)
    assert slow.load == math.inf
    assert not slow.in_time


def test_the_largest_fleet_in_time_follows_from_the_durations() -> None:
    # Batches of 16 take 158 ms. A robot needs one answer every 5 s minus twice this time.
    by_hand = math.floor(USABLE * 16 / 0.15826 * (5.0 - 2 * 0.15826))
    assert robots_load(PI0, {CHUNKS_OF_50: by_hand}, 16).in_time
    assert not robots_load(PI0, {CHUNKS_OF_50: by_hand + 1}, 16).in_time


@given(costs, st.dictionaries(needs, st.integers(1, 30), min_size=1, max_size=4), needs)
def test_a_further_robot_never_makes_a_replica_emptier(
    curve: CostCurve, robots: dict[RobotNeed, int], newcomer: RobotNeed
) -> None:
    before = robots_load(curve, robots, 16).load
    more = {**robots, newcomer: robots.get(newcomer, 0) + 1}
    # With the new robot, batches may have one more row than before.
    after = robots_load(curve, more, min(16, sum(robots.values()))).load
    assert after >= before


@given(costs, st.dictionaries(needs, st.integers(1, 30), min_size=1, max_size=4))
def test_robots_that_replan_as_told_use_no_more_than_the_replica_has(
    curve: CostCurve, robots: dict[RobotNeed, int]
) -> None:
    load = robots_load(curve, robots, 16)
    if not load.in_time:
        return
    requests_hz = sum(count / load.replan_s(need) for need, count in robots.items())
    used = requests_hz * curve.cost_s(load.batch_size) / load.batch_size
    assert used == pytest.approx(USABLE)


def load_by_size(
    costs: CostCurve, needs: Mapping[RobotNeed, int], max_batch_size: int
) -> list[float]:
    """Return the load for each batch size, computed robot by robot, until some robot is late."""
    robots = sum(needs.values())
    loads = []
    for size in range(1, min(max_batch_size, robots) + 1):
        latency_s = answer_s(costs, size, robots)
        intervals_s: list[float] = []
        for need, count in needs.items():
            intervals_s += [need.interval_s(latency_s)] * count
        if 0.0 in intervals_s:
            break
        needed_hz = sum(1 / interval_s for interval_s in intervals_s)
        loads.append(needed_hz * costs.cost_s(size) / size)
    return loads


different_needs = st.builds(
    RobotNeed,
    st.floats(0.5, 50.0),
    st.sampled_from([1, 2, 8, 50]),
)


@given(
    costs=costs,
    needs=st.dictionaries(different_needs, st.integers(1, 4), min_size=1, max_size=30),
    max_batch_size=st.integers(1, 64),
)
def test_the_load_of_different_robots_is_that_of_one_after_the_other(
    costs: CostCurve, needs: dict[RobotNeed, int], max_batch_size: int
) -> None:
    load = robots_load(costs, needs, max_batch_size)
    loads = load_by_size(costs, needs, max_batch_size)
    if not loads:
        assert (load.load, load.batch_size) == (math.inf, 1)
        return
    assert load.load == pytest.approx(min(loads))
    assert loads[load.batch_size - 1] == pytest.approx(min(loads))
    robots = sum(needs.values())
    assert load.latency_s == answer_s(costs, load.batch_size, robots)

    # Together the robots send as many requests as the replica can answer, and no robot runs out of
    # rows.
    paced_s = {need: load.replan_s(need) for need in needs}
    if load.load <= USABLE:
        usable_hz = USABLE * load.batch_size / costs.cost_s(load.batch_size)
        asked_hz = sum(count / paced_s[need] for need, count in needs.items())
        assert asked_hz <= usable_hz * (1 + 1e-9)
    for need, interval_s in paced_s.items():
        assert interval_s <= need.interval_s(load.latency_s) * (1 + 1e-12)
