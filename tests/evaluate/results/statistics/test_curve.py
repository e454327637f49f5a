from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import ecdf

from vlagents_ray.errors import InvalidInput
from vlagents_ray.evaluate.results.statistics import success_curve


def test_the_curve_jumps_where_episodes_are_solved_and_ends_at_the_rate() -> None:
    curve = success_curve([3, 7, 3, None], 10)
    assert curve.steps == (0, 3, 7, 10)
    assert [rate.successes for rate in curve.solved] == [0, 2, 3, 3]
    assert {rate.episodes for rate in curve.solved} == {4}


def test_the_curve_is_kaplan_and_meiers_without_censoring() -> None:
    steps = np.random.default_rng(0).integers(1, 40, 60)
    reference = ecdf(steps).cdf
    curve = success_curve(list(map(int, steps)), 40)
    for step, rate in zip(curve.steps, curve.solved, strict=True):
        assert rate.rate == pytest.approx(float(reference.evaluate(step)))


def test_an_unsolved_episode_stays_in_the_denominator() -> None:
    assert success_curve([None, None], 5).solved[-1].rate == 0.0


def test_success_after_the_end_is_refused() -> None:
    with pytest.raises(InvalidInput, match="want them in 1 … 10"):
        success_curve([3, 11], 10)
