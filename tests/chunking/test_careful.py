"""Careful rows: a gripper moves only because of a recent observation, and the robot waits once."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from delayed_caller import Delayed

from vlagents_ray import Act, ActionSpec, Agent, ChunkPlayer, Contract, Obs, PlayerSettings
from vlagents_ray.chunking import player as player_module
from vlagents_ray.chunking.buffer import Chunk, ChunkBuffer
from vlagents_ray.chunking.careful import CarefulRows
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.interface import CAUSE, IN_TIME

ROWS = 8
GOAL = 10  # the place of the object, in steps of the arm
RELATIVE = ActionSpec(dim=2, delta=True, gripper_open=1.0, gripper_closed=0.0)
ABSOLUTE = replace(RELATIVE, delta=False)
TWO = ActionSpec(dim=4, delta=True, gripper_open=1.0, gripper_closed=-1.0, arms=("left", "right"))


class Grasping(Agent):
    """A policy that moves an arm to an object and closes the gripper there.

    The rows that were computed more than two steps before the object are off by one step, so that
    the gripper closes beside it.
    """

    contract: Contract | None = None

    def __init__(self, spec: ActionSpec) -> None:
        self.contract = Contract(action=spec, control_hz=10.0)
        self.spec = spec

    def reset(self, obs: Obs, instruction: str | None = None, **_: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        place = round(float(obs.state["place"][0]))
        is_closed = bool(obs.state["closed"][0])
        grasp = GOAL if GOAL - place <= 2 else GOAL - 1
        rows = []
        for _ in range(ROWS):
            is_closed = is_closed or place >= grasp
            step = 0 if is_closed else 1
            place += step
            arm = float(step if self.spec.delta else place)
            gripper = self.spec.gripper_closed if is_closed else self.spec.gripper_open
            rows.append([arm, gripper] * (len(self.spec.arms or ("",))))
        return Act(np.array(rows, np.float32))


class Arm:
    """An arm at a place, whose gripper closes once."""

    def __init__(self, spec: ActionSpec) -> None:
        self.spec = spec
        self.place = 0.0
        self.closed_at: float | None = None

    def observe(self) -> Obs:
        closed = float(self.closed_at is not None)
        return Obs(state={"place": np.array([self.place]), "closed": np.array([closed])})

    def apply(self, action: np.ndarray) -> None:
        self.place = self.place + float(action[0]) if self.spec.delta else float(action[0])
        middle = (self.spec.gripper_open + self.spec.gripper_closed) / 2  # type: ignore[operator]
        if float(action[-1]) < middle and self.closed_at is None:
            self.closed_at = self.place


SPECS = {"relative": RELATIVE, "absolute": ABSOLUTE, "two arms": TWO}


def in_player(
    spec: ActionSpec, delay: int, monkeypatch: pytest.MonkeyPatch, **settings: Any
) -> tuple[Arm, list[Act]]:
    """Return the arm after an episode with a chunk player, and the actions."""
    monkeypatch.setattr(player_module, "AsyncCaller", type("Caller", (Delayed,), {"delay": delay}))
    arm, acts = Arm(spec), []
    with ChunkPlayer(Grasping(spec), PlayerSettings(**settings)) as player:
        player.reset(arm.observe())
        for _ in range(80):
            acts.append(player.act(arm.observe()))
            arm.apply(acts[-1].action)
    return arm, acts


def in_evaluation(spec: ActionSpec, delay: int, **settings: Any) -> tuple[Arm, int]:
    """Return the arm after an episode of an evaluation, and the ticks of waiting by choice."""
    neutral = [0.0, 1.0] * ((spec.dim or 0) // 2)
    clock = ClockConfig(latency=delay / 10, neutral=neutral, **settings)
    policy, arm, careful = Grasping(spec), Arm(spec), 0
    executor = ChunkExecutor(2, clock, Contract(action=spec, control_hz=10.0))
    for _ in range(40):
        answer = policy.act(arm.observe())
        for tick in executor.ticks(answer.action, delay / 10):
            arm.apply(tick.action)
            careful += tick.careful
            assert not (tick.careful and tick.starved)
    return arm, careful


@pytest.mark.parametrize("delay", range(6))
@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize(
    "settings",
    [
        {"mode": "async"},
        {"mode": "async", "execute": 4},
        {"mode": "async", "merge": "average"},
        {"mode": "async", "merge": "ensemble"},
        {"mode": "ensemble", "deadline_s": 0.0},
        {"mode": "open_loop", "deadline_s": 0.0, "execute": 4},
    ],
    ids=str,
)
def test_a_gripper_closes_at_the_object_at_any_delay(
    settings: dict[str, Any], name: str, delay: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm, acts = in_player(SPECS[name], delay, monkeypatch, **settings)
    careful = [act for act in acts if act.info.get(CAUSE) == "careful"]
    assert all(act.info[IN_TIME] for act in careful)
    assert len(careful) <= 2 * delay + 1, "the robot waits once"
    if delay < 2:
        assert not careful
    # The mean of an old and a new plan leads to a place between theirs.
    is_merged = settings["mode"] == "ensemble" or "merge" in settings
    assert arm.closed_at == pytest.approx(GOAL, abs=1.0 if is_merged and delay < 2 else 1e-6)


@pytest.mark.parametrize("delay", range(6))
@pytest.mark.parametrize("name", SPECS)
@pytest.mark.parametrize("mode", ["async", "open_loop"])
def test_an_evaluation_waits_as_a_robot_does(mode: str, name: str, delay: int) -> None:
    arm, careful = in_evaluation(SPECS[name], delay, mode=mode)
    assert arm.closed_at == GOAL
    assert careful <= 2 * delay
    assert bool(careful) == (delay >= 2 and mode == "async")


def test_without_careful_rows_the_gripper_closes_beside_the_object(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    arm, _ = in_player(RELATIVE, 4, monkeypatch, mode="async", fresh_grip=None)
    assert arm.closed_at != GOAL
    arm, careful = in_evaluation(RELATIVE, 4, mode="async", fresh_grip=None)
    assert (arm.closed_at != GOAL, careful) == (True, 0)


def plan_of(rows: int = ROWS, spec: ActionSpec = RELATIVE, **fields: Any) -> ChunkBuffer:
    """Return a plan of an observation three rows ago, whose next row closes the gripper."""
    plan = ChunkBuffer(action=spec)
    closing = np.full((rows, spec.dim or 0), spec.gripper_closed or 0.0, np.float32)
    plan.add(Chunk(0, 0, closing, **fields))
    for _ in range(3):
        plan.advance(OPEN)
    plan.add(Chunk(1, 0, closing, **fields))
    return plan


OPEN = np.array([0.0, 1.0], np.float32)


def test_a_robot_with_a_hesitating_policy_waits_once_for_a_change() -> None:
    plan = plan_of()
    careful = CarefulRows(plan, 2)
    assert careful.stands(OPEN, 3)
    awaited = careful.awaited(OPEN, 3)

    # The fresh answer closes the gripper later, and so does each answer after it.
    hesitating = np.array([[0.0, 1.0]] * 4 + [[0.0, 0.0]] * 4, np.float32)
    plan.add(Chunk(2, plan.executed, hesitating))
    careful.answered(awaited)
    for number in range(3, 20):
        step = plan.executed
        for _ in range(3):
            assert not careful.stands(OPEN, 3)
            plan.advance(OPEN)
            careful.executed(OPEN)
        awaited = careful.awaited(OPEN, 3)
        plan.add(Chunk(number, step, hesitating))
        careful.answered(awaited)
    plan.advance(OPEN)
    assert plan.next is not None
    assert plan.next.action[1] == 0.0
    assert not careful.stands(OPEN, 3), "an old row closes the gripper, after a single wait"

    # The change was executed, or the policy has changed its mind: the robot waits again.
    careful.executed(plan.next.action)
    assert careful.stands(OPEN, 3)


def test_a_change_that_the_policy_gives_up_must_be_awaited_again() -> None:
    plan = plan_of()
    careful = CarefulRows(plan, 2)
    awaited = careful.awaited(OPEN, 3)
    plan.add(Chunk(2, plan.executed, np.array([[0.0, 0.0]] * 8, np.float32)))
    careful.answered(awaited)
    step = plan.executed
    plan.add(Chunk(3, step, np.array([[0.0, 1.0]] * 8, np.float32)))
    careful.answered({})
    for _ in range(3):
        plan.advance(OPEN)
    plan.add(Chunk(4, step, np.array([[0.0, 0.0]] * 8, np.float32)))
    careful.answered({})
    assert careful.stands(OPEN, 3)


@pytest.mark.parametrize(
    ("fresh_grip", "delay", "last", "fields"),
    [
        (None, 3, OPEN, {}),  # switched off
        (2, 1, OPEN, {}),  # answers are faster
        (4, 5, OPEN, {}),  # the row is younger
        (2, 3, None, {}),  # no command was sent yet
        (2, 3, np.zeros(2, np.float32), {}),  # the gripper is already closed
        (2, 3, np.array([0.0, 0.4], np.float32), {}),  # it only closes further
        (2, 3, OPEN, {"done": True}),  # no further answer follows
    ],
)
def test_a_robot_does_not_wait_without_need(
    fresh_grip: int | None, delay: int, last: np.ndarray | None, fields: dict[str, Any]
) -> None:
    careful = CarefulRows(plan_of(**fields), fresh_grip)
    assert not careful.stands(last, delay)
    assert careful.rows_ahead(last, delay) == delay


def test_a_policy_is_told_how_many_rows_are_executed_before_the_robot_waits() -> None:
    plan = ChunkBuffer(action=RELATIVE)
    closing = np.array([[1.0, 1.0]] * 4 + [[1.0, 0.0]] * 4, np.float32)
    plan.add(Chunk(0, 0, closing))
    plan.advance(OPEN)
    plan.add(Chunk(1, 0, closing))
    careful = CarefulRows(plan, 2)
    assert [careful.rows_ahead(OPEN, delay) for delay in (1, 2, 3, 7)] == [1, 2, 3, 3]
    # With answers that are exactly as late as the age, the robot waits.
    assert CarefulRows(plan, 4).rows_ahead(OPEN, 4) == 3
    assert CarefulRows(plan, 5).rows_ahead(OPEN, 4) == 4


def test_without_both_values_of_a_gripper_a_robot_does_not_wait_and_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    spec = ActionSpec(dim=2, delta=True, gripper_open=1.0)
    careful = CarefulRows(plan_of(spec=spec), 2)
    with caplog.at_level(logging.WARNING):
        assert not careful.stands(OPEN, 3)
        assert not careful.stands(OPEN, 3)
    [record] = caplog.records
    assert "got gripper_open=1.0 and gripper_closed=None" in record.message


def test_an_answer_that_does_not_come_is_not_waited_for_by_choice(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Silent(Delayed):
        delay, is_silent = 3, False

        def take(self, wait_s: float = 0.0) -> Act | None:
            return None if self.is_silent else super().take(wait_s)

    monkeypatch.setattr(player_module, "AsyncCaller", Silent)
    arm = Arm(RELATIVE)
    arm.place = 3.0
    with ChunkPlayer(Grasping(RELATIVE), PlayerSettings(mode="async")) as player:
        player.reset(arm.observe())
        acts = []
        for _ in range(40):
            acts.append(player.act(arm.observe()))
            arm.apply(acts[-1].action)
            Silent.is_silent = Silent.is_silent or acts[-1].info.get(CAUSE) == "careful"
        assert player.timeliness.careful == 7
    causes = [act.info.get(CAUSE) for act in acts]
    assert causes.count("careful") == 7, "twice the delay, and a tick"
    last = acts[-1].info
    assert (last[CAUSE], last[IN_TIME], arm.closed_at) == ("waiting", False, None)
