"""Anchored rows: wherever the robot is when an answer arrives, a row of motions leads it to the
pose for which the policy computed the row.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray import ActionSpec
from vlagents_ray.chunking.buffer import Chunk, ChunkBuffer
from vlagents_ray.columns import Columns
from vlagents_ray.envs.base import DELTA_POSE

UNSCALED = replace(DELTA_POSE, low=None, high=None)
SPECS: Mapping[str, ActionSpec] = {
    "joints": ActionSpec(dim=3, space="joint", delta=True, grippers=(2,)),
    "limited joints": ActionSpec(dim=3, space="joint", delta=True, low=-0.8, high=0.8),
    "a lower limit": ActionSpec(dim=2, delta=True, low=-0.6),
    "scaled pose": DELTA_POSE,
    "pose": UNSCALED,
    "scaled pose of the tool": replace(DELTA_POSE, frame="tool"),
    "pose of the tool": replace(UNSCALED, frame="tool"),
    "Euler angles": replace(UNSCALED, rotation="euler_xyz"),
    "quaternion": replace(UNSCALED, dim=8, rotation="quat_wxyz", frame="tool"),
    "rot6d": replace(UNSCALED, dim=10, rotation="rot6d"),
    "velocities": replace(UNSCALED, delta=None, space="ee_velocity"),
    "two arms": replace(UNSCALED, dim=14, arms=("left", "right")),
    "mixed": ActionSpec(dim=4, delta=True, absolute=(0,), grippers=(3,)),
    "absolute": ActionSpec(dim=3, delta=False, grippers=(2,)),
    "absolute pose": replace(UNSCALED, delta=False, rotation="quat_xyzw", dim=8),
    "not declared": ActionSpec(dim=3),
}
CASES = settings(max_examples=150, deadline=None)
NEAR = 2e-4  # the rounding of float32 over an episode


def columns_of(spec: ActionSpec) -> Columns:
    assert spec.dim is not None
    return Columns.from_spec(spec, spec.dim)


def rows_of(columns: Columns, random: np.random.Generator, count: int) -> np.ndarray:
    """Return rows of motions of up to 0.5 along each column, and of targets, (count, D)."""
    base = columns.still(np.zeros(columns.dim, np.float32))
    for rotation in columns.rotations:
        if not rotation.is_relative:
            base[rotation.start : rotation.stop] = np.eye(1, 4, 3)[0]
    return np.stack(
        [columns.moved(base, random.uniform(-0.5, 0.5, columns.dim).tolist()) for _ in range(count)]
    )


def distance(columns: Columns, pose: np.ndarray, other: np.ndarray) -> float:
    """Return the largest difference of two poses in a column of motions."""
    difference = columns.joined(columns.reversed(pose), other)
    return float(columns.reach(difference[np.newaxis]).max())


@dataclass
class World:
    """A robot with a pose that actions move, and the poses at which it was observed."""

    columns: Columns
    low: float
    high: float
    pose: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.pose = self.columns.still(np.zeros(self.columns.dim, np.float32))
        for rotation in self.columns.rotations:
            if not rotation.is_relative:
                self.pose[rotation.start : rotation.stop] = np.eye(1, 4, 3)[0]

    def possible(self, action: np.ndarray) -> np.ndarray:
        """Return an action as a controller with limits executes it."""
        possible = np.array(action, np.float32)
        bounded = set(self.columns.relative)
        for rotation in self.columns.rotations:
            bounded -= set() if rotation.is_linear else set(rotation.columns)
        numbers = sorted(bounded)
        possible[numbers] = np.clip(action[numbers], self.low, self.high)
        return possible

    def execute(self, action: np.ndarray) -> None:
        self.pose = self.columns.joined(self.pose, self.possible(action))

    def path(self, origin: np.ndarray, rows: np.ndarray, count: int) -> np.ndarray:
        """Return the pose that the first rows of a chunk reach from the pose of its observation."""
        pose = origin
        for row in rows[: max(0, count)]:
            pose = self.columns.joined(pose, self.possible(row))
        return pose


def world_of(spec: ActionSpec) -> World:
    low = -math.inf if spec.low is None else spec.low
    high = math.inf if spec.high is None else spec.high
    return World(columns_of(spec), low, high)


EVENTS = st.lists(
    st.tuples(
        st.sampled_from(["row"] * 6 + ["replaced", "moved", "still"]),
        st.booleans(),  # whether a request is due
        st.integers(0, 6),  # the ticks until its answer arrives
        st.sampled_from([False] * 5 + [True]),  # whether the answer is lost
        st.integers(1, 9),  # the rows of the answer
    ),
    min_size=3,
    max_size=30,
)
WEIGHTS = {"average": 0.5, "conservative": 0.3}


@CASES
@given(
    EVENTS,
    st.sampled_from(list(SPECS)),
    st.sampled_from(["newest", "newest", "average", "conservative", "ensemble"]),
    st.integers(0, 2**32 - 1),
)
def test_a_row_leads_to_the_pose_for_which_it_stands(
    events: list[tuple[str, bool, int, bool, int]], name: str, merge: str, seed: int
) -> None:
    spec = SPECS[name]
    world, random = world_of(spec), np.random.default_rng(seed)
    columns = world.columns
    plan = ChunkBuffer(merge, action=spec)
    chunks: list[tuple[Chunk, np.ndarray]] = []  # with the pose of the observation
    request: tuple[int, Chunk, np.ndarray, bool] | None = None
    reach = np.zeros(columns.dim, np.float32)

    for tick, (event, is_due, delay, is_lost, count) in enumerate(events):
        if request is None and is_due:
            rows = rows_of(columns, random, count)
            chunk = Chunk(tick, plan.executed, rows, tick=tick, origin=plan.origin())
            request = tick + delay, chunk, world.pose, is_lost
        if request is not None and request[0] <= tick:
            _, chunk, pose, lost = request
            request = None
            is_one_late = chunk.end == plan.executed and plan.next is None
            if not lost and plan.add(chunk):
                chunks.append((chunk._replace(step=chunk.step + is_one_late), pose))
                reach = np.maximum(reach, columns.reach(chunk.rows))

        step = plan.next
        action = rows_of(columns, random, 1)[0] if event != "row" or step is None else step.action
        if event == "row" and step is not None:
            active = [one for one in chunks if one[0].step <= plan.executed < one[0].end]
            used = active[-1:] if merge == "newest" else active
            rows = [chunk.rows[plan.executed - chunk.step] for chunk, _ in used]
            if columns.is_known:
                goals = [
                    world.path(pose, chunk.rows, plan.executed + 1 - chunk.step)
                    for chunk, pose in used
                ]
                rows = [columns.joined(columns.reversed(world.pose), goal) for goal in goals]
                for row, (chunk, _) in zip(rows, used, strict=True):
                    targets = list(columns.absolute)
                    row[targets] = chunk.rows[plan.executed - chunk.step][targets]
            merged = rows[0]
            for row in rows[1:]:
                newer = WEIGHTS.get(merge, 0.5)
                merged = columns.mean([merged, row], [1 - newer, newer])
            if merge == "ensemble":
                merged = columns.mean(rows, np.exp(-0.01 * np.arange(len(rows))))
            if step.is_corrected:
                merged = limited(columns, spec, reach, merged)
            assert distance(columns, merged, step.action) < NEAR
            targets = list(columns.absolute)
            assert step.action[targets] == pytest.approx(merged[targets], abs=1e-6)

            if not step.is_corrected and len(used) == 1:
                chunk = used[0][0]
                row = chunk.rows[plan.executed - chunk.step]
                assert step.action.tobytes() == row.tobytes()

        if event in ("row", "replaced") and (event == "replaced" or step is not None):
            plan.advance(action)
            world.execute(action)
        elif event == "moved":
            plan.move(action)
            world.execute(action)


def limited(
    columns: Columns, spec: ActionSpec, reach: np.ndarray, action: np.ndarray
) -> np.ndarray:
    """Return an action within the limits of the contract, or else of the largest motions."""
    low = -reach if spec.low is None else np.full(columns.dim, spec.low, np.float32)
    high = reach.copy() if spec.high is None else np.full(columns.dim, spec.high, np.float32)
    for rotation in columns.rotations:
        if not rotation.is_linear:
            high[list(rotation.columns)] = reach[list(rotation.columns)]
    return columns.limited(action, low, high)
