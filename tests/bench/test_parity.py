"""How far actions are from others, as a share of their range."""

from __future__ import annotations

import math

import numpy as np
import pytest

from vlagents_ray.bench.tuner import largest_difference

WANTED = [np.array([[0.0, 100.0], [2.0, 100.0]]), np.array([[1.0, 100.0], [4.0, 100.0]])]


def changed(by: float, column: int) -> list[np.ndarray]:
    off = np.zeros((2, 2))
    off[1, column] = by
    return [WANTED[0], WANTED[1] + off]


def test_each_number_of_an_action_is_compared_with_its_own_range() -> None:
    assert largest_difference(WANTED, WANTED) == 0
    assert largest_difference(changed(0.1, 0), WANTED) == pytest.approx(0.1 / 4)


def test_a_number_that_hardly_moves_has_a_tenth_of_its_magnitude_as_range() -> None:
    assert largest_difference(changed(-0.1, 1), WANTED) == pytest.approx(0.1 / 10)


def test_a_number_that_is_always_zero_may_not_change() -> None:
    zeros = [np.zeros(2)]
    assert largest_difference(zeros, zeros) == 0
    assert largest_difference([np.array([0.0, 1e-9])], zeros) == math.inf


def test_rows_of_a_batch_that_begins_again_belong_to_the_first_episodes() -> None:
    assert largest_difference([*WANTED, WANTED[0]], WANTED) == 0
    assert largest_difference([*WANTED, WANTED[1]], WANTED) > 0


@pytest.mark.parametrize("bad", [np.zeros((3, 2)), np.full((2, 2), np.nan), np.full((2, 2), np.inf)])
def test_other_shapes_and_values_that_are_not_finite_never_pass(bad: np.ndarray) -> None:
    assert largest_difference([bad], WANTED) == math.inf
