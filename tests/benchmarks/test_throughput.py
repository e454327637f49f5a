"""The arithmetic around throughput."""

from __future__ import annotations

import pytest

from benchmarks.bare_policy import BarePolicy
from benchmarks.throughput import ThroughputPlan
from vlagents_ray.bench.measured_policy import rate_of


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
    """Batches of 16, a millisecond wide, every 36 ms: 444.4 a second."""
    batches = [cut + 0.036 * batch + 0.001 * i / 16 for batch in range(56) for i in range(16)]
    calls = [(end, 72.0, 36.0, 16) for end in batches if 0.02 <= end < 2.0]
    assert rate_of([calls[::2], calls[1::2]]) == pytest.approx(16 / 0.036, rel=0.005)


def test_too_few_calls_have_no_rate() -> None:
    assert rate_of([]) == 0
    assert rate_of([[(1.0, 1.0, 1.0, 1)]]) == 0


def test_a_bare_policy_is_run_in_full_batches() -> None:
    bare = BarePolicy("noop", {"base_ms": 10}, batch=8)
    rates = [bare.rate(0.1) for _ in range(5)]  # eight for each sleep of at least 10 ms; one at a time would be 100
    assert 100 < max(rates) <= 800
