from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.errors import InvalidInput
from vlagents_ray.evaluate import Rate, wilson


# From R. G. Newcombe, "Two-sided confidence intervals for the single proportion: comparison of seven
# methods", Statistics in Medicine 17 (1998), table I, method 3.
@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_agrees_with_published_values(successes: int, trials: int, low: float, high: float) -> None:
    assert wilson(successes, trials) == pytest.approx((low, high), abs=5e-5)


@given(st.integers(1, 10_000).flatmap(lambda n: st.tuples(st.integers(0, n), st.just(n))))
def test_wilson_encloses_the_rate_within_zero_and_one(counts: tuple[int, int]) -> None:
    successes, trials = counts
    low, high = wilson(successes, trials)
    assert 0.0 <= low <= successes / trials <= high <= 1.0


@given(st.integers(0, 50), st.integers(1, 50))
def test_wilson_narrows_with_more_of_the_same(successes: int, failures: int) -> None:
    few = wilson(successes, successes + failures)
    many = wilson(4 * successes, 4 * (successes + failures))
    assert many[1] - many[0] < few[1] - few[0]


def test_nothing_is_known_without_episodes() -> None:
    assert wilson(0, 0) == (0.0, 1.0)
    assert Rate(0, 0).rate is None
    assert Rate(0, 0).to_json()["wilson_95"] == [0.0, 1.0]


@pytest.mark.parametrize(("successes", "trials"), [(3, 2), (-1, 5)])
def test_impossible_counts_are_refused(successes: int, trials: int) -> None:
    with pytest.raises(InvalidInput, match="want 0 <= successes <= trials"):
        wilson(successes, trials)
