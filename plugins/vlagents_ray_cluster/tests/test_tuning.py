"""Tests of the observations with which `tune` measures, the tolerance of actions, and its choice
from given figures.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tuned_recordings import record

from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.config.deployment import BatchArgs
from vlagents_ray_cluster.tune.measured_policy import load_observations, save_observations
from vlagents_ray_cluster.tune.tuner import (
    GoalMissed,
    MeasuredPoint,
    TuningGoal,
    Variant,
    choose,
    chosen_settings,
    default_point,
    figures,
    largest_difference,
    recorded_observations,
)


def test_they_are_spread_over_episodes_and_their_steps(tmp_path: Path) -> None:
    record(tmp_path / "a" / "ep0.npz", 0.0)
    record(tmp_path / "b" / "ep1.npz", 100.0)
    observations = recorded_observations(tmp_path, 4)
    assert [obs.state["arm/joints"].tolist() for obs in observations] == [
        [0, 0],
        [5, 5],
        [100, 100],
        [105, 105],
    ]
    assert [obs.gripper for obs in observations] == [0, 1, 0, 1]
    assert [round(obs.cameras["front"].mean() / 20) for obs in observations] == [0, 5, 0, 5]


def test_one_trajectory_gives_all_and_many_give_one_each(tmp_path: Path) -> None:
    record(tmp_path / "ep0.npz", 0.0)
    assert [obs.state["arm/joints"][0] for obs in recorded_observations(tmp_path, 3)] == [0, 2, 5]
    for number in range(1, 5):
        record(tmp_path / f"ep{number}.npz", 100.0 * number)
    assert len(recorded_observations(tmp_path, 3)) == 3


def test_a_file_brings_them_to_another_process(tmp_path: Path) -> None:
    record(tmp_path / "ep0.npz", 0.0)
    observations = recorded_observations(tmp_path, 3)
    observations[1].gripper = None
    save_observations(observations, tmp_path / "frames")
    loaded = load_observations(tmp_path / "frames")
    assert len(loaded) == 3
    for obs, saved in zip(loaded, observations, strict=True):
        assert obs.gripper == saved.gripper
        np.testing.assert_array_equal(obs.state["arm/joints"], saved.state["arm/joints"])
        np.testing.assert_array_equal(obs.cameras["front"], saved.cameras["front"])


def test_what_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="expected a folder of trajectories"):
        recorded_observations(tmp_path, 3)
    record(tmp_path / "ep0.npz", 0.0, frames=4)
    with pytest.raises(ConfigError, match=r"ep0_front\.mp4.*5"):
        recorded_observations(tmp_path, 3)
    (tmp_path / "ep0_front.mp4").unlink()
    with pytest.raises(ConfigError, match=r"ep0_front\.mp4"):
        recorded_observations(tmp_path, 3)


EXPECTED = [np.array([[0.0, 100.0], [2.0, 100.0]]), np.array([[1.0, 100.0], [4.0, 100.0]])]


def changed(by: float, column: int) -> list[np.ndarray]:
    off = np.zeros((2, 2))
    off[1, column] = by
    return [EXPECTED[0], EXPECTED[1] + off]


def test_each_number_of_an_action_is_compared_with_its_own_range() -> None:
    assert largest_difference(EXPECTED, EXPECTED) == 0
    assert largest_difference(changed(0.1, 0), EXPECTED) == pytest.approx(0.1 / 4)


def test_a_number_that_hardly_moves_has_a_tenth_of_its_magnitude_as_range() -> None:
    assert largest_difference(changed(-0.1, 1), EXPECTED) == pytest.approx(0.1 / 10)


def test_a_number_that_is_always_zero_may_not_change() -> None:
    zeros = [np.zeros(2)]
    assert largest_difference(zeros, zeros) == 0
    assert largest_difference([np.array([0.0, 1e-9])], zeros) == math.inf


def test_rows_of_a_batch_that_begins_again_belong_to_the_first_episodes() -> None:
    assert largest_difference([*EXPECTED, EXPECTED[0]], EXPECTED) == 0
    assert largest_difference([*EXPECTED, EXPECTED[1]], EXPECTED) > 0


@pytest.mark.parametrize(
    "bad", [np.zeros((3, 2)), np.full((2, 2), np.nan), np.full((2, 2), np.inf)]
)
def test_other_shapes_and_values_that_are_not_finite_never_pass(bad: np.ndarray) -> None:
    assert largest_difference([bad], EXPECTED) == math.inf


OWN, COMPILED, BF16 = (
    Variant(),
    Variant({"compile": True, "batch_sizes": [1, 2, 4]}),
    Variant({"dtype": "bfloat16"}),
)
THROUGHPUT = TuningGoal("throughput")


def point(variant: Variant, sessions: int, rate: float, p99: float = 50.0) -> MeasuredPoint:
    trips_ms = [p99 / 2] * 3 + [p99] * 2
    return MeasuredPoint(variant, sessions, 0.001, [rate], trips_ms, 100.0)


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
    points = [
        point(OWN, 1, 30, 20),
        point(OWN, 2, 40, 59),
        point(OWN, 4, 90, 61),
        point(COMPILED, 2, 50, 40),
    ]
    assert choose(points[:3], goal) == points[1]
    assert choose(points, goal) == points[3]  # serves as many robots, with shorter round trips
    more = point(COMPILED, 4, 80, 60)
    assert choose([*points, more], goal) == more


def test_a_goal_that_nothing_reaches_is_an_error_with_the_nearest() -> None:
    with pytest.raises(
        GoalMissed,
        match=r"expected a p99 of at most 10.* ms, got 20\.0 ms at best, with 1 session and own settings",
    ):
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
    assert chosen_settings(point(OWN, 4, 1), BatchArgs(max_size=4), [1, 4, 16]) == {
        "config": {"batch_sizes": [1, 4]}
    }
    assert chosen_settings(point(OWN, 4, 1), BatchArgs(sizes=[1, 4, 16]), None) == {
        "batch": {"sizes": [1, 4]}
    }
    assert chosen_settings(point(OWN, 16, 1), BatchArgs(sizes=[1, 4, 16]), [1, 4, 16]) == {}


def test_the_table_has_a_row_for_each_point() -> None:
    _, first, second = figures([point(OWN, 1, 10), point(COMPILED, 4, 40)])
    assert first[:2] == ["own settings", "1"]
    assert second == ["compile: true", "4", "40.0", "25.0", "50.0", "100", "0.100%"]
