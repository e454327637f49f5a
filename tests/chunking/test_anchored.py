"""Anchored rows: wherever the robot is when an answer arrives, a row of motions leads it to the
pose for which the policy computed the row.
"""

from __future__ import annotations

import math
import pickle
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from delayed_caller import Delayed
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs, PlayerSettings
from vlagents_ray.chunking import player as player_module
from vlagents_ray.chunking.buffer import Chunk, ChunkBuffer
from vlagents_ray.columns import Columns
from vlagents_ray.envs.base import DELTA_POSE
from vlagents_ray.errors import InvalidAction, PolicyUnavailable
from vlagents_ray.interface import DELAY, LEFTOVER
from vlagents_ray.robot import Guard, MotionLimits

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


class Wandering(Agent):
    """A policy with rows of random motions, which remembers the pose of each observation."""

    contract: Contract | None = None

    def __init__(self, spec: ActionSpec, random: np.random.Generator, scale: float) -> None:
        self.contract = Contract(action=spec)
        self._columns, self._random, self._scale = columns_of(spec), random, scale
        self.rows, self.is_lost = 5, False
        self.poses: dict[bytes, np.ndarray] = {}  # the pose of the observation, by the rows

    def reset(self, obs: Obs, instruction: str | None = None, **_: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        if self.is_lost:
            raise PolicyUnavailable("the connection was lost")
        rows = rows_of(self._columns, self._random, self.rows)
        rows[:, list(self._columns.relative)] *= self._scale
        for rotation in self._columns.rotations:  # the products are not scaled number by number
            if not rotation.is_linear:
                part = rows_of(self._columns, self._random, self.rows)
                rows[:, list(rotation.columns)] = part[:, list(rotation.columns)]
        self.poses[rows.tobytes()] = np.array(obs.state["pose"])
        return Act(rows)


class Faulty(Delayed):
    """A caller whose policy may fail."""

    def ask(self, obs: Obs) -> None:
        try:
            super().ask(obs)
        except PolicyUnavailable as error:
            self._answer, self._left = error, self.delay  # type: ignore[assignment]


class Operator:
    """A device that moves the arm while it is engaged."""

    def __init__(self, columns: Columns, random: np.random.Generator) -> None:
        self.is_engaged = False
        self._columns, self._random = columns, random

    def engaged(self) -> bool:
        return self.is_engaged

    def action(self, obs: Obs) -> np.ndarray:
        action = rows_of(self._columns, self._random, 1)[0]
        action[list(self._columns.relative)] *= 0.02
        for rotation in self._columns.rotations:
            if not rotation.is_linear:
                action[rotation.start : rotation.stop] = self._columns.still()[
                    rotation.start : rotation.stop
                ]
        return action


TICKS = st.lists(
    st.tuples(
        st.sampled_from(["run"] * 12 + ["operate", "pause", "stop", "own action", "lose"]),
        st.integers(0, 5),  # the delay of the next answer
        st.integers(1, 9),  # the rows of the next answer
    ),
    min_size=10,
    max_size=50,
)
GUARDED = {
    "joints": (SPECS["joints"], 0.02),
    "limited joints": (SPECS["limited joints"], 0.02),
    "mixed": (SPECS["mixed"], 0.02),
    "scaled pose": (DELTA_POSE, 0.02),
}


@settings(max_examples=120, deadline=None)
@given(
    TICKS,
    st.sampled_from([*GUARDED, *SPECS]),
    st.booleans(),
    st.sampled_from(
        [
            {"mode": "async"},
            {"mode": "async", "execute": 3},
            {"mode": "async", "merge": "average"},
            {"mode": "ensemble", "deadline_s": 0.0},
            {"mode": "open_loop", "deadline_s": 0.0},
        ]
    ),
    st.integers(0, 2**32 - 1),
)
def test_a_plan_knows_the_way_to_the_path_of_each_chunk(
    ticks: list[tuple[str, int, int]],
    name: str,
    has_limits: bool,
    player_settings: dict[str, Any],
    seed: int,
) -> None:
    spec, scale = GUARDED.get(name, (SPECS[name], 1.0))
    has_limits = has_limits and name in GUARDED
    random = np.random.default_rng(seed)
    world, policy = world_of(spec), Wandering(spec, random, scale if has_limits else 1.0)
    columns = world.columns
    operator = Operator(columns, random)
    limits = MotionLimits(velocity=1.0, acceleration=15.0, jerk=600.0)
    guard = Guard(policy.contract, limits=limits, hz=20.0, soft_start_s=0.0)
    caller = type("Caller", (Faulty,), {"delay": 0})
    safe = "auto" if columns.is_known else "hold"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(player_module, "AsyncCaller", caller)
        player = ChunkPlayer(
            policy,
            PlayerSettings(safe=safe, fresh_grip=None, **player_settings),
            check=guard if has_limits else None,
            override=operator,
        )
        player.reset(observed(world))
        for event, delay, rows in ticks:
            caller.delay, policy.rows = delay, rows
            policy.is_lost = event == "lose"
            operator.is_engaged = event == "operate"
            if event == "pause":
                player.control.pause()
            else:
                player.control.resume()
            action = operator.action(observed(world))
            try:
                if event == "own action":
                    player.observe(observed(world), action)
                else:
                    action = player.act(observed(world)).action
            except InvalidAction:  # such as a pause before the opening of the gripper is known
                continue
            if event == "stop":
                player.interrupt()
            else:
                world.execute(action)
            require_ways(player, policy, world)


def observed(world: World) -> Obs:
    return Obs(state={"pose": world.pose.copy()})


def require_ways(player: ChunkPlayer, policy: Wandering, world: World) -> None:
    """Require that the way of each chunk of the plan leads to the path of the chunk."""
    plan, columns = player._plan, world.columns
    if not columns.is_known or not columns.relative:
        return
    begun = world.pose  # the pose at which the next row begins, of which a part may be executed
    if plan._part is not None:
        begun = columns.joined(world.pose, columns.reversed(plan._part))
    for planned in plan._chunks:
        plan._update(planned)
        rows = planned.chunk.rows
        pose = policy.poses[rows.tobytes()]
        goal = world.path(pose, rows, plan.executed - planned.chunk.step)
        way = columns.still(begun) if planned.way is None else planned.way
        assert distance(columns, columns.joined(begun, way), goal) < 5 * NEAR


def test_a_policy_that_amplifies_its_prefix_stays_within_the_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Amplifying(Agent):
        contract = Contract(action=SPECS["limited joints"])

        def reset(self, obs: Obs, instruction: str | None = None, **_: Any) -> dict[str, Any]:
            return {}

        def act(self, obs: Obs) -> Act:
            rows = np.full((8, 3), 0.5, np.float32)
            leftover = obs.info.get(LEFTOVER)
            if leftover is not None:
                given = max(1, obs.info[DELAY])
                assert np.abs(leftover).max() <= np.float32(0.8)
                rows[: len(leftover)] = 1.1 * leftover[:8]
                rows[given:] = 1.1 * leftover[-1]
            self.largest = float(np.abs(rows).max())
            return Act(rows)

    policy = Amplifying()
    monkeypatch.setattr(player_module, "AsyncCaller", type("Caller", (Delayed,), {"delay": 2}))
    with ChunkPlayer(policy, PlayerSettings(mode="async", real_time_chunking=True)) as player:
        player.reset(Obs())
        for _ in range(300):
            player.act(Obs())
        assert player._chunks > 100
    assert policy.largest <= 1.1 * 0.8 + 1e-6


def test_a_plan_that_moves_with_its_session_continues() -> None:
    random = np.random.default_rng(0)
    plan = ChunkBuffer(action=DELTA_POSE)
    for step in range(3):
        plan.add(Chunk(step, plan.executed, rows_of(columns_of(DELTA_POSE), random, 6)))
        plan.advance(rows_of(columns_of(DELTA_POSE), random, 1)[0])
    moved: ChunkBuffer = pickle.loads(pickle.dumps(plan))  # noqa: S301 - our own bytes
    for _ in range(3):
        here, there = plan.take(), moved.take()
        assert here.action.tobytes() == there.action.tobytes()
        assert here.is_corrected == there.is_corrected
