"""What `tune` chooses from given figures, and the settings that follow."""

from __future__ import annotations

from typing import Any

import pytest

from vlagents_ray.bench.tuning_choice import (
    GoalMissed,
    MeasuredPoint,
    TuningGoal,
    Variant,
    choose,
    chosen_settings,
    default_point,
    figures,
)
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.config.deployment import BatchArgs

OWN, COMPILED, BF16 = Variant(), Variant({"compile": True, "batch_sizes": [1, 2, 4]}), Variant({"dtype": "bfloat16"})
THROUGHPUT = TuningGoal("throughput")


def point(variant: Variant, sessions: int, rate: float, p99: float = 50.0) -> MeasuredPoint:
    return MeasuredPoint(variant, sessions, rate, p99 / 2, p99, 100.0, 0.001)


def test_for_throughput_the_largest_rate_is_chosen() -> None:
    points = [point(OWN, 1, 10), point(OWN, 4, 30), point(OWN, 8, 29), point(COMPILED, 4, 40)]
    assert choose(points, THROUGHPUT) == points[3]
    assert choose(points[:3], THROUGHPUT) == points[1]


def test_a_variant_must_be_five_percent_better_than_one_with_fewer_changes() -> None:
    points = [point(COMPILED, 4, 104), point(OWN, 4, 100), point(BF16, 4, 103)]
    assert choose(points, THROUGHPUT) == points[1]
    assert choose([*points, point(BF16, 8, 106)], THROUGHPUT).sessions == 8


def test_for_robots_the_most_sessions_within_the_time_are_chosen() -> None:
    goal = TuningGoal("robots", 60.0)
    points = [point(OWN, 1, 30, 20), point(OWN, 2, 40, 59), point(OWN, 4, 90, 61), point(COMPILED, 2, 50, 40)]
    assert choose(points[:3], goal) == points[1]
    assert choose(points, goal) == points[3]  # as many, with shorter round trips
    more = point(COMPILED, 4, 80, 60)
    assert choose([*points, more], goal) == more


def test_a_goal_that_nothing_reaches_is_an_error_with_the_nearest() -> None:
    with pytest.raises(GoalMissed, match=r"got 10.* 20\.0 ms, with 1 session and own settings"):
        choose([point(OWN, 1, 30, 20), point(COMPILED, 2, 50, 40)], TuningGoal("robots", 10.0))


@pytest.mark.parametrize(("kind", "p99"), [("robots", None), ("throughput", 5.0)])
def test_only_robots_have_a_longest_round_trip(kind: Any, p99: float | None) -> None:
    with pytest.raises(ConfigError, match="--p99-ms"):
        TuningGoal(kind, p99)


def test_the_default_is_what_the_file_gives_as_it_is() -> None:
    points = [point(OWN, 4, 30, 40), point(OWN, 16, 50, 90), point(COMPILED, 16, 80)]
    assert default_point(points, THROUGHPUT, 16) == points[1]
    assert default_point(points, THROUGHPUT, 8) is None  # was not measured
    assert default_point(points, TuningGoal("robots", 60.0), 16) == points[0]
    assert default_point(points, TuningGoal("robots", 30.0), 16) is None


def test_the_settings_are_those_that_differ_from_the_file() -> None:
    assert chosen_settings(point(OWN, 16, 1), BatchArgs(), None) == {}
    assert chosen_settings(point(BF16, 8, 1), BatchArgs(), None) == {
        "config": {"dtype": "bfloat16"},
        "batch": {"max_size": 8},
    }
    assert chosen_settings(point(COMPILED, 2, 1), BatchArgs(), None) == {
        "config": {"compile": True, "batch_sizes": [1, 2]},
        "batch": {"max_size": 2},
    }


def test_fixed_sizes_of_the_file_end_at_the_chosen_one() -> None:
    assert chosen_settings(point(OWN, 4, 1), BatchArgs(max_size=4), [1, 4, 16]) == {"config": {"batch_sizes": [1, 4]}}
    assert chosen_settings(point(OWN, 4, 1), BatchArgs(sizes=[1, 4, 16]), None) == {"batch": {"sizes": [1, 4]}}
    assert chosen_settings(point(OWN, 16, 1), BatchArgs(sizes=[1, 4, 16]), [1, 4, 16]) == {}


def test_the_table_has_a_row_for_each_point() -> None:
    _, first, second = figures([point(OWN, 1, 10), point(COMPILED, 4, 40)])
    assert first[:2] == ["own settings", "1"]
    assert second == ["compile: true", "4", "40.0", "25.0", "50.0", "100", "0.100%"]
