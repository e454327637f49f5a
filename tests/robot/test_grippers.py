"""No source of commands changes a gripper by itself, for both kinds of actions and for one or two
arms.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ChunkPlayer,
    ConfigError,
    Contract,
    Obs,
    PlayerSettings,
)
from vlagents_ray.chunking.fallback import SafeAction
from vlagents_ray.columns import Columns
from vlagents_ray.errors import PolicyUnavailable
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.interface import SAFE
from vlagents_ray.robot import Guard, MotionLimits, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot

HZ = 50.0
OPEN, CLOSED = 1.0, -1.0
NO_LIMIT = float("inf")
KINDS = [
    pytest.param(delta, arms, id=f"{'relative' if delta else 'absolute'}, {arms} arms")
    for delta, arms in itertools.product((False, True), (1, 2, 3))
]


def spec_of(delta: bool, arms: int) -> ActionSpec:
    """Return the specification of actions with three joints and a gripper for each arm."""
    names = tuple(f"arm{i}" for i in range(arms)) if arms > 1 else None
    return ActionSpec(
        dim=4 * arms,
        space="joint",
        delta=delta,
        gripper_open=OPEN,
        gripper_closed=CLOSED,
        arms=names,
    )


def limits_of(arms: int, gripper: float) -> MotionLimits:
    """Return limits whose gripper speed is `gripper`, in units/s."""
    return MotionLimits(
        velocity=(1.0, 1.0, 1.0, gripper) * arms,
        acceleration=(20.0, 20.0, 20.0, 20 * gripper) * arms,
        jerk=(800.0, 800.0, 800.0, 800 * gripper) * arms,
    )


def test_the_columns_are_the_last_of_each_arms_part() -> None:
    assert list(Columns.from_spec(spec_of(False, 1), 4).grippers) == [3]
    assert list(Columns.from_spec(spec_of(True, 2), 8).grippers) == [3, 7]
    assert list(Columns.from_spec(spec_of(True, 2), 8).relative) == [0, 1, 2, 4, 5, 6]
    assert list(Columns.from_spec(spec_of(False, 2), 8).relative) == []
    assert list(Columns.from_spec(ActionSpec(delta=True), 7).grippers) == []
    assert list(Columns.from_spec(ActionSpec(gripper_closed=0.0), 7).grippers) == [6], (
        "this must also hold if only one end of the gripper is declared"
    )


UNEQUAL = ActionSpec(
    dim=15, delta=True, gripper_open=1.0, gripper_closed=0.0, arms=("left", "right")
)


@pytest.mark.parametrize(
    "use",
    [
        lambda: SafeAction("auto", UNEQUAL),
        lambda: ChunkExecutor(
            None, ClockConfig(latency=0.1, mode="async"), Contract(action=UNEQUAL, control_hz=10)
        ),
        lambda: Guard(Contract(action=UNEQUAL)),
        lambda: SimulatedRobot(Contract(action=UNEQUAL)),
    ],
    ids=["safe action", "neutral action", "guard", "simulated robot"],
)
def test_arms_that_do_not_share_the_numbers_equally_are_an_error_of_each_user(use) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ConfigError, match="2 arms"):
        use()


@pytest.mark.parametrize(("delta", "arms"), KINDS)
def test_a_safe_action_keeps_each_gripper_and_the_neutral_one_opens_all(
    delta: bool, arms: int
) -> None:
    spec = spec_of(delta, arms)
    columns = list(Columns.from_spec(spec, 4 * arms).grippers)
    last = np.random.default_rng(0).uniform(-1, 1, 4 * arms).astype(np.float32)
    assert (SafeAction("auto", spec)(Obs(), last)[columns] == last[columns]).all()
    if delta:
        first = Columns.from_spec(spec, 4 * arms).first_still(1.0)
        assert first is not None
        assert (first[columns] == OPEN).all()


class Grasping(Agent):
    """A policy whose grippers close and open in turn, and whose server is sometimes unavailable."""

    contract: Contract | None = None

    def __init__(self, spec: ActionSpec, seed: int, largest_change: float) -> None:
        self.contract = Contract(action=spec, chunk=40)
        self._spec = spec
        self._random = np.random.default_rng(seed)
        self._change = largest_change
        self.rows = np.zeros((0, spec.dim or 0), np.float32)  # rows of all answers
        self._gripper = np.array(
            [OPEN, CLOSED, OPEN][: len(list(Columns.from_spec(spec, spec.dim or 0).grippers))]
        )

    def act(self, obs: Obs) -> Act:
        if len(self.rows) and self._random.random() < 0.3:
            raise PolicyUnavailable("the server restarts")
        spec, dim = self._spec, self._spec.dim or 0
        rows = np.full((40, dim), 0.003)
        if not spec.relative:
            rows = obs.state["joints"] + np.cumsum(rows, axis=0)
        for row in rows:
            target = np.where(
                self._random.random(len(self._gripper)) < 0.1, -self._gripper, self._gripper
            )
            change = np.clip(target - self._gripper, -self._change, self._change)
            self._gripper = np.clip(self._gripper + change, CLOSED, OPEN)
            row[list(Columns.from_spec(spec, dim).grippers)] = self._gripper
        self.rows = np.concatenate([self.rows, rows.astype(np.float32)])
        return Act(rows.astype(np.float32))


@pytest.mark.slow
@pytest.mark.parametrize(("delta", "arms"), KINDS)
@pytest.mark.parametrize("mode", ["open_loop", "async"])
@pytest.mark.parametrize("seed", range(3))
def test_a_grippers_command_is_the_last_one_or_the_policys(
    delta: bool, arms: int, mode: str, seed: int
) -> None:
    """Ease-in, hold, lost answers, pauses and stops change no gripper without limits."""
    spec = spec_of(delta, arms)
    columns = list(Columns.from_spec(spec, 4 * arms).grippers)
    policy = Grasping(spec, seed, largest_change=2.0)
    joints = np.full(4 * arms, 0.3, np.float32)
    measure = None if delta else (lambda obs: obs.state["joints"])
    guard = Guard(policy.contract, limits=limits_of(arms, NO_LIMIT), hz=HZ, measure=measure)
    random = np.random.default_rng(seed)
    last: np.ndarray | None = None
    held = 0
    settings = PlayerSettings(mode, deadline_s=30.0, execute=None if mode == "open_loop" else 10)  # type: ignore[arg-type]
    with ChunkPlayer(policy, settings, check=guard) as player:
        player.initialize()
        player.reset(Obs(state={"joints": joints}))
        for _ in range(400):
            event = random.choice(["none", "pause", "stop"], p=[0.97, 0.02, 0.01])
            if event == "pause":
                player.control.pause()
            elif event == "stop" and last is not None:
                player.act(Obs(state={"joints": joints}))  # this action is not executed
                player.interrupt()
                # The fingers yield.
                joints = joints + np.float32(0.2) * np.isin(np.arange(len(joints)), columns)
            act = player.act(Obs(state={"joints": joints}))
            player.control.resume()
            held += SAFE in act.info
            grippers = act.action[columns]
            if SAFE in act.info and last is not None:
                assert (grippers == last[columns]).all(), act.info[SAFE]
            for column, command in zip(columns, grippers.tolist(), strict=True):
                of_the_policy = set(policy.rows[:, column].tolist())
                of_before = {0.3} if last is None else {float(last[column])}
                assert command in of_the_policy | of_before, "half open"
            last = act.action
            if not delta:
                joints = act.action.copy()
    assert held > 0


@pytest.mark.parametrize(("delta", "arms"), KINDS)
def test_a_gripper_with_limits_goes_from_the_last_command_to_the_policys_and_not_back(
    delta: bool, arms: int
) -> None:
    spec = spec_of(delta, arms)
    columns = list(Columns.from_spec(spec, 4 * arms).grippers)

    class Closing(Agent):
        contract = Contract(action=spec, chunk=200)
        closes = False

        def act(self, obs: Obs) -> Act:
            row = np.zeros(4 * arms, np.float32) if delta else obs.state["joints"].copy()
            row[columns] = CLOSED if self.closes else OPEN
            return Act(np.tile(row, (200, 1)))

    policy = Closing()
    joints = np.zeros(4 * arms, np.float32)
    joints[columns] = OPEN
    measure = None if delta else (lambda obs: obs.state["joints"])
    limits = limits_of(arms, 2.0) if delta else replace(limits_of(arms, 2.0), first=3.0)
    guard = Guard(policy.contract, limits=limits, hz=HZ, measure=measure, soft_start_s=0)
    with ChunkPlayer(policy, PlayerSettings(deadline_s=30.0), check=guard) as player:
        player.initialize()
        player.reset(Obs(state={"joints": joints}))
        first, _ = (player.act(Obs(state={"joints": joints})).action for _ in range(2))
        policy.closes = True
        player.interrupt()
        commands = [first] + [player.act(Obs(state={"joints": joints})).action for _ in range(300)]
    path = np.array(commands)[:, columns]
    assert (np.diff(path, axis=0) <= 1e-6).all(), "the gripper only closes"
    assert np.abs(np.diff(path, axis=0)).max() * HZ <= 2.0 * 1.001
    assert np.allclose(path[-1], CLOSED)


@pytest.mark.parametrize("arms", [1, 2])
def test_the_way_to_rest_keeps_the_grippers(arms: int) -> None:
    spec = spec_of(False, arms)
    rest = (0.1, 0.2, 0.3, None) * arms
    guard = Guard(Contract(action=spec), limits=replace(limits_of(arms, 1.0), rest=rest), hz=HZ)
    last = np.array([0, 0, 0, -0.4, 0, 0, 0, 0.6][: 4 * arms], np.float32)
    way = np.array(list(guard.way_to_rest(last)))
    columns = list(Columns.from_spec(spec, 4 * arms).grippers)
    assert (way[:, columns] == last[columns]).all()
    assert np.allclose(np.delete(way[-1], columns), (0.1, 0.2, 0.3) * arms)


@pytest.mark.slow
@pytest.mark.parametrize(("delta", "arms"), KINDS)
def test_a_simulated_robot_has_its_grippers_where_they_were_commanded(
    delta: bool, arms: int
) -> None:
    spec = spec_of(delta, arms)
    columns = list(Columns.from_spec(spec, 4 * arms).grippers)

    class Still(Agent):
        contract = Contract(action=spec, chunk=10)

        def act(self, obs: Obs) -> Act:
            rows = np.zeros((10, 4 * arms), np.float32)
            rows[:, columns] = CLOSED
            return Act(rows)

    robot = SimulatedRobot(Still.contract)
    with ChunkPlayer(Still(), PlayerSettings(deadline_s=30.0)) as player:
        run_loop(robot, player, hz=200, seconds=0.3)
    assert np.allclose(robot._target[columns], CLOSED)
    for _ in range(60):
        opening = robot.observe().gripper
    assert opening == pytest.approx(0.0, abs=1e-3)


def test_arms_whose_openings_are_unknown_stand_until_the_first_action_that_is_accepted() -> None:
    """No safe action is known for them. The loop needs none for a robot that stands still."""
    spec = spec_of(True, 2)

    class TooFast(Agent):
        contract = Contract(action=spec, chunk=10)
        answers = 0

        def act(self, obs: Obs) -> Act:
            self.answers += 1
            rows = np.zeros((10, 8), np.float32)
            rows[:, 0] = 0.5 if self.answers < 4 else 0.001
            rows[:, list(Columns.from_spec(spec, 8).grippers)] = OPEN
            return Act(rows)

    robot = SimulatedRobot(TooFast.contract)
    guard = Guard(TooFast.contract, limits=limits_of(2, NO_LIMIT), hz=200)
    with ChunkPlayer(TooFast(), PlayerSettings(deadline_s=30.0), check=guard) as player:
        report = run_loop(robot, player, hz=200, seconds=0.5)
    assert report.safe.get("max_step", 0) + report.safe.get("dynamics", 0) > 0
    assert robot.applied > 20
    assert abs(float(robot._target[0])) < 0.5


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("column", [4, 6, 7], ids=["a joint", "another joint", "the gripper"])
def test_a_number_of_the_second_arm_that_is_not_finite_moves_neither_arm(
    broken: float, column: int
) -> None:
    spec = spec_of(True, 2)

    class Breaking(Agent):
        contract = Contract(action=spec, chunk=4)
        chunks = 0

        def act(self, obs: Obs) -> Act:
            self.chunks += 1
            rows = np.full((4, 8), 0.001, np.float32)
            rows[:, [3, 7]] = 0.5
            if self.chunks > 1:  # the first chunk is the reset's, and raises an error
                rows[2, column] = broken
            return Act(rows)

    policy = Breaking()
    with ChunkPlayer(
        policy, PlayerSettings(deadline_s=30.0), check=Guard(policy.contract)
    ) as player:
        player.initialize()
        player.reset(Obs())
        acts = [player.act(Obs()) for _ in range(12)]
    refused = [act for act in acts if SAFE in act.info]
    assert refused
    for act in refused:
        np.testing.assert_array_equal(np.delete(act.action, [3, 7]), 0.0)
        np.testing.assert_array_equal(act.action[[3, 7]], 0.5)
    assert np.isfinite([act.action for act in acts]).all()
