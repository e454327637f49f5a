from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from vlagents_ray.errors import InvalidInput
from vlagents_ray.evaluate import Rate, wilson
from vlagents_ray.evaluate.results.statistics import Pairs, difference_interval, holm, mcnemar


# From R. G. Newcombe, "Two-sided confidence intervals for the single proportion: comparison of
# seven methods", Statistics in Medicine 17 (1998), table I, method 3.
@pytest.mark.parametrize(
    ("successes", "trials", "low", "high"),
    [
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
        (0, 20, 0.0, 0.1611),
        (1, 29, 0.0061, 0.1718),
    ],
)
def test_wilson_agrees_with_published_values(
    successes: int, trials: int, low: float, high: float
) -> None:
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
    assert difference_interval([]) == difference_interval([Pairs().starts]) == (-1.0, 1.0)


def test_impossible_counts_are_refused() -> None:
    for counts in ((3, 2), (-1, 5)):
        with pytest.raises(InvalidInput, match="expected 0 <= successes <= trials"):
            wilson(*counts)
    for refuse in (lambda: mcnemar(-1, 2), lambda: Pairs(both=-1)):
        with pytest.raises(InvalidInput, match="expected counts of 0 or more"):
            refuse()


COUNTS = st.integers(0, 60)


@given(COUNTS, COUNTS)
def test_mcnemar_is_the_binomial_test_of_what_only_one_solved(only_a: int, only_b: int) -> None:
    want = binomtest(only_a, only_a + only_b, 0.5).pvalue if only_a + only_b else 1.0
    assert mcnemar(only_a, only_b) == pytest.approx(want, rel=1e-9)


# From table 3 of the paper cited by `mcnemar`: airway hyper-responsiveness before and after stem
# cell transplantation, with 1 and 7 discordant pairs.
def test_mcnemar_agrees_with_published_values() -> None:
    assert mcnemar(1, 7) == pytest.approx(0.070, abs=5e-4)
    assert mcnemar(1, 7, mid=True) == pytest.approx(0.039, abs=5e-4)


def test_mid_p_of_a_tie_counts_half_of_the_observed_table() -> None:
    assert mcnemar(5, 5, mid=True) == pytest.approx(1 - 252 / 1024 / 2)
    assert (mcnemar(5, 5), mcnemar(0, 0, mid=True)) == (1.0, 1.0)


@given(COUNTS, COUNTS)
def test_mid_p_is_symmetric_and_no_larger(only_a: int, only_b: int) -> None:
    mid = mcnemar(only_a, only_b, mid=True)
    assert mid == mcnemar(only_b, only_a, mid=True)
    assert 0.0 < mid <= mcnemar(only_a, only_b) <= 1.0


def test_thousands_of_episodes_do_not_overflow() -> None:
    assert 0.0 < mcnemar(4000, 4200) < 0.05
    assert mcnemar(0, 5000) == 0.0  # 2^-4999 is smaller than any float


def test_mcnemar_rejects_a_true_hypothesis_no_more_often_than_it_says() -> None:
    only_a = np.random.default_rng(0).binomial(30, 0.5, 20_000)
    p = np.array([mcnemar(k, 30 - k) for k in range(31)])
    assert np.mean(p[only_a] < 0.05) < 0.05


# Probabilities of both, only A, only B, and neither.
ALIKE, APART = [[0.5, 0.1, 0.1, 0.3]] * 2, [[0.2, 0.2, 0.1, 0.5], [0.7, 0.15, 0.05, 0.1]]
FAR = [[0.02, 0.9, 0.0, 0.08]]


@pytest.mark.parametrize("episodes", [10, 50])
@pytest.mark.parametrize("chances", [ALIKE, APART, FAR])
def test_the_interval_covers_the_difference_at_least_about_as_often_as_it_says(
    chances: list[list[float]], episodes: int
) -> None:
    rng = np.random.default_rng(1)
    true = np.mean([one[1] - one[2] for one in chances])
    covered = 0
    for _ in range(200):
        strata = [Pairs(*map(int, rng.multinomial(episodes, one))) for one in chances]
        low, high = difference_interval([pairs.starts for pairs in strata])
        covered += low <= true <= high
    assert covered / 200 > 0.915  # 0.95 minus two and a quarter standard deviations of 200 trials


def test_the_interval_is_narrower_for_knowing_the_tasks() -> None:
    strata = [Pairs(only_a=18, neither=2), Pairs(only_b=18, neither=2)]
    low, high = difference_interval([pairs.starts for pairs in strata])
    pooled_low, pooled_high = difference_interval([(strata[0] + strata[1]).starts])
    assert pooled_low < 2 * low < 0 < 2 * high < pooled_high


@given(st.builds(Pairs, COUNTS, COUNTS, COUNTS, COUNTS).filter(lambda pairs: pairs.total > 0))
def test_the_interval_holds_the_difference_and_is_never_certain(pairs: Pairs) -> None:
    low, high = difference_interval([pairs.starts])
    assert pairs.difference is not None
    assert -1.0 <= low <= pairs.difference <= high <= 1.0
    assert low < high


def test_the_interval_is_what_drawing_again_comes_to() -> None:
    strata = [Pairs(10, 8, 3, 9), Pairs(2, 12, 1, 35)]
    rng, drawn = np.random.default_rng(0), np.zeros(200_000)
    for one in strata:
        outcomes = np.array([one.only_a, one.only_b, one.both, one.neither]) + 0.5 * one.total / 80
        counts = rng.multinomial(one.total, outcomes / outcomes.sum(), len(drawn))
        drawn += counts[:, 0] - counts[:, 1]
    assert difference_interval([pairs.starts for pairs in strata]) == pytest.approx(
        tuple(np.quantile(drawn / 80, [0.025, 0.975])), abs=1e-9
    )


def test_thousands_of_episodes_narrow_the_interval() -> None:
    few, many = (
        difference_interval([Pairs(5 * k, 2 * k, k, 2 * k).starts] * 3) for k in (10, 1000)
    )
    assert many[0] == pytest.approx(0.1 - 1.96 * (0.29 / 30_000) ** 0.5, abs=5e-4)
    assert few[0] < many[0] < 0.1 < many[1] < few[1]


def test_holm_agrees_with_a_worked_example() -> None:
    # The sorted values 0.005, 0.01, 0.03, 0.04 times 4, 3, 2, 1, and never less than the value
    # before.
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(st.lists(st.floats(0.0, 1.0), max_size=20))
def test_holm_lies_between_the_p_value_and_bonferronis(p_values: list[float]) -> None:
    for p, adjusted in zip(p_values, holm(p_values), strict=True):
        assert p <= adjusted <= min(1.0, p * len(p_values))


def test_holm_keeps_the_chance_of_any_error_below_five_percent() -> None:
    drawn = np.random.default_rng(2).uniform(size=(4000, 10))  # ten true hypotheses
    wrong = np.mean([min(holm(list(p_values))) < 0.05 for p_values in drawn])
    assert 0.03 < wrong < 0.06
