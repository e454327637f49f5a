"""The contract between a dataset and the policy trained on it, and continuous angles."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from vlagents_ray.contract import ActionSpec, CameraSpec, Contract, StateSpec
from vlagents_ray.dataset_contract import (
    BYTES,
    STATISTICS,
    Centre,
    DatasetContract,
    angles_in,
    centre_between,
    centre_of,
    divided_state,
    rotation_centre_of,
    rotation_vector_in,
    state_parts,
)
from vlagents_ray.errors import ConfigError

ABOUT = DatasetContract(
    Contract(
        cameras={"wrist": CameraSpec(32, 48)},
        state={"xyzrpy": StateSpec(6, "m+rad")},
        gripper=True,
        action=ActionSpec(dim=7, delta=True, gripper_open=1.0, gripper_closed=-1.0),
        control_hz=20.0,
    ),
    ("xyzrpy", "gripper"),
    {"observation.images.wrist": "wrist"},
    {0: (3.0, 0.5, -0.25), 3: 3.1, 5: -1.0},
    ("xyzrpy",),
)


def test_the_width_of_its_state_is_that_of_its_parts() -> None:
    assert ABOUT.width == 7


@pytest.mark.parametrize(
    "angles", [{7: 0.0}, {-1: 0.0}, {3: math.nan}, {5: (0.0, 0.0, 1.0)}, {3: (0.0, math.nan, 1.0)}]
)
def test_angles_that_the_state_does_not_have_are_an_error(angles: dict[int, Centre]) -> None:
    with pytest.raises(ConfigError, match="no angles at"):
        DatasetContract.from_json(replace(ABOUT, angles=angles).to_json())


def test_it_is_the_same_after_a_trip_through_statistics_as_float_tensors() -> None:
    numbers = ABOUT.to_statistics(50)[STATISTICS][BYTES]
    assert (
        DatasetContract.from_statistics(
            np.array(json.loads(json.dumps(numbers)), np.float32).tolist()
        )
        == ABOUT
    )
    assert DatasetContract.from_statistics(np.array(numbers, np.float16).tolist()) == ABOUT


@pytest.mark.parametrize(
    "text", ["", "{", "[]", '{"state": []}', '{"contract": {"wings": 2}, "state": []}']
)
def test_what_is_no_contract_is_an_error_with_the_cure(text: str) -> None:
    with pytest.raises(ConfigError, match=r"cannot be read.*newer vlagents-ray"):
        DatasetContract.from_statistics(text.encode())


def test_averages_of_the_same_contract_are_it_and_of_two_are_an_error() -> None:
    """LeRobot merges datasets and leaves out episodes in the same way."""
    other = replace(ABOUT, angles={**ABOUT.angles, 3: 2.9})
    first, same, changed = (
        {
            name: np.array(numbers, float)
            for name, numbers in one.to_statistics(frames)[STATISTICS].items()
        }
        for one, frames in ((ABOUT, 50), (ABOUT, 3), (other, 7))
    )
    assert set(first) >= {"min", "max", "mean", "std", "count", "q01", "q99"}
    mean = (first["mean"] * first["count"] + same["mean"] * same["count"]) / (
        first["count"] + same["count"]
    )
    assert DatasetContract.from_statistics(mean.tolist()) == ABOUT
    with pytest.raises(ConfigError, match="merged from datasets with different contracts"):
        DatasetContract.from_statistics(((first["mean"] + changed["mean"]) / 2 - 1).tolist())


def test_of_an_angle_whose_range_is_known_the_middle_is_the_centre_and_nothing_in_the_range_changes() -> (
    None
):
    centre = centre_between(-4.0, -2.0)
    assert centre == -3.0
    about = DatasetContract(Contract(), angles={0: centre})
    inside = np.linspace(-4.0, -2.0, 50, dtype=np.float32)[:, None]
    np.testing.assert_array_equal(about.wrapped(inside), inside)
    assert about.wrapped(np.array([2.5], np.float32))[0] == pytest.approx(2.5 - 2 * math.pi)
    assert centre_between(-3.0, 3.0) is None, "the value is on the circle"
    assert centre_between(-9.0, 9.0) is None, "the value counts turns"


def test_angles_are_known_by_their_units() -> None:
    assert list(angles_in("joints", "rad", 2)) == [0, 1]
    assert list(angles_in("xyzrpy", "m+rad", 6)) == [3, 4, 5]
    # The numbers of a rotation vector do not wrap individually.
    assert not angles_in("xyz_axis_angle", "m+rad", 6)
    assert rotation_vector_in("xyz_axis_angle", "m+rad", 6) == 3
    assert not angles_in("axis_angle", "rad", 3)
    assert rotation_vector_in("axis_angle", "rad", 3) == 0
    assert (
        rotation_vector_in("xyzrpy", "m+rad", 6)
        is rotation_vector_in("axis_angle", None, 3)
        is None
    )
    assert not angles_in("tquat", "m+quat_xyzw", 7)
    assert not angles_in("position", None, 3)


def test_an_angle_that_jumps_is_continuous_about_its_centre() -> None:
    turned = np.linspace(2.5, 4.5, 50)  # past pi
    seen = np.angle(np.exp(1j * turned))
    centre = centre_of([seen[:30], seen[30:]])
    assert centre is not None
    values = DatasetContract(Contract(), angles={0: centre}).wrapped(
        seen[:, None].astype(np.float32)
    )[:, 0]
    assert np.abs(np.diff(values)).max() < 0.1
    assert np.abs(values - centre).max() < 1.1, "the cut must be opposite to the observed values"


def test_one_that_jumps_only_from_episode_to_episode_is_wrapped_too() -> None:
    centre = centre_of([np.full(5, 3.1), np.full(5, -3.1)])
    assert centre is not None
    assert abs(centre) == pytest.approx(math.pi, abs=1e-5)


def test_what_does_not_jump_and_what_counts_turns_stays_as_it_is() -> None:
    assert centre_of([np.linspace(-1.5, 1.5, 9)]) is None
    assert centre_of([np.array([0.0, 7.0, 0.0])]) is None
    assert centre_of([np.zeros(0)]) is None


@pytest.mark.parametrize("centre", [0.0, 1.0, -2.5, math.pi, -math.pi])
def test_wrapping_turns_by_whole_turns_into_the_circle_and_twice_is_once(centre: float) -> None:
    about = DatasetContract(Contract(), angles={1: centre})
    seen = (
        np.random.default_rng(0)
        .uniform(-math.pi, math.pi, (2000, 1))
        .astype(np.float32)
        .repeat(2, axis=1)
    )
    before = seen.copy()
    values = about.wrapped(seen)
    np.testing.assert_array_equal(seen, before)
    np.testing.assert_array_equal(values[:, 0], seen[:, 0])
    assert (np.abs(values[:, 1] - centre) <= math.pi + 1e-5).all()
    np.testing.assert_allclose(np.exp(1j * values[:, 1]), np.exp(1j * seen[:, 1]), atol=1e-5)
    # At the cut itself both sides are correct.
    near = np.abs(np.abs(values[:, 1] - centre) - math.pi) > 1e-4
    np.testing.assert_array_equal(about.wrapped(values)[near], values[near])


def turning(axis: list[float], start: float, end: float) -> np.ndarray:
    """Return rotation vectors at most pi long, (60, 3), of a turn about an axis that also
    changes.
    """
    axes = np.array(axis) + np.linspace([0, 0, 0], [0.2, -0.3, 0.1], 60)
    turned = (
        np.linspace(start, end, 60)[:, None] * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    )
    return np.asarray(Rotation.from_rotvec(turned).as_rotvec())


@pytest.mark.parametrize("axis", [[1, 0, 0], [-1, 0.5, 0.2], [0, 0, 1]])
@pytest.mark.parametrize(("start", "end"), [(2.0, 4.5), (3.0, 3.3), (4.0, 2.2)])
def test_a_rotation_vector_that_passes_pi_is_continuous_and_the_same_rotation(
    axis: list[float], start: float, end: float
) -> None:
    seen = turning(axis, start, end)
    jumps = np.linalg.norm(np.diff(seen, axis=0), axis=1)
    assert jumps.max() > 5
    centre = rotation_centre_of([seen[:20], seen[20:]])
    assert centre is not None
    state = np.insert(seen, 0, 9.0, axis=1).astype(np.float32)
    values = DatasetContract(Contract(), angles={1: centre}).wrapped(state)
    np.testing.assert_array_equal(values[:, 0], 9.0)
    assert np.linalg.norm(np.diff(values[:, 1:], axis=0), axis=1).max() < 0.1
    rotations, expected = (
        Rotation.from_rotvec(vectors).as_matrix() for vectors in (values[:, 1:], seen)
    )
    np.testing.assert_allclose(rotations, expected, atol=1e-5)
    for one, alone in zip(state, values, strict=True):  # one by one, as a server receives them
        np.testing.assert_array_equal(
            DatasetContract(Contract(), angles={1: centre}).wrapped(one), alone
        )


def test_a_rotation_vector_near_no_rotation_that_counts_a_turn_is_near_zero() -> None:
    seen = np.array([[0.1, 0, 0], [0, 0.1, 0], [2 * math.pi - 0.1, 0, 0], [0, 0, 0]])
    centre = rotation_centre_of([seen])
    assert centre is not None
    values = DatasetContract(Contract(), angles={0: centre}).wrapped(seen)
    np.testing.assert_allclose(
        values, [[0.1, 0, 0], [0, 0.1, 0], [-0.1, 0, 0], [0, 0, 0]], atol=1e-12
    )


def test_rotation_vectors_without_jumps_and_those_that_count_turns_stay_as_they_are() -> None:
    assert rotation_centre_of([turning([1, 0, 0], 0.5, 2.5)]) is None
    assert rotation_centre_of([np.linspace([2.0, 0, 0], [4.5, 0, 0], 60)]) is None, (
        "angles may be up to two pi, like robosuite's"
    )
    assert rotation_centre_of([np.array([[7.0, 0, 0], [0, 0, 0]])]) is None
    assert rotation_centre_of([np.zeros((0, 3))]) is None


ARM = Contract(state={"joints": StateSpec(6, "rad")}, gripper=True)


@pytest.mark.parametrize(
    ("width", "policy", "chosen", "parts"),
    [
        (5, None, None, [("joints", 5)]),
        (7, ARM, None, [("joints", 6), ("gripper", 1)]),
        (7, ARM, ["gripper", "joints"], [("gripper", 1), ("joints", 6)]),
        (9, replace(ARM, gripper=None), ["joints", "torques"], [("joints", 6), ("torques", 3)]),
    ],
)
def test_a_state_is_divided_into_the_parts_of_the_policy(
    width: int, policy: Contract | None, chosen: list[str] | None, parts: list[tuple[str, int]]
) -> None:
    assert state_parts(width, policy, chosen, option="--state a,b") == parts


@pytest.mark.parametrize(
    ("width", "chosen"),
    [(6, None), (8, None), (7, []), (9, ["joints", "a", "b"]), (6, ["joints", "a"])],
)
def test_a_state_of_another_width_names_the_option(width: int, chosen: list[str] | None) -> None:
    with pytest.raises(ConfigError, match=f"got {width} numbers.*in their order: --state a,b"):
        state_parts(width, ARM, chosen, option="--state a,b")


def test_the_gripper_of_a_divided_state_is_a_number() -> None:
    vectors = {
        "observation.state": np.arange(3, dtype=np.float32),
        "observation.environment_state": np.ones(2),
    }
    parts = {
        "observation.state": [("gripper", 1), ("joints", 2)],
        "observation.environment_state": [("puck", 2)],
    }
    state, gripper = divided_state(vectors, parts)
    assert (gripper, {name: part.tolist() for name, part in state.items()}) == (
        0.0,
        {"joints": [1, 2], "puck": [1, 1]},
    )
