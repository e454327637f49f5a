"""A pickle that is one array, as simulators keep their initial states, is read as data."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.errors import MalformedMessage
from vlagents_ray.wire.pickles import read_pickled_array


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("array", [np.arange(6.0).reshape(2, 3), np.asfortranarray(np.eye(3, 2)), np.zeros(0)])
def test_an_array_keeps_its_values(array: np.ndarray, protocol: int) -> None:
    read = read_pickled_array(pickle.dumps(array, protocol))
    np.testing.assert_array_equal(read, array)
    assert read.dtype == array.dtype


@pytest.mark.parametrize("value", [[np.zeros(2)], "states", Path("states"), np.array([None]), np.dtype(float)])
def test_anything_else_is_refused(value: object) -> None:
    with pytest.raises(MalformedMessage, match="pickle"):
        read_pickled_array(pickle.dumps(value, 4))
