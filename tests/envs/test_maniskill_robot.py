"""Poses in the robot's base frame, and what the control modes say about themselves."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from vlagents_ray.envs.maniskill.simulator import action_spec, tool_in_base

numbers = st.floats(-2.0, 2.0, width=32)
quaternions = (
    st.tuples(numbers, numbers, numbers, numbers)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
poses = st.tuples(st.tuples(numbers, numbers, numbers).map(np.array), quaternions).map(np.concatenate)


def turn(quat_wxyz: np.ndarray) -> np.ndarray:
    w, x, y, z = quat_wxyz
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def about(axis: int, angle: float) -> np.ndarray:
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = np.cos(angle)
    matrix[j, i], matrix[i, j] = np.sin(angle), -np.sin(angle)
    return matrix


def about_axes(yaw: float, pitch: float, roll: float) -> np.ndarray:
    """The pose whose quaternion wxyz is of Rz(yaw) Ry(pitch) Rx(roll)."""
    (cy, cp, cr), (sy, sp, sr) = np.cos(np.array([yaw, pitch, roll]) / 2), np.sin(np.array([yaw, pitch, roll]) / 2)
    quaternion = [
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]
    return np.array([0.0, 0.0, 0.0, *quaternion])


angles = st.floats(-np.pi, np.pi)
upright = st.builds(
    about_axes,
    angles,
    st.builds(lambda sign, off: sign * (np.pi / 2 - off), st.sampled_from((-1, 1)), st.floats(0, 1e-3)),
    angles,
)


def check(base: np.ndarray, tool: np.ndarray) -> None:
    tquat, xyzrpy = tool_in_base(base, tool)
    rotation = turn(base[3:]).T @ turn(tool[3:])
    position = turn(base[3:]).T @ (tool[:3] - base[:3])
    np.testing.assert_allclose(tquat[:3], position, atol=1e-5)
    np.testing.assert_allclose(turn(tquat[[6, 3, 4, 5]]), rotation, atol=1e-5)
    np.testing.assert_allclose(xyzrpy[:3], position, atol=1e-5)
    roll, pitch, yaw = xyzrpy[3:]
    # near pitch = +-90 degrees the angles lose half their digits, the rotation they make up does not
    np.testing.assert_allclose(about(2, yaw) @ about(1, pitch) @ about(0, roll), rotation, atol=2e-3)
    assert tquat.dtype == xyzrpy.dtype == np.float32
    assert tquat[6] >= 0.0


@given(poses, poses)
def test_the_tools_pose_is_that_of_the_matrices(base: np.ndarray, tool: np.ndarray) -> None:
    check(base, tool)


@given(upright)
def test_a_tool_that_points_straight_up_or_down_has_angles_that_make_up_its_rotation(tool: np.ndarray) -> None:
    check(about_axes(0.0, 0.0, 0.0), tool)


def box(low: float, high: float, dim: int) -> SimpleNamespace:
    return SimpleNamespace(low=np.full(dim, low), high=np.full(dim, high), shape=(dim,))


def test_a_delta_pose_states_frame_rotation_and_gripper() -> None:
    spec = action_spec("pd_ee_delta_pose", box(-1.0, 1.0, 7), has_gripper=True)
    assert (spec.dim, spec.space, spec.delta, spec.rotation, spec.frame) == (7, "ee_pose", True, "euler_xyz", "base")
    assert (spec.gripper_open, spec.gripper_closed, spec.low, spec.high) == (1.0, -1.0, -1.0, 1.0)


def test_what_is_not_known_or_differs_by_component_is_not_stated() -> None:
    spec = action_spec("pd_ee_delta_pose", box(-1.0, 1.0, 6), has_gripper=False)
    assert (spec.gripper_open, spec.gripper_closed) == (None, None)
    spec = action_spec("pd_joint_pos", box(-2.9, 2.9, 8), has_gripper=True)
    assert (spec.low, spec.high, spec.delta) == (None, None, False)
    spec = action_spec("a_mode_of_another_robot", box(-1.0, 1.0, 5), has_gripper=False)
    assert (spec.dim, spec.space, spec.delta) == (5, None, None)
