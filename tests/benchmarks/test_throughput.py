"""The benchmark of throughput: its arithmetic, its clients, and the bare policy."""

from __future__ import annotations

import time

import pytest

from benchmarks.bare_policy import BarePolicy
from benchmarks.closed_loop import ClosedLoop
from benchmarks.figures import mean_interval
from benchmarks.measured_policy import rate_of
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
