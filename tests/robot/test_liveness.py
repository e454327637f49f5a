"""Each plan within half of the limits is executed within a bounded time, from any initial pose of
the arm.
"""

from __future__ import annotations

import time
from typing import Literal

import numpy as np
import pytest

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs, PlayerSettings
from vlagents_ray.interface import SAFE
from vlagents_ray.robot import Guard, MotionLimits

SPEED, ACCELERATION, JERK = 1.5, 15.0, 600.0  # the limits in docs/guard.md
RUN_S = 4.0
RUNS = 25  # runs per test; four seeds make 100


class Swinging(Agent):
    """A policy that plans a sine for one joint, at a share of the strictest limit. Row k of the
    plan is the same in each answer.
    """

    contract: Contract | None = None

    def __init__(
        self,
        random: np.random.Generator,
        hz: float,
        share: float,
        *,
        delta: bool,
        chunk: int | None = None,
    ) -> None:
        self.contract = Contract(action=ActionSpec(dim=1, space="joint", delta=delta))
        self._chunk = chunk or int(2 * RUN_S * hz)
        self._delta, self._hz = delta, hz
        self._turn = 2 * np.pi * random.uniform(0.05, 3.0)  # rad/s
        self._phase = random.uniform(0, 2 * np.pi)
        strictest = min(SPEED / self._turn, ACCELERATION / self._turn**2, JERK / self._turn**3)
        self._radius = share * strictest

    def pose(self, row: np.ndarray | float) -> np.ndarray:
        """Return the pose at a row of the plan."""
        return self._radius * np.sin(self._turn * np.asarray(row) / self._hz + self._phase)

    def act(self, obs: Obs) -> Act:
        rows = int(obs.state["row"][0]) + np.arange(self._chunk)
        actions = self.pose(rows)
        if self._delta:
            actions = actions - self.pose(rows - 1)
        return Act(actions[:, None].astype(np.float32))


def executed(
    random: np.random.Generator,
    mode: Literal["open_loop", "async"],
    share: float,
    soft_start_s: float,
    *,
    delta: bool,
    chunk: int | None = None,
) -> tuple[float, int]:
    """Return the share of a run's ticks that were rows of the plan, and the number of rejected
    actions.

    With a given `chunk` length, each answer arrives within a tick.
    """
    hz = float(random.choice([10, 30, 50, 100]))
    policy = Swinging(random, hz, share, delta=delta, chunk=chunk)
    # Initial poses at the first row, one row before it, between rows, and ahead of the first row.
    pose = np.float32(policy.pose(random.choice([0.0, -1.0, -0.5, 0.3])))
    guard = Guard(
        policy.contract,
        limits=MotionLimits(velocity=SPEED, acceleration=ACCELERATION, jerk=JERK),
        hz=hz,
        measure=None if delta else (lambda obs: obs.state["joints"]),
        soft_start_s=soft_start_s,
    )
    settings = PlayerSettings(
        mode, deadline_s=30.0, safe=np.zeros(1, np.float32) if delta else "hold"
    )
    ticks, refused = int(RUN_S * hz), 0
    with ChunkPlayer(policy, settings, check=guard) as player:
        player.initialize()

        def observed() -> Obs:
            row = np.array([player._plan.executed], np.float32)
            return Obs(state={"joints": np.array([pose], np.float32), "row": row})

        player.reset(observed())
        for _ in range(ticks):
            while chunk is not None and player._caller is not None and player._caller.busy:
                time.sleep(0)
            act = player.act(observed())
            refused += act.info.get("safe_cause") in ("dynamics", "max_step", "limits")
            assert SAFE not in act.info or act.info["safe_cause"] in (
                "dynamics",
                "max_step",
                "waiting",
            )
            pose = np.float32(pose + act.action[0]) if delta else act.action[0]
        return player._plan.executed / ticks, refused


@pytest.mark.slow
@pytest.mark.parametrize("delta", [False, True], ids=["absolute", "relative"])
@pytest.mark.parametrize(
    ("share", "soft_start_s"),
    [(0.5, 0.0), (0.25, 120.0)],
    ids=["half of the limits", "half in the soft start"],
)
@pytest.mark.parametrize("seed", range(4))
def test_a_plan_within_half_of_the_limits_is_executed(
    delta: bool, share: float, soft_start_s: float, seed: int
) -> None:
    random = np.random.default_rng(seed)
    for _ in range(RUNS):
        rows, refused = executed(random, "open_loop", share, soft_start_s, delta=delta)
        assert refused == 0
        assert rows > 0.5, "the ease-in must end within half of the run"


@pytest.mark.parametrize("delta", [False, True], ids=["absolute", "relative"])
def test_answers_during_the_ease_in_do_not_keep_the_robot_from_moving(delta: bool) -> None:
    random = np.random.default_rng(9)
    for _ in range(5):
        rows, _ = executed(random, "async", 0.5, 0.0, delta=delta)
        assert rows > 0.3


@pytest.mark.slow
@pytest.mark.parametrize("delta", [False, True], ids=["absolute", "relative"])
@pytest.mark.parametrize(
    ("mode", "chunk", "at_least"),
    [
        ("open_loop", 1, 0.8),
        ("open_loop", 2, 0.8),
        ("open_loop", 3, 0.8),
        ("open_loop", 8, 0.8),
        ("async", 3, 0.8),
        ("async", 8, 0.8),
    ],
)
def test_a_plan_of_chunks_shorter_than_the_ramp_is_executed(
    mode: Literal["open_loop", "async"], chunk: int, at_least: float, *, delta: bool
) -> None:
    random = np.random.default_rng(chunk)
    for _ in range(RUNS):
        rows, _ = executed(random, mode, 0.5, 0.0, delta=delta, chunk=chunk)
        assert rows > at_least


