"""Over arms, kinds of columns, modes, disturbances and clocks: what nothing commands does not
change.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs, PlayerSettings
from vlagents_ray.chunking.buffer import Chunk, ChunkBuffer
from vlagents_ray.columns import Columns
from vlagents_ray.errors import ConfigError, PolicyUnavailable
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.interface import SAFE
from vlagents_ray.robot import Guard, MotionLimits

HZ = 50.0
WIDTHS = {"none": 0, "euler_xyz": 3, "axis_angle": 3, "quat_xyzw": 4, "quat_wxyz": 4, "rot6d": 6}
IDENTITY = {
    "none": [],
    "euler_xyz": [0, 0, 0],
    "axis_angle": [0, 0, 0],
    "quat_xyzw": [0, 0, 0, 1],
    "quat_wxyz": [1, 0, 0, 0],
    "rot6d": [1, 0, 0, 0, 1, 0],
}


@dataclass(frozen=True)
class Arm:
    """A kind of arm: each of its parts has a position, a rotation, a waist and a gripper."""

    rotation: str
    delta: bool
    has_absolute_waist: bool  # only beside deltas
    arms: int
    # Whether the arm declares its grippers by the names of its motors, not the policy's contract.
    names_grippers: bool

    @property
    def width(self) -> int:
        return 5 + WIDTHS[self.rotation]

    @property
    def dim(self) -> int:
        return self.arms * self.width

    @property
    def grippers(self) -> list[int]:
        return list(range(self.width - 1, self.dim, self.width))

    @property
    def spec(self) -> ActionSpec:
        waists = tuple(range(self.width - 2, self.dim, self.width))
        return ActionSpec(
            dim=self.dim,
            delta=self.delta,
            rotation=self.rotation,  # type: ignore[arg-type]
            absolute=waists if self.delta and self.has_absolute_waist else None,
            arms=tuple(f"arm{i}" for i in range(self.arms)),
            **({} if self.names_grippers else {"gripper_open": 1.0, "gripper_closed": 0.0}),  # type: ignore[arg-type]
        )

    @property
    def motors(self) -> ActionSpec:
        names = [f"motor{i}" for i in range(self.dim)]
        for gripper in self.grippers:
            names[gripper] = f"gripper{gripper}.pos"
        return ActionSpec(names=tuple(names))

    @property
    def columns(self) -> Columns:
        return Columns.from_spec(self.spec, self.dim, self.motors)

    def row(self, random: np.random.Generator, waist: float, gripper: float) -> np.ndarray:
        """Return a row whose motions are small, and whose targets are near those of other rows."""
        scale = 1e-3 if self.delta else 1e-2
        base = np.zeros(self.dim, np.float32)
        for part in range(self.arms):
            start = part * self.width + 3
            base[start : start + WIDTHS[self.rotation]] = IDENTITY[self.rotation]
        row = self.columns.moved(base, random.uniform(-scale, scale, self.dim).tolist())
        row[self.width - 2 :: self.width] = waist
        row[self.grippers] = gripper
        return row


ARMS = [
    Arm(rotation, delta, has_absolute_waist, arms, names_grippers)
    for rotation, delta, has_absolute_waist, arms, names_grippers in itertools.product(
        WIDTHS, (False, True), (False, True), (1, 2), (False, True)
    )
    if delta or not has_absolute_waist
]


class Working(Agent):
    """A policy that opens and closes its grippers, and whose server is sometimes unavailable."""

    contract: Contract | None = None

    def __init__(self, arm: Arm, random: np.random.Generator) -> None:
        self.contract = Contract(action=arm.spec)
        self._arm, self._random = arm, random
        self.fails = False
        self._waist = float(random.uniform(-1, 1)) if arm.has_absolute_waist else 0.0

    def act(self, obs: Obs) -> Act:
        if self.fails and self._random.random() < 0.25:
            raise PolicyUnavailable("the server restarts")
        gripper = float(self._random.integers(2))
        count = int(self._random.integers(1, 20))
        rows = [self._arm.row(self._random, self._waist, gripper) for _ in range(count)]
        return Act(np.stack(rows))


def require_unchanged(arm: Arm, command: np.ndarray, last: np.ndarray) -> None:
    """Assert that a command keeps all targets of the last one, and is no motion."""
    columns = arm.columns
    absolute = list(columns.absolute)
    assert command[absolute].tolist() == last[absolute].tolist()
    moves = columns.motion(command.tolist(), last.tolist())
    assert not any(moves[column] for column in columns.relative)


@pytest.mark.parametrize("mode", ["open_loop", "ensemble", "async"])
@pytest.mark.parametrize("limited", [False, True], ids=["free", "limits"])
@pytest.mark.parametrize("arm", ARMS, ids=str)
def test_nothing_changes_by_itself_on_an_arm(
    arm: Arm, limited: bool, mode: Literal["open_loop", "ensemble", "async"]
) -> None:
    random = np.random.default_rng(ARMS.index(arm))
    policy = Working(arm, random)
    limits = None
    if limited:
        free = [float("inf") if i in arm.grippers else 2.0 for i in range(arm.dim)]
        limits = MotionLimits(
            velocity=tuple(free), acceleration=tuple(25 * limit for limit in free)
        )
    pose = arm.row(random, 0.0, 0.5)  # the measured opening is not the gripper's goal
    measure = None if len(arm.columns.absolute) == arm.arms else (lambda _: pose)
    guard = Guard(policy.contract, limits=limits, hz=HZ, measure=measure, soft_start_s=0.0)
    settings = PlayerSettings(mode, deadline_s=30.0)

    is_mean = mode == "ensemble"  # a mean of two chunks may be a half-closed gripper
    commands: list[np.ndarray] = []
    with ChunkPlayer(policy, settings, check=guard) as player:
        player.join(arm.motors)
        player.initialize()
        player.reset(Obs())
        policy.fails = True
        for _ in range(60):
            event = random.random()
            if event < 0.05 and len(commands) > 1:
                player.interrupt()
                commands.pop()  # the robot did not execute it
            elif event < 0.1 and commands:
                player.control.pause()

            act = player.act(Obs())
            player.control.resume()
            grippers = act.action[arm.grippers].tolist()
            assert is_mean or set(grippers) <= {0.0, 1.0}
            if SAFE in act.info and commands:
                assert grippers == commands[-1][arm.grippers].tolist()
                if measure is None:
                    require_unchanged(arm, act.action, commands[-1])
            commands.append(act.action)


@pytest.mark.parametrize("mode", ["open_loop", "async"])
@pytest.mark.parametrize("arm", [arm for arm in ARMS if not arm.names_grippers], ids=str)
def test_nothing_changes_by_itself_in_real_time(arm: Arm, mode: str) -> None:
    random = np.random.default_rng(ARMS.index(arm))
    clock = ClockConfig(latency="measured", mode=mode)  # type: ignore[arg-type]
    env = Contract(action=arm.spec, control_hz=10)
    neutral = arm.columns.still().tolist()
    for rotation in arm.columns.rotations:
        neutral[rotation.start : rotation.stop] = IDENTITY[arm.rotation]
    if len(arm.columns.absolute) > arm.arms:
        with pytest.raises(ConfigError, match=r"clock\.neutral"):
            ChunkExecutor(None, clock, env)
        clock = clock.model_copy(update={"neutral": neutral})

    last: np.ndarray | None = None
    given: set[float] = set()
    for _task in range(3):
        executor = ChunkExecutor(4, clock, env, last)
        for _answer in range(6):
            gripper = float(random.integers(2))
            rows = np.stack([arm.row(random, 0.7, gripper) for _ in range(4)])
            given.add(gripper)
            for tick in executor.ticks(rows, float(random.choice([0.0, 0.2, 0.9]))):
                if last is not None:
                    allowed = {*given, *last[arm.grippers].tolist()}
                    assert set(tick.action[arm.grippers].tolist()) <= allowed
                if tick.starved and last is not None:
                    require_unchanged(arm, tick.action, last)
                last = tick.action


@pytest.mark.parametrize("merge", ["ensemble", "average", "weighted_average", "conservative"])
@pytest.mark.parametrize("rotation", [kind for kind in WIDTHS if kind != "none"])
def test_the_rotation_of_two_chunks_lies_between_theirs(rotation: str, merge: str) -> None:
    random = np.random.default_rng(len(rotation))
    for _ in range(50):
        arm = Arm(rotation, False, False, 1, False)
        columns = arm.columns
        upright = np.zeros(arm.dim, np.float32)
        upright[3 : 3 + WIDTHS[rotation]] = IDENTITY[rotation]
        turn = random.normal(size=3)
        turn *= random.uniform(2.8, 3.4) / np.linalg.norm(turn)  # near half a turn
        one = columns.moved(upright, [0, 0, 0, *turn, *[0] * (arm.dim - 6)])
        other = columns.moved(upright, [0, 0, 0, *(-turn), *[0] * (arm.dim - 6)])
        if rotation.startswith("quat"):
            other[3:7] *= random.choice([-1, 1])

        plan = ChunkBuffer(merge, action=arm.spec)
        plan.add(Chunk(0, 0, np.stack([one, one])))
        plan.add(Chunk(1, 0, np.stack([other, other])))
        step = plan.next
        assert step is not None
        whole = angle(columns, one, other)
        parts = angle(columns, one, step.action) + angle(columns, step.action, other)
        assert parts == pytest.approx(whole, abs=1e-4)


def angle(columns: Columns, one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between the rotations of two rows, rad."""
    difference: Any = columns.step(other.tolist(), one.tolist())
    return float(np.linalg.norm(difference[3:6]))
