"""Poses in the robot's base frame, and the contracts of the control modes."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from vlagents_ray.envs.maniskill.simulator import action_spec, tool_in_base

numbers = st.floats(-2.0, 2.0, width=32)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
poses = st.tuples(st.tuples(numbers, numbers, numbers).map(np.array), quaternions).map(
    np.concatenate
)


def rotation(pose: np.ndarray) -> Rotation:
    """Return the rotation of a pose in m and a quaternion wxyz."""
    return Rotation.from_quat(pose[[4, 5, 6, 3]])


def pose(turned: Rotation) -> np.ndarray:
    return np.concatenate([np.zeros(3), turned.as_quat()[[3, 0, 1, 2]]])


angles = st.floats(-np.pi, np.pi)
upright = st.builds(
    lambda yaw, sign, off, roll: pose(
        Rotation.from_euler("ZYX", [yaw, sign * (np.pi / 2 - off), roll])
    ),
    angles,
    st.sampled_from((-1, 1)),
    st.floats(0, 1e-3),
    angles,
)


def check(base: np.ndarray, tool: np.ndarray) -> None:
    tquat, xyzrpy = tool_in_base(base, tool)
    turned = (rotation(base).inv() * rotation(tool)).as_matrix()
    position = rotation(base).inv().apply(tool[:3] - base[:3])
    np.testing.assert_allclose(tquat[:3], position, atol=1e-5)
    np.testing.assert_allclose(Rotation.from_quat(tquat[3:]).as_matrix(), turned, atol=1e-5)
    np.testing.assert_allclose(xyzrpy[:3], position, atol=1e-5)
    # Near pitch = +-90 degrees the angles lose half their digits, but not the rotation that they
    # describe.
    np.testing.assert_allclose(
        Rotation.from_euler("xyz", xyzrpy[3:]).as_matrix(), turned, atol=2e-3
    )
    assert tquat.dtype == xyzrpy.dtype == np.float32
    assert tquat[6] >= 0.0


@given(poses, poses)
def test_the_tools_pose_is_that_of_the_matrices(base: np.ndarray, tool: np.ndarray) -> None:
    check(base, tool)


@given(upright)
def test_a_tool_that_points_straight_up_or_down_has_angles_that_make_up_its_rotation(
    tool: np.ndarray,
) -> None:
    check(pose(Rotation.identity()), tool)


def box(low: float, high: float, dim: int) -> SimpleNamespace:
    return SimpleNamespace(low=np.full(dim, low), high=np.full(dim, high), shape=(dim,))


def test_a_delta_pose_states_frame_rotation_and_gripper() -> None:
    spec = action_spec("pd_ee_delta_pose", box(-1.0, 1.0, 7), has_gripper=True)
    assert (spec.dim, spec.space, spec.delta, spec.rotation, spec.frame) == (
        7,
        "ee_pose",
        True,
        "euler_xyz",
        "base",
    )
    assert (spec.gripper_open, spec.gripper_closed, spec.low, spec.high) == (1.0, -1.0, -1.0, 1.0)


def test_what_is_not_known_or_differs_by_component_is_not_stated() -> None:
    spec = action_spec("pd_ee_delta_pose", box(-1.0, 1.0, 6), has_gripper=False)
    assert (spec.gripper_open, spec.gripper_closed) == (None, None)
    spec = action_spec("pd_joint_pos", box(-2.9, 2.9, 8), has_gripper=True)
    assert (spec.low, spec.high, spec.delta) == (None, None, False)
    spec = action_spec("a_mode_of_another_robot", box(-1.0, 1.0, 5), has_gripper=False)
    assert (spec.dim, spec.space, spec.delta) == (5, None, None)
