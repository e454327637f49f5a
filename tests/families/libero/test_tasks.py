"""What is read from LIBERO's files."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from vlagents_ray.envs.libero import axis_angle, find_task, read_states

pytestmark = pytest.mark.assets("libero")


@pytest.mark.parametrize("suite", ["libero_spatial", "libero_object", "libero_goal", "libero_10", "libero_90"])
def test_each_suite_has_fifty_initial_states_a_task(suite: str) -> None:
    states = read_states(find_task(f"{suite}/3").states)
    assert states.shape[0] == 50
    assert states.dtype == np.float64
    assert np.isfinite(states).all()


def test_a_file_of_states_that_would_run_code_does_not(tmp_path: Path) -> None:
    import torch

    class Trap:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.touch, (tmp_path / "ran",)  # type: ignore[return-value]

    torch.save(Trap(), tmp_path / "states")
    with pytest.raises(pickle.UnpicklingError, match="Weights only"):
        read_states(tmp_path / "states")
    assert not (tmp_path / "ran").exists()


def test_axis_angles_are_robosuites_for_both_signs_of_a_quaternion() -> None:
    find_task("libero_spatial/0")  # imports it
    from robosuite.utils.transform_utils import quat2axisangle

    drawn = np.random.default_rng(0).normal(size=(20, 4))
    for quaternion in drawn / np.linalg.norm(drawn, axis=1, keepdims=True):
        for signed in (quaternion, -quaternion):
            np.testing.assert_allclose(axis_angle(signed), quat2axisangle(signed.copy()), atol=1e-12)
    np.testing.assert_array_equal(axis_angle(np.array([0.0, 0.0, 0.0, 1.0])), np.zeros(3))
