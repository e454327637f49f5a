"""The arithmetic of rows: fractions, means and motions of targets, deltas, rotations and grippers.

Rotations are compared with rotation matrices, which are computed here in another way.
"""

from __future__ import annotations

import itertools
import json
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract, require_match
from vlagents_ray.errors import ConfigError, ContractMismatch, InvalidAction, MalformedMessage

WIDTHS = {"euler_xyz": 3, "axis_angle": 3, "quat_xyzw": 4, "quat_wxyz": 4, "rot6d": 6}
CASES = settings(max_examples=200, deadline=None)


def matrix_of(kind: str, numbers: Any) -> np.ndarray:
    """Return the rotation matrix, (3, 3), of the numbers of a rotation, by its definition."""
    numbers = np.asarray(numbers, np.float64)
    if kind == "euler_xyz":
        (cr, cp, cy), (sr, sp, sy) = np.cos(numbers), np.sin(numbers)
        about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
        about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
        about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
        return about_z @ about_y @ about_x  # type: ignore[no-any-return]
    if kind == "axis_angle":
        angle = np.linalg.norm(numbers)
        x, y, z = numbers / angle if angle > 0 else numbers
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross  # type: ignore[no-any-return]
    if kind == "rot6d":
        first, second = numbers[:3], numbers[3:]
        first = first / np.linalg.norm(first)
        second = second - (first @ second) * first
        second = second / np.linalg.norm(second)
        return np.stack([first, second, np.cross(first, second)], 1)

    w, x, y, z = numbers if kind == "quat_wxyz" else np.roll(numbers, 1)
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    return np.eye(3) + scale * np.array(  # type: ignore[no-any-return]
        [
            [-y * y - z * z, x * y - w * z, x * z + w * y],
            [x * y + w * z, -x * x - z * z, y * z - w * x],
            [x * z - w * y, y * z + w * x, -x * x - y * y],
        ]
    )


