"""The benchmarks of throughput, autoscaling, pushes and rollouts: their arithmetic, and
small runs.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest

from benchmarks.autoscaling import (
    AutoscalingPlan,
    LoadPhase,
    ScaleSample,
    by_second,
    plot_autoscaling,
    report,
)
from benchmarks.bare_policy import BarePolicy
from benchmarks.closed_loop import ClosedLoop
from benchmarks.figures import mean_interval
from benchmarks.measured_policy import rate_of
from benchmarks.push import measure_push
from benchmarks.rollouts import LOCAL, OURS, RolloutComparison, compare_rollouts, rollout_outcomes
from benchmarks.throughput import ThroughputPlan


def test_the_ideal_of_the_default_policy() -> None:
    ideal = ThroughputPlan().ideal
    assert ideal is not None
    assert ideal(1) == pytest.approx(1000 / 21)
    assert ideal(16) == ideal(32) == pytest.approx(16_000 / 36)


def test_a_policy_of_unknown_speed_is_measured_bare() -> None:
    assert ThroughputPlan(policy="scripted", config={}).ideal is None
    assert ThroughputPlan(policy="noop", config={}).ideal is None


@pytest.mark.parametrize("cut", [0.0, 0.001, 0.02, 0.0359])
def test_the_rate_of_batches_does_not_depend_on_where_the_time_begins(cut: float) -> None:
    """Batches of 16, a millisecond wide, every 36 ms: 444.4 rows per second."""
    batches = [cut + 0.036 * batch + 0.001 * i / 16 for batch in range(56) for i in range(16)]
    calls = [(end, 72.0, 36.0, 16) for end in batches if 0.02 <= end < 2.0]
    assert rate_of([calls[::2], calls[1::2]]) == pytest.approx(16 / 0.036, rel=0.005)


def test_too_few_calls_have_no_rate() -> None:
    assert rate_of([]) == 0
    assert rate_of([[(1.0, 1.0, 1.0, 1)]]) == 0


def test_robots_think_and_a_late_answer_ends_a_client() -> None:
    def prompt() -> tuple[float, float, int]:
        time.sleep(0.001)
        return 3.0, 1.0, 4

    def late() -> tuple[float, float, int]:
        time.sleep(0.3)
        raise TimeoutError

    loop = ClosedLoop([prompt, prompt, late], robots=1)
    begin = time.monotonic()
    robot, simulation, ended = loop.run(1, 2, begin, begin + 0.2)
    assert 0 < len(robot) < len(simulation)
    assert {call[1:] for call in simulation} == {(3.0, 1.0, 4)}
    assert ended == []
    with pytest.raises(TimeoutError):
        loop.run(0, 2, begin, time.monotonic() + 1)
    loop.close()


def test_the_interval_of_a_mean_is_students() -> None:
    assert mean_interval([1.0]) is None
    assert mean_interval([9.0, 10.0, 11.0]) == pytest.approx(
        (10 - 4.303 / 3**0.5, 10 + 4.303 / 3**0.5)
    )


def test_a_bare_policy_is_run_in_full_batches() -> None:
    bare = BarePolicy("noop", {"base_ms": 10}, batch=8)
    # Eight rows for each sleep of at least 10 ms; one at a time would give 100.
    rates = [bare.rate(0.1) for _ in range(5)]
    assert 100 < max(rates) <= 800


ACTS = [(100.1, 10.0), (100.9, 20.0), (101.5, 30.0)]


def test_acts_are_summed_up_by_the_second() -> None:
    assert by_second(ACTS, 100.0) == [
        {"at": 0.5, "median_ms": 15.0, "p95_ms": 19.5},
        {"at": 1.5, "median_ms": 30.0, "p95_ms": 30.0},
    ]


def test_each_burst_has_its_own_figures_and_times_count_from_the_first(tmp_path: Path) -> None:
    samples = [ScaleSample(99.0, 0, 0, 0), ScaleSample(101.0, 2, 1, 3), ScaleSample(104.0, 4, 4, 1)]
    phases = [
        LoadPhase("robots", 100.0, 102.0, ACTS, 1.5, 0, []),
        LoadPhase("nobody got through", 103.0, 105.0, [], 60.0, 0, ["reset: no replica"]),
    ]
    found = report(AutoscalingPlan(), samples, phases)
    assert [one["at"] for one in found["samples"]] == [-1, 1, 4]
    robots, none = found["phases"]
    assert (robots["begun"], robots["ended"], robots["most_replicas"], robots["acts"]) == (
        0,
        2,
        1,
        3,
    )
    assert (robots["median_ms"], robots["longest_ms"]) == pytest.approx((20, 30))
    assert none["failed"] == ["reset: no replica"]
    assert math.isnan(none["median_ms"])
    plot_autoscaling(found, tmp_path / "picture.svg")
    assert (tmp_path / "picture.svg").stat().st_size > 1000


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
def test_the_sessions_act_on_with_the_weights_of_each_push() -> None:
    rounds = measure_push(2_500_000, "float16", sessions=3, base_ms=1, rounds=2, seconds=1)
    assert [row["push"]["newest"] for row in rounds] == [1, 2]
    for row in rounds:
        assert row["push_s"] > 0
        for watched in (row["alone"], row["push"]):
            assert watched["failed"] == 0
            assert watched["monotone"]
            assert watched["longest_ms"] >= 1


@pytest.mark.slow
@pytest.mark.integration
@pytest.mark.server
def test_rollouts_and_the_loop_play_in_turns() -> None:
    found = compare_rollouts(RolloutComparison(("tiny",), (1, 4), episodes=8, rounds=1, size=32))
    one, four = found["rows"]
    assert (one["workers"], four["workers"]) == (1, 2)
    assert set(one["of_loop"]) == {OURS, LOCAL}
    assert set(four["of_loop"]) == {OURS}
    assert all(rate > 0 for row in found["rows"] for rate in row["rounds"][0].values())
    assert len(rollout_outcomes(found)) == 2


def test_a_slow_policy_wants_the_whole_rate_of_the_loop() -> None:
    rows = [{"policy": policy, "envs": 16, "of_loop": {OURS: 0.95}} for policy in ("tiny", "slow")]
    assert [one.met for one in rollout_outcomes({"rows": rows})] == [True, False]


def test_each_environment_plays_as_many_episodes() -> None:
    plan = RolloutComparison(episodes=20)
    assert [plan.turn("tiny", envs) for envs in (1, 16, 64)] == [20, 32, 64]
    assert plan.turn("slow", 1) == 5
