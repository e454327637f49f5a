"""Pushed weights that do not fit are refused, with the names and the cure."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.errors import InvalidWeights, UnchangedWeights
from vlagents_ray.weights.trainable import fingerprint, fitted

HELD = {"w": np.zeros((2, 3), np.float32), "b": np.zeros(3, np.float16), "n": np.zeros((), np.int64)}
LARGE = np.zeros(10_000, np.float32)
NEW = {"w": np.ones((2, 3), np.float32), "b": np.ones(3, np.float16), "n": np.ones((), np.int64)}


@pytest.mark.parametrize(
    ("pushed", "says"),
    [
        (NEW | {"z": np.zeros(1)}, r"'z': unknown, want one of the policy's 3 names"),
        ({"w": NEW["w"]}, r"'b': missing; push it, or set partial=True; 'n': missing"),
        (NEW | {"w": np.ones((3, 2), np.float32)}, r"'w': got shape \(3, 2\), want \(2, 3\)"),
        (NEW | {"w": np.ones((2, 3), np.int32)}, r"'w': got int32, want float32"),
        (NEW | {"w": [1.0]}, r"'w': got list, want an array"),
        (NEW | {"w": np.full((2, 3), np.nan, np.float32)}, r"'w': got NaN or infinite values, want finite ones"),
        (NEW | {"b": np.full(3, 1e5, np.float32)}, r"'b': got NaN or infinite"),  # above the largest float16
        ({**{str(n): np.zeros(1) for n in range(7)}, **NEW}, r"and 2 more$"),
    ],
)
def test_what_does_not_fit_is_refused(pushed: dict[str, Any], says: str) -> None:
    with np.errstate(over="ignore"), pytest.raises(InvalidWeights, match=says) as refused:
        fitted(HELD, pushed)
    assert "nothing was changed" in str(refused.value)


def test_what_fits_is_converted() -> None:
    new = fitted(HELD, NEW | {"b": np.ones(3, np.float64)})
    assert list(new) == list(HELD)
    assert {name: value.dtype for name, value in new.items()} == {name: value.dtype for name, value in HELD.items()}


def test_a_part_keeps_the_rest() -> None:
    new = fitted(HELD, {"b": NEW["b"]}, partial=True)
    assert new["w"] is HELD["w"]
    assert new["b"].tolist() == [1, 1, 1]
    with pytest.raises(InvalidWeights, match="no value"):
        fitted(HELD, {}, partial=True)


def test_what_changes_nothing_is_refused_unless_allowed() -> None:
    same = {name: value.copy() for name, value in HELD.items()}
    with pytest.raises(UnchangedWeights, match="all 3 values equal"):
        fitted(HELD, same)
    assert fitted(HELD, same, allow_same=True)
    assert fitted(HELD, same | {"n": np.int64(7)})  # one value of one name is enough


def test_the_fingerprint_depends_on_names_shapes_types_and_values_alone() -> None:
    first = fingerprint(HELD)
    assert len(first) == 32
    assert fingerprint(dict(reversed(HELD.items()))) == first
    others = [NEW, HELD | {"n": np.int64(1)}, HELD | {"w": np.zeros((3, 2), np.float32)}, HELD | {"x": np.zeros(1)}]
    assert len({first, *map(fingerprint, others)}) == 5


@given(index=st.integers(0, 9_999), bits=st.integers(1, 2**32 - 1))
def test_no_element_can_be_changed_without_the_fingerprint(index: int, bits: int) -> None:
    other = LARGE.copy()
    other.view(np.uint32)[index] ^= bits
    assert fingerprint({"w": LARGE}) != fingerprint({"w": other})


@pytest.mark.torch
def test_tensors_are_checked_as_arrays_are() -> None:
    torch = pytest.importorskip("torch")
    held = {"w": torch.zeros(4, dtype=torch.bfloat16), "n": torch.zeros((), dtype=torch.int64)}
    assert fitted(held, {"w": np.ones(4), "n": np.int64(2)})["w"].dtype == torch.bfloat16
    for wrong, says in ((torch.full((4,), float("inf")), "infinite"), (torch.ones(4, dtype=torch.int8), "got int8")):
        with pytest.raises(InvalidWeights, match=says):
            fitted(held, {"w": wrong}, partial=True)
    with pytest.raises(UnchangedWeights):
        fitted(held, held)
    assert fingerprint(held) != fingerprint(held | {"w": held["w"] + 1})