def angle_between(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle between two rotation matrices, rad."""
    # The sine of half the angle is exact for small angles, unlike the cosine of the angle.
    half_sine = float(np.linalg.norm(first - second)) / math.sqrt(8.0)
    return 2.0 * math.asin(min(1.0, half_sine))


def row_of(kind: str, vector: Any, *, flip: bool = False, scale: float = 1.0) -> list[float]:
    """Return numbers of a kind for a rotation vector; `flip` gives another representation of the
    same rotation.
    """
    vector = np.asarray(vector, np.float64)
    angle = float(np.linalg.norm(vector))
    axis = vector / angle if angle > 0 else np.array([1.0, 0.0, 0.0])
    if kind == "axis_angle":
        return list(vector - 2 * math.pi * axis) if flip else list(vector)

    matrix = matrix_of("axis_angle", vector)
    if kind == "rot6d":
        return [*(scale * matrix[:, 0]), *(scale * matrix[:, 1])]
    if kind == "euler_xyz":
        pitch = math.asin(np.clip(-matrix[2, 0], -1, 1))
        roll = math.atan2(matrix[2, 1], matrix[2, 2])
        yaw = math.atan2(matrix[1, 0], matrix[0, 0])
        return [roll + math.pi, math.pi - pitch, yaw - math.pi] if flip else [roll, pitch, yaw]

    w = math.cos(angle / 2)
    x, y, z = math.sin(angle / 2) * axis
    sign = -scale if flip else scale
    return [sign * number for number in ([w, x, y, z] if kind == "quat_wxyz" else [x, y, z, w])]


def pose_spec(kind: str, *, delta: bool, **fields: Any) -> ActionSpec:
    """Return actions of x, y, z, a rotation and a gripper."""
    return ActionSpec(
        dim=4 + WIDTHS[kind],
        space="ee_pose",
        delta=delta,
        rotation=kind,  # type: ignore[arg-type]
        gripper_open=1.0,
        gripper_closed=0.0,
        **fields,
    )


def columns_of(spec: ActionSpec) -> Columns:
    return Columns.from_spec(spec, spec.dim or 0)


KINDS = st.sampled_from(list(WIDTHS))
COMPONENTS = st.floats(-1.8, 1.8)
VECTORS = st.tuples(COMPONENTS, COMPONENTS, COMPONENTS)  # up to 3.12 rad, thus no half turn
NEAR_A_HALF_TURN = st.tuples(st.floats(3.0, 3.28), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
ROTATIONS = st.one_of(VECTORS, NEAR_A_HALF_TURN)
SHARES = st.floats(0.0, 1.0)


@st.composite
def rotation_rows(draw: st.DrawFn, kind: str) -> np.ndarray:
    """Draw a row of a pose and a gripper, with one of the equal representations of a rotation."""
    numbers = row_of(
        kind, draw(ROTATIONS), flip=draw(st.booleans()), scale=draw(st.floats(0.9, 1.1))
    )
    position = draw(VECTORS)
    return np.array([*position, *numbers, draw(SHARES)], np.float32)


def rotation_in(kind: str, row: np.ndarray) -> np.ndarray:
    return matrix_of(kind, row[3 : 3 + WIDTHS[kind]])


TOLERANCE = 3e-5  # rad; the numbers are float32


@CASES
@given(st.data(), KINDS, SHARES)
def test_a_rotation_on_the_way_lies_between_the_two_ends(
    data: st.DataObject, kind: str, share: float
) -> None:
    columns = columns_of(pose_spec(kind, delta=False))
    start, goal = data.draw(rotation_rows(kind)), data.draw(rotation_rows(kind))
    begin, end = rotation_in(kind, start), rotation_in(kind, goal)
    whole = angle_between(begin, end)
    if whole > math.pi - 1e-2:
        return  # opposite: every way is the shortest

    row = columns.travel(start, goal, 0.0, share)
    between = rotation_in(kind, row)
    assert angle_between(begin, between) == pytest.approx(share * whole, abs=TOLERANCE)
    assert angle_between(between, end) == pytest.approx((1 - share) * whole, abs=TOLERANCE)
    assert row[:3] == pytest.approx(start[:3] + share * (goal[:3] - start[:3]), abs=1e-5)


@CASES
@given(st.data(), KINDS, st.lists(st.floats(0.05, 1.0), min_size=2, max_size=4))
def test_a_mean_of_rotations_is_near_all_of_them(
    data: st.DataObject, kind: str, weights: list[float]
) -> None:
    columns = columns_of(pose_spec(kind, delta=False))
    rows = [data.draw(rotation_rows(kind)) for _ in weights]
    matrices = [rotation_in(kind, row) for row in rows]
    widest = max(angle_between(one, other) for one in matrices for other in matrices)
    mean = rotation_in(kind, columns.mean(rows, weights))

    if len(rows) == 2:
        if widest > math.pi - 1e-2:
            return
        from_first = angle_between(matrices[0], mean)
        from_second = angle_between(mean, matrices[1])
        assert from_first + from_second == pytest.approx(widest, abs=TOLERANCE)
        # The rotation with the larger weight is not the farther one.
        assert (from_first - from_second) * (weights[0] - weights[1]) < TOLERANCE
    elif widest < 2.0:  # beyond, rotations have no common half of all rotations
        assert max(angle_between(mean, matrix) for matrix in matrices) <= widest + TOLERANCE


@CASES
@given(KINDS, VECTORS, st.sampled_from(["base", "tool"]), st.integers(1, 6))
def test_parts_of_a_relative_rotation_are_together_the_rotation(
    kind: str, vector: tuple[float, float, float], frame: str, parts: int
) -> None:
    columns = columns_of(pose_spec(kind, delta=True, frame=frame))
    row = np.array([0.1, -0.2, 0.3, *row_of(kind, vector), 0.7], np.float32)
    edges = np.linspace(0.0, 1.0, parts + 1)
    commands = [columns.travel(row, row, begin, end) for begin, end in itertools.pairwise(edges)]

    turned = np.eye(3)
    for command in commands:
        turned = turned @ rotation_in(kind, command)
    assert angle_between(turned, rotation_in(kind, row)) < TOLERANCE * parts
    assert sum(command[:3] for command in commands) == pytest.approx(row[:3], abs=1e-5)
    assert [command[-1] for command in commands] == pytest.approx([0.7] * parts)

    joined = commands[0]
    for command in commands[1:]:
        joined = columns.joined(joined, command)
    assert angle_between(rotation_in(kind, joined), turned) < TOLERANCE * parts


@CASES
@given(KINDS, VECTORS, VECTORS, st.sampled_from(["base", "tool"]))
def test_two_relative_rotations_are_joined_in_the_order_of_their_frame(
    kind: str, first: tuple[float, float, float], second: tuple[float, float, float], frame: str
) -> None:
    columns = columns_of(pose_spec(kind, delta=True, frame=frame))
    rows = [np.array([0, 0, 0, *row_of(kind, v), 1.0], np.float32) for v in (first, second)]
    one, other = (rotation_in(kind, row) for row in rows)
    expected = one @ other if frame == "tool" else other @ one
    joined = rotation_in(kind, columns.joined(*rows))
    assert angle_between(joined, expected) < TOLERANCE

    pose = columns.still(rows[0])
    for row in rows:
        pose = columns.joined(pose, row)
    assert angle_between(rotation_in(kind, pose), expected) < TOLERANCE


@CASES
@given(st.data(), KINDS, st.booleans())
def test_the_motion_of_a_row_moves_the_last_row_onto_it(
    data: st.DataObject, kind: str, delta: bool
) -> None:
    columns = columns_of(pose_spec(kind, delta=delta))
    last, row = data.draw(rotation_rows(kind)), data.draw(rotation_rows(kind))
    motion = columns.motion(row.tolist(), last.tolist())
    again = columns.moved(last, motion)
    assert angle_between(rotation_in(kind, again), rotation_in(kind, row)) < 2 * TOLERANCE
    assert again[:3] == pytest.approx(row[:3], abs=1e-5)
    assert again[-1] == pytest.approx(row[-1], abs=1e-5)

    before = np.eye(3) if delta else rotation_in(kind, last)
    turn = np.linalg.norm(motion[3:6])
    assert turn == pytest.approx(angle_between(before, rotation_in(kind, row)), abs=2 * TOLERANCE)
    assert not any(motion[6 : 3 + WIDTHS[kind]])


@CASES
@given(KINDS, VECTORS, SHARES)
def test_a_numeric_neighbor_of_the_goal_is_returned(
    kind: str, vector: tuple[float, float, float], share: float
) -> None:
    columns = columns_of(pose_spec(kind, delta=False))
    if 0.0 < np.linalg.norm(vector) < 0.01:
        return  # the axis of a small rotation is only known to the rounding of float32
    start = np.array([0, 0, 0, *row_of(kind, vector), 1.0], np.float32)
    near = np.array(vector) * 1.001
    for flip in (False, True):
        goal = np.array([0, 0, 0, *row_of(kind, near, flip=flip), 1.0], np.float32)
        row = columns.travel(start, goal, 0.0, share)
        is_upright = kind == "euler_xyz" and abs(math.cos(goal[4])) < 0.1
        if not is_upright:  # roll and yaw change quickly there
            assert row[3:-1] == pytest.approx(goal[3:-1], abs=0.1)


@CASES
@given(st.data())
def test_no_motion_keeps_every_target(data: st.DataObject) -> None:
    kind = data.draw(KINDS)
    arms = data.draw(st.integers(1, 3))
    width = 3 + WIDTHS[kind] + 2  # a pose, another joint and a gripper
    dim = arms * width
    delta = data.draw(st.booleans())
    waists = [arm * width + width - 2 for arm in range(arms)]
    absolute = tuple(data.draw(st.sets(st.sampled_from(waists)))) if delta else None
    spec = ActionSpec(
        dim=dim,
        delta=delta,
        rotation=kind,  # type: ignore[arg-type]
        absolute=absolute,
        gripper_closed=0.0,
        arms=tuple(f"arm{arm}" for arm in range(arms)),
    )
    columns = Columns.from_spec(spec, dim)
    last = np.array(data.draw(st.lists(COMPONENTS, min_size=dim, max_size=dim)), np.float32)
    still = columns.still(last)

    for column in range(dim):
        is_gripper = column % width == width - 1
        is_target = not delta or is_gripper or column in (absolute or ())
        assert (column in columns.absolute) == is_target
        if is_target:
            assert still[column] == last[column]
    if delta:
        assert not any(columns.motion(still.tolist(), still.tolist()))
        pose = columns.moved(still, data.draw(st.lists(COMPONENTS, min_size=dim, max_size=dim)))
        executed = columns.joined(pose, still)
        for rotation in columns.rotations:
            part = slice(rotation.start, rotation.stop)
            before, after = matrix_of(kind, pose[part]), matrix_of(kind, executed[part])
            assert angle_between(before, after) < 2 * TOLERANCE


def test_numbers_with_a_factor_are_scaled_and_added() -> None:
    for spec in (
        pose_spec("euler_xyz", delta=True, low=-1.0, high=1.0),
        ActionSpec(7, "ee_velocity", rotation="axis_angle", gripper_open=1.0),
    ):
        columns = columns_of(spec)
        row = np.array([0.1, 0.2, 0.3, 0.9, -0.8, 0.7, 1.0], np.float32)
        half = columns.travel(row, row, 0.25, 0.75)
        assert half[:6] == pytest.approx(row[:6] / 2)
        assert columns.joined(half, half)[:6] == pytest.approx(row[:6])
        assert columns.mean([row, half], [1.0, 1.0])[3:6] == pytest.approx(0.75 * row[3:6])
        assert columns.motion(row.tolist(), half.tolist())[3:6] == pytest.approx(row[3:6])


def test_the_ends_of_a_way_are_the_rows_themselves() -> None:
    columns = columns_of(pose_spec("quat_wxyz", delta=False))
    goal = np.array([0.1, 0.2, 0.3, -0.9, 0, 0, 0, 1.0], np.float32)  # not of length 1
    assert (columns.travel(goal, goal, 0.0, 1.0) == goal).all()
    assert (columns.travel(goal, goal, 0.5, 1.0) == goal).all()


@pytest.mark.parametrize("kind", ["quat_wxyz", "quat_xyzw", "rot6d"])
def test_numbers_without_a_direction_are_no_rotation(kind: str) -> None:
    columns = columns_of(pose_spec(kind, delta=True))
    with pytest.raises(InvalidAction, match=kind):
        columns.require_rotations([0.0] * columns.dim)
    columns.require_rotations(columns.still().tolist())


ARM = ActionSpec(names=("shoulder.pos", "elbow.pos", "gripper.pos"))
BASE = ActionSpec(names=("shoulder.pos", "x.vel", "gripper.pos"))


@pytest.mark.parametrize(
    ("spec", "arm", "grippers", "relative"),
    [
        (ActionSpec(delta=False), None, (), ()),
        (ActionSpec(delta=False), ARM, (2,), ()),
        (ActionSpec(delta=True), ARM, (2,), (0, 1)),
        (ActionSpec(delta=False), BASE, (2,), (1,)),
        (ActionSpec(), BASE, (2,), (1,)),
        (ActionSpec(delta=True), ActionSpec(gripper_open=1.0), (2,), (0, 1)),
        (ActionSpec(delta=True, gripper_closed=0.0), None, (2,), (0, 1)),
        (ActionSpec(delta=True, absolute=(0,)), ARM, (2,), (1,)),
        (ActionSpec(space="joint_velocity", absolute=(0,)), ARM, (2,), (1,)),
        (ActionSpec(names=("Left_Gripper", "a", "b"), gripper_open=1.0), None, (0,), ()),
        (ActionSpec(names=("a", "b"), gripper_open=1.0), None, (2,), ()),
        (ActionSpec(delta=False), ActionSpec(grippers=(0,)), (0,), ()),
        (ActionSpec(delta=True, gripper_open=1.0), ActionSpec(grippers=(0,)), (0, 2), (1,)),
        (ActionSpec(names=("a", "gripper", "b"), grippers=()), None, (), ()),
    ],
)
def test_policy_and_arm_declare_grippers_and_motions_together(
    spec: ActionSpec, arm: ActionSpec | None, grippers: tuple[int, ...], relative: tuple[int, ...]
) -> None:
    columns = Columns.from_spec(spec, 3, arm)
    assert columns.grippers == grippers
    assert columns.relative == relative
    assert sorted(columns.relative + columns.absolute) == [0, 1, 2]
    assert columns.is_known == (spec.relative is not None)


def test_a_rotation_may_be_beside_joints() -> None:
    spec = ActionSpec(delta=True, rotation="axis_angle", rotation_columns=(5,), absolute=(0, 1))
    columns = Columns.from_spec(spec, 9)
    assert [rotation.columns for rotation in columns.rotations] == [(5, 6, 7)]
    assert columns.units == (None, None, "m", "m", "m", "rad", "rad", "rad", None)
    assert columns.absolute == (0, 1)


def test_the_opening_of_a_gripper_is_between_the_ends_of_either_contract() -> None:
    spec = ActionSpec(delta=False, gripper_open=1.0)
    assert Columns.from_spec(spec, 2).gripper_command(1.0) == 1.0
    for unknown in (0.0, 0.9):
        assert Columns.from_spec(spec, 2).gripper_command(unknown) is None
    columns = Columns.from_spec(spec, 2, ActionSpec(gripper_open=5.0, gripper_closed=-1.0))
    assert columns.gripper_command(0.25) == -0.5


@pytest.mark.parametrize(
    ("spec", "dim", "match"),
    [
        (ActionSpec(delta=False, absolute=(1,)), 3, "delta=True"),
        (ActionSpec(absolute=(1,)), 3, "delta=True"),
        (ActionSpec(delta=True, absolute=(3,)), 3, "from 0 to 2"),
        (ActionSpec(delta=True, absolute=(-1,)), 3, "from 0 to 2"),
        (ActionSpec(grippers=(3,)), 3, "grippers: expected columns from 0 to 2"),
        (ActionSpec(delta=True, absolute=(4,), rotation="axis_angle"), 7, "a target or a motion"),
        (ActionSpec(rotation_columns=(3,)), 7, "`rotation`"),
        (ActionSpec(rotation="none", rotation_columns=(3,)), 7, "`rotation`"),
        (ActionSpec(rotation="axis_angle"), 3, "rotation_columns"),
        (ActionSpec(rotation="rot6d"), 8, "6 numbers"),
        (ActionSpec(rotation="rot6d", rotation_columns=(0, 5)), 12, "6 numbers"),
        (ActionSpec(rotation="rot6d", rotation_columns=(-1,)), 12, "6 numbers"),
        (ActionSpec(rotation="axis_angle", arms=("a", "b")), 10, "3 numbers"),
        (ActionSpec(rotation="axis_angle", gripper_open=1.0), 6, "gripper"),
        (ActionSpec(space="joint", rotation="axis_angle"), 7, "joints"),
        (ActionSpec(space="ee_velocity", rotation="rot6d"), 9, "velocities"),
        (ActionSpec(gripper_open=1.0, gripper_closed=1.0), 3, "both"),
        (ActionSpec(arms=("a", "b"), gripper_open=1.0), 3, "2 arms"),
    ],
)
def test_a_contract_without_a_meaning_is_an_error(spec: ActionSpec, dim: int, match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        Columns.from_spec(spec, dim)


def test_grippers_of_an_arm_with_more_numbers_are_an_error() -> None:
    arm = ActionSpec(grippers=(7,))
    with pytest.raises(ConfigError, match="from 0 to 2"):
        Columns.from_spec(ActionSpec(delta=False), 3, arm)


def test_the_columns_are_part_of_the_contract() -> None:
    contract = Contract(
        action=ActionSpec(delta=True, absolute=(6,), rotation="rot6d", rotation_columns=(0,))
    )
    document = json.loads(json.dumps(contract.to_json()))
    assert Contract.from_json(document) == contract
    assert "absolute" not in Contract().to_json()["action"]
    for wrong in (6, "6", [6.0], [True], ["6"]):
        document["action"]["absolute"] = wrong
        with pytest.raises(MalformedMessage, match="absolute"):
            Contract.from_json(document)

    with pytest.raises(ContractMismatch, match=r"action\.absolute"):
        require_match(contract, Contract(action=ActionSpec(absolute=(5,))))


@CASES
@given(st.data(), KINDS, st.sampled_from(["base", "tool"]), st.booleans())
def test_what_is_left_of_a_motion_completes_it(
    data: st.DataObject, kind: str, frame: str, is_scaled: bool
) -> None:
    bounds = {"low": -4.0, "high": 4.0} if is_scaled else {}
    columns = columns_of(pose_spec(kind, delta=True, frame=frame, **bounds))
    whole, part = data.draw(rotation_rows(kind)), data.draw(rotation_rows(kind))
    for executed, left in ((part, columns.remaining(whole, part)), (whole, columns.still(whole))):
        together = columns.joined(executed, left)
        assert together[:3] == pytest.approx(whole[:3], abs=1e-4)
        after, expected = rotation_in(kind, together), rotation_in(kind, whole)
        assert angle_between(after, expected) < 3 * TOLERANCE
    back = columns.joined(part, columns.reversed(part))
    assert columns.reach(back[np.newaxis]) == pytest.approx(0.0, abs=1e-4)
    assert columns.reversed(part)[-1] == part[-1], "a target is no motion"


@CASES
@given(st.data(), KINDS)
def test_in_the_frame_of_the_tool_motions_are_those_of_rigid_bodies(
    data: st.DataObject, kind: str
) -> None:
    columns = columns_of(pose_spec(kind, delta=True, frame="tool"))
    first, second = data.draw(rotation_rows(kind)), data.draw(rotation_rows(kind))
    joined = columns.joined(first, second)
    turned = rotation_in(kind, first) @ second[:3].astype(np.float64)
    assert joined[:3] == pytest.approx(first[:3] + turned, abs=1e-4)


@CASES
@given(st.data(), KINDS, st.floats(0.01, 3.0))
def test_limited_motions_keep_their_direction(
    data: st.DataObject, kind: str, largest: float
) -> None:
    columns = columns_of(pose_spec(kind, delta=True))
    row = data.draw(rotation_rows(kind))
    high = np.full(columns.dim, largest, np.float32)
    limited = columns.limited(row, -high, high)
    assert limited[:3] == pytest.approx(np.clip(row[:3], -largest, largest))
    angles = [angle_between(np.eye(3), rotation_in(kind, one)) for one in (row, limited)]
    assert angles[1] == pytest.approx(min(angles[0], largest), abs=1e-3)
    between = angle_between(rotation_in(kind, limited), rotation_in(kind, row))
    assert between == pytest.approx(angles[0] - angles[1], abs=2e-3)
    assert limited[-1] == row[-1]
    assert columns.reach(np.stack([row, limited]))[3] == pytest.approx(angles[0], abs=1e-3)