class Moving(Agent):
    """A policy of a few rows for joints that already move when the robot begins at rest.

    With `follows`, the rows begin at the observed pose; otherwise, they are rows of a fixed path.
    """

    contract: Contract | None = None

    def __init__(self, random: np.random.Generator, hz: float, *, follows: bool) -> None:
        self.joints = int(random.integers(1, 4))
        self.rows = int(random.choice([1, 2, 3, 4, 8, 16]))
        self.delta = bool(random.integers(2))
        self.executed = 0  # the number of executed rows
        self._follows, self._hz = follows, hz
        self._turn = random.uniform(0.3, 3.0, self.joints)  # rad/s
        self._phase = random.uniform(0, 2 * np.pi, self.joints)
        limits = SPEED / self._turn, ACCELERATION / self._turn**2, JERK / self._turn**3
        self._radius = random.uniform(0.1, 0.8) * np.minimum.reduce(limits)
        self.contract = Contract(
            action=ActionSpec(dim=self.joints, space="joint", delta=self.delta)
        )

    def pose(self, row: int) -> np.ndarray:
        return -self._radius * np.cos(self._turn * row / self._hz + self._phase)  # type: ignore[no-any-return]

    def act(self, obs: Obs) -> Act:
        begin = self.pose(self.executed)
        start = obs.state["joints"] if self._follows else begin
        rows = []
        for row in range(self.executed, self.executed + self.rows):
            target = self.pose(row + 1)
            rows.append(target - self.pose(row) if self.delta else start + target - begin)
        return Act(np.array(rows, np.float32))


@pytest.mark.parametrize("follows", [False, True], ids=["fixed path", "from the observed pose"])
@pytest.mark.parametrize("seed", range(20))
def test_a_policy_within_the_limits_leaves_the_ease_in(seed: int, follows: bool) -> None:
    random = np.random.default_rng(seed)
    hz = float(random.choice([10, 20, 50, 100, 200]))
    policy = Moving(random, hz, follows=follows)
    measure = None if policy.delta else (lambda obs: obs.state["joints"])
    limits = MotionLimits(velocity=SPEED, acceleration=ACCELERATION, jerk=JERK)
    guard = Guard(policy.contract, measure=measure, limits=limits, hz=hz, soft_start_s=0.0)
    joints = policy.pose(0).astype(np.float32)

    rows_of_ticks = []
    with ChunkPlayer(policy, check=guard) as player:
        player.initialize()
        player.reset(Obs(state={"joints": joints}))
        for _ in range(int(10 * hz)):
            act = player.act(Obs(state={"joints": joints}))
            assert SAFE not in act.info
            joints = joints + act.action if policy.delta else act.action.copy()
            policy.executed = player.rows
            rows_of_ticks.append(player.rows)
        rows_per_tick = player.rows_per_tick

    half = len(rows_of_ticks) // 2
    assert rows_of_ticks[-1] - rows_of_ticks[half] == len(rows_of_ticks) - 1 - half
    assert rows_per_tick is not None
    assert rows_per_tick > 0.8


class Undecided(Agent):
    """A policy that plans to stay at one pose at first, and at another pose in later answers."""

    contract = Contract(action=ActionSpec(dim=1, space="joint", delta=False))

    def __init__(self, first: float, later: float, rows: int) -> None:
        self._first, self._later, self._rows = first, later, rows
        self.answers = 0

    def act(self, obs: Obs) -> Act:
        self.answers += 1
        pose = self._first if self.answers == 1 else self._later
        return Act(np.full((self._rows, 1), pose, np.float32))


def eased_in(policy: Undecided) -> list[float]:
    """Return the commands until a robot that begins at rest at 0 reaches the pose 0.3, but at most
    60 commands.

    Each answer arrives within a tick.
    """
    guard = Guard(
        policy.contract,
        limits=MotionLimits(velocity=SPEED, acceleration=ACCELERATION, jerk=JERK),
        hz=30.0,
        measure=lambda obs: obs.state["joints"],
    )
    commands: list[float] = []
    with ChunkPlayer(policy, PlayerSettings("async", deadline_s=30.0), check=guard) as player:
        player.initialize()
        obs = Obs(state={"joints": np.zeros(1, np.float32)})
        player.reset(obs)
        while len(commands) < 60 and commands[-1:] != [np.float32(0.3)]:
            while player._caller is not None and player._caller.busy:
                time.sleep(0)
            act = player.act(obs)
            assert SAFE not in act.info
            commands.append(float(act.action[0]))
            obs = Obs(state={"joints": act.action})
    return commands


@pytest.mark.parametrize("rows", [1, 3])
def test_an_ease_in_leads_to_its_plan_whatever_is_answered_meanwhile(rows: int) -> None:
    policy = Undecided(0.3, -0.3, rows)
    commands = eased_in(policy)
    assert policy.answers > 1
    assert commands == eased_in(Undecided(0.3, 0.3, rows))
    assert 5 < len(commands) < 60
    assert commands == sorted(commands)
