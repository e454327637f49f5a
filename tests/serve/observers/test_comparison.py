"""How far two actions differ, and which policies can be compared."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.errors import ConfigError
from vlagents_ray.serve.observers.comparison import action_difference, require_comparable

LIVE = Contract(
    {"front": CameraSpec(224, 224)}, {"joints": StateSpec(7)}, action=ActionSpec(dim=7, space="joint"), chunk=50
)


@given(st.integers(1, 5), st.integers(1, 5), st.floats(-2, 2, width=32))
def test_an_offset_is_the_difference_of_each_joint_and_the_rows_that_both_have_are_compared(
    ours: int, theirs: int, offset: float
) -> None:
    rows = np.arange(5 * 3, dtype=np.float32).reshape(5, 3)
    found = action_difference(rows[:ours], rows[:theirs] + np.float32(offset))
    assert found.rows == min(ours, theirs)
    assert found.by_joint == pytest.approx(np.full(3, abs(offset)), abs=1e-5)
    assert found.first_row == pytest.approx(np.full(3, abs(offset)), abs=1e-5)
    assert found.mean == pytest.approx(abs(offset), abs=1e-5)


def test_the_first_row_and_the_joints_are_told_apart() -> None:
    live = np.zeros((2, 2), np.float32)
    found = action_difference(live, np.float32([[1, 0], [3, -4]]))
    assert found.first_row.tolist() == [1, 0]
    assert found.by_joint.tolist() == [2, 2]


def test_a_single_action_is_one_row() -> None:
    assert action_difference(np.ones(3), np.ones((4, 3))).rows == 1


@pytest.mark.parametrize(
    ("ours", "theirs", "cosine"),
    [([1, 2], [2, 4], 1), ([1, 0], [0, 1], 0), ([1, 2], [-1, -2], -1), ([0, 0], [0, 0], 1), ([0, 0], [1, 0], 0)],
)
def test_the_cosine_is_that_of_the_directions(ours: list[float], theirs: list[float], cosine: float) -> None:
    assert action_difference(np.array(ours), np.array(theirs)).cosine == pytest.approx(cosine)


def test_rows_of_another_length_are_no_actions_to_compare() -> None:
    with pytest.raises(ValueError, match=r"got \(6,\), want rows as in \(7,\)"):
        action_difference(np.zeros(7), np.zeros(6))


def test_a_candidate_that_needs_less_or_plans_further_fits() -> None:
    require_comparable(LIVE, Contract(state={"joints": StateSpec(7)}, action=ActionSpec(dim=7), chunk=16))
    require_comparable(LIVE, None)
    require_comparable(None, LIVE)


@pytest.mark.parametrize(
    ("candidate", "message"),
    [
        (Contract(action=ActionSpec(dim=8)), r"action.dim: the policy gives 8, the env takes 7"),
        (Contract(action=ActionSpec(space="ee_pose")), "action.space"),
        (Contract({"front": CameraSpec(256, 256)}), "needs 256x256 pixels"),
        (Contract({"wrist": CameraSpec()}), "camera 'wrist'"),
        (Contract(state={"xyzrpy": StateSpec(6)}), "state 'xyzrpy'"),
    ],
)
def test_one_that_does_not_fit_is_refused_with_the_reason_and_a_cure(candidate: Contract, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as refused:
        require_comparable(LIVE, candidate)
    assert "shadow: the candidate" in str(refused.value)
    assert "`wrappers`" in str(refused.value)
