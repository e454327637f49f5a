"""Interventions: who controls the robot at each tick, the information that the policy gets, and its
restart.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from in_process_replicas import Replicas
from scripted_leader import ScriptedLeader

from vlagents_ray import Act, ActionSpec, Agent, ConfigError, Contract, Obs, PolicyFailed
from vlagents_ray.chunking.control import RobotControl
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.errors import InvalidAction, InvalidObservation
from vlagents_ray.interface import DELAY, EXECUTED, INTERVENTION, LEFTOVER, SAFE, WANTED
from vlagents_ray.robot import Guard

HORIZON = 5
ROW = 0.01  # distance between two rows of a chunk


class Near(Agent):
    """A policy that continues from the robot's position in small steps, like a policy with absolute
    targets.
    """

    contract = Contract(action=ActionSpec(dim=2, delta=False, low=-5.0, high=5.0))

    def __init__(self, *, gated: bool = False, jump: float = 0.0) -> None:
        self.asked: list[dict[str, Any]] = []
        self.at: list[float] = []
        self.gated, self.jump = gated, jump
        self.gate = threading.Semaphore(0)
        self.failure: Exception | None = None
        self.info: dict[str, Any] = {}

    def act(self, obs: Obs) -> Act:
        self.asked.append(obs.info)
        self.at.append(float(obs.state["joints"][0]))
        if self.gated and len(self.asked) > 1:
            assert self.gate.acquire(timeout=30)
        if self.failure is not None:
            raise self.failure
        column = self.at[-1] + self.jump + ROW * np.arange(1, HORIZON + 1)
        return Act(np.stack([column, column], 1).astype(np.float32), info=dict(self.info))


class Arm:
    """An arm that reaches the last commanded position at once."""

    def __init__(self, player: ChunkPlayer) -> None:
        self.player = player
        self.pose = np.zeros(2, np.float32)
        player.reset(self.seen(), "stack")

    def seen(self) -> Obs:
        return Obs(state={"joints": self.pose.copy()})

    def tick(self) -> Act:
        act = self.player.act(self.seen())
        self.pose = act.action
        return act

    def settle(self) -> None:
        """Wait until the policy has answered its current request."""
        wait_for(lambda: self.player._caller is None or not self.player._caller.busy, every_s=0.001)


def row(value: float) -> np.ndarray:
    return np.full(2, value, np.float32)


def ahead(obs: Obs) -> np.ndarray:
    """Return the action of a human who moves by 0.05 per tick."""
    return np.asarray(obs.state["joints"] + np.float32(0.05), np.float32)


@pytest.fixture
def players() -> Iterator[list[ChunkPlayer]]:
    made: list[ChunkPlayer] = []
    yield made
    for player in made:
        getattr(player._agent, "gate", threading.Semaphore()).release(100)
        player.close()


@pytest.fixture
def make(players: list[ChunkPlayer]) -> Any:
    def made(agent: Agent, **options: Any) -> tuple[Arm, ScriptedLeader]:
        leader = options.pop("override", None) or ScriptedLeader(ahead)
        check = options.pop("check", None)
        player = ChunkPlayer(agent, PlayerSettings(**options), check=check, override=leader)
        players.append(player)
        return Arm(player), leader

    return made


MODES: list[dict[str, Any]] = [
    {"mode": "open_loop"},
    {"mode": "open_loop", "deadline_s": 30.0},
    {"mode": "ensemble"},
    {"mode": "async"},
    {"mode": "async", "merge": "ensemble"},
    {"mode": "async", "real_time_chunking": True},
]


@pytest.mark.parametrize("options", MODES)
def test_the_hand_over_takes_one_tick_in_both_directions(
    make: Any, options: dict[str, Any]
) -> None:
    arm, leader = make(Near(), **options)
    assert INTERVENTION not in arm.tick().info
    leader.held = True
    at = arm.pose.copy()
    act = arm.tick()
    assert (arm.player.control.state, act.info[INTERVENTION]) == ("human", True)
    assert act.action == pytest.approx(at + 0.05)
    leader.held = False
    assert INTERVENTION not in arm.tick().info
    assert arm.player.control.state == "autonomous"


@pytest.mark.parametrize("options", MODES)
def test_each_frame_of_a_correction_has_what_the_policy_wanted(
    make: Any, options: dict[str, Any]
) -> None:
    agent = Near()
    arm, leader = make(agent, **options)
    for _ in range(3):
        arm.tick()
    leader.held = True
    known = 0
    for _ in range(20):
        act = arm.tick()
        arm.settle()
        known += WANTED in act.info and act.info[WANTED].shape == (2,)
    assert len(leader.given) == 20
    assert known >= (16 if options == MODES[1] else 20), (
        "in open loop, the policy's action is unknown at the tick of a request"
    )
    assert max(agent.at) > 0.5, "the policy is called with the scene as the human changed it"


@pytest.mark.parametrize("options", MODES)
def test_after_the_release_only_answers_to_new_observations_are_executed(
    make: Any, options: dict[str, Any]
) -> None:
    agent = Near()
    guard = Guard(agent.contract, max_step=0.08, measure=lambda obs: obs.state["joints"])
    arm, leader = make(agent, check=guard, **options)
    for held in (False,) * 3 + (True,) * 10:
        leader.held = held
        arm.tick()
        arm.settle()
    leader.held = False
    released, asked = arm.pose.copy(), len(agent.asked)
    steps, first = [], None
    for _ in range(30):
        before = arm.pose.copy()
        act = arm.tick()
        steps.append(float(np.abs(arm.pose - before).max()))
        if first is None and SAFE not in act.info:
            first = act
        arm.settle()
    assert first is not None
    assert first.action[0] - released[0] <= (first.info["row"] + 1) * ROW + 1e-6, (
        "an earlier plan would be at another position"
    )
    assert max(steps) <= 0.08 + 1e-6
    assert all(LEFTOVER not in info for info in agent.asked[asked : asked + 1])
    assert agent.at[asked] == pytest.approx(float(released[0]))


def test_an_answer_in_progress_at_the_release_is_dropped(make: Any) -> None:
    agent = Near(gated=True)
    arm, leader = make(agent, mode="async")
    arm.tick()
    arm.tick()
    wait_for(lambda: len(agent.asked) == 2)
    leader.held = True
    for _ in range(3):
        arm.tick()
    leader.held = False
    held = arm.tick()
    assert "released" in held.info[SAFE]
    agent.gate.release()
    arm.settle()
    assert SAFE in arm.tick().info  # the answer belongs to an observation from before
    wait_for(lambda: len(agent.asked) == 3)
    agent.gate.release()
    arm.settle()
    act = arm.tick()
    assert SAFE not in act.info
    assert float(act.action[0]) == pytest.approx(agent.at[2] + (act.info["row"] + 1) * ROW)


def test_a_jump_after_the_release_never_reaches_the_robot(make: Any) -> None:
    agent = Near(jump=1.0)
    arm, leader = make(
        agent, check=Guard(agent.contract, max_step=0.1, measure=lambda obs: obs.state["joints"])
    )
    leader.held = True
    for _ in range(3):
        arm.tick()
    leader.held = False
    at = arm.pose.copy()
    act = arm.tick()
    assert "a step of at most max_step" in act.info[SAFE]
    assert act.action == pytest.approx(at)


def test_every_action_of_a_human_passes_the_guard(make: Any) -> None:
    seen: list[list[float]] = []
    guard = Guard(Near.contract, max_step=0.1)

    def check(action: np.ndarray, last: np.ndarray | None) -> np.ndarray:
        seen.append(action.tolist())
        return guard(action, last)

    arm, leader = make(Near(), check=check, mode="async")
    arm.tick()
    leader.held = True
    for wrong in (
        row(np.nan),
        row(3.0),
        row(9.0),
        np.zeros(3, np.float32),
        np.zeros((2, 2), np.float32),
    ):
        leader.command = wrong
        at = arm.pose.copy()
        act = arm.tick()
        assert INTERVENTION not in act.info, "the safe action is not the operator's"
        assert SAFE in act.info
        assert act.action == pytest.approx(at)
    leader.command = row(0.05)
    act = arm.tick()
    assert SAFE not in act.info
    assert act.action == pytest.approx(leader.command)
    assert all(action.tolist() in seen for action in (row(3.0), leader.command))


def test_the_policy_is_told_what_was_executed_in_its_place(make: Any) -> None:
    agent = Near()
    arm, leader = make(agent, execute=3)
    arm.tick()
    leader.held = True
    given = [arm.tick().action.tolist() for _ in range(2)]
    leader.held = False
    arm.tick()
    assert EXECUTED not in agent.asked[0]
    assert agent.asked[1][EXECUTED].tolist() == given
    for _ in range(4):
        arm.tick()
    assert EXECUTED not in agent.asked[2], "the outcome is reported once"
    leader.held = True
    arm.tick()
    leader.held = False
    arm.player.reset(arm.seen(), "again")
    arm.tick()
    assert EXECUTED not in agent.asked[-1], "the command belongs to another episode"


def test_a_served_policy_is_told_with_its_next_request(players: list[ChunkPlayer]) -> None:
    told: list[list[float]] = []

    class Told(Near):
        shared = ("gate",)

        def act(self, obs: Obs) -> Act:
            told.extend(np.asarray(obs.info.get(EXECUTED, np.zeros((0, 2)))).tolist())
            return super().act(obs)

    served = Replicas([Told()])
    leader = ScriptedLeader(ahead)
    player = ChunkPlayer(served.agent(), PlayerSettings(execute=2), override=leader)
    arm = Arm(player)
    given = []
    for held in (False, True, True, True, False, False):
        leader.held = held
        act = arm.tick()
        given += [act.action.tolist()] if held else []
    player.close()
    served.close()
    assert told == given


def test_a_loop_of_the_users_own_says_what_it_executed(make: Any) -> None:
    agent = Near()
    arm, _ = make(agent, execute=3, check=Guard(agent.contract))
    arm.tick()
    arm.player.observe(arm.seen(), action=row(0.3))
    arm.tick()
    act = arm.tick()
    assert agent.asked[-1][EXECUTED].tolist() == [row(0.3).tolist()]
    # Three rows of the first chunk have passed.
    assert (act.info["age_ticks"], act.info["row"]) == (0, 0)
    with pytest.raises(InvalidAction, match="above the limit"):
        arm.player.observe(arm.seen(), action=row(9.0))


def test_real_time_chunking_never_states_a_plan_that_nobody_executes(make: Any) -> None:
    agent = Near()
    arm, leader = make(agent, mode="async", real_time_chunking=True)
    for _ in range(4):
        arm.tick()
        arm.settle()
    assert any(LEFTOVER in info for info in agent.asked)
    leader.held = True
    asked = len(agent.asked)
    for _ in range(4):
        arm.tick()
        arm.settle()
    leader.held = False
    arm.tick()
    arm.settle()
    assert len(agent.asked) > asked + 2
    assert not any(LEFTOVER in info or DELAY in info for info in agent.asked[asked:])
    for _ in range(4):
        arm.tick()
        arm.settle()
    rest = next(info[LEFTOVER] for info in agent.asked[asked:] if LEFTOVER in info)
    assert rest[0, 0] == pytest.approx(float(arm.pose[0]), abs=5 * ROW), (
        "the plan from an observation after the release"
    )


@pytest.mark.parametrize(
    "failure", [PolicyFailed("no memory"), InvalidObservation("a camera"), RuntimeError("a bug")]
)
@pytest.mark.parametrize("options", MODES)
def test_errors_of_the_policy_take_no_robot_from_a_human(
    make: Any, options: dict[str, Any], failure: Exception
) -> None:
    agent = Near()
    arm, leader = make(agent, **options)
    arm.tick()
    leader.held = True
    agent.failure = failure
    for _ in range(HORIZON + 2):
        act = arm.tick()
        arm.settle()
        assert SAFE not in act.info
    assert WANTED not in act.info, "the policy's action is unknown"
    assert act.info["silent_s"] == 0.0


def test_nobody_waits_for_the_policy_while_a_human_moves_the_robot(make: Any) -> None:
    agent = Near(gated=True)
    arm, leader = make(agent, deadline_s=60.0)
    leader.held = True
    for _ in range(HORIZON + 3):
        arm.tick()  # without the intervention, this would wait a minute for the answer
    assert len(leader.given) == HORIZON + 3


def test_a_pause_holds_the_robot_until_it_is_over(make: Any) -> None:
    agent = Near()
    arm, _ = make(agent, mode="async")
    arm.tick()
    arm.player.control.pause()
    at, asked = arm.pose.copy(), len(agent.asked)
    for _ in range(9):
        act = arm.tick()
        arm.settle()
        assert act.info[SAFE] == "paused by an operator"
        assert act.action == pytest.approx(at)
    assert arm.player.control.state == "paused"
    assert len(agent.asked) > asked + 7, "its answers may contain the command to continue"
    assert len(arm.player._plan._chunks) <= 1
    arm.player.control.resume()
    asked = len(agent.asked)
    assert SAFE in arm.tick().info
    arm.settle()
    assert SAFE not in arm.tick().info
    assert agent.at[asked] == pytest.approx(float(at[0]))
    assert agent.asked[asked][EXECUTED].tolist() == [at.tolist()]


@pytest.mark.parametrize("options", MODES)
def test_no_answer_that_comes_in_a_pause_is_executed(make: Any, options: dict[str, Any]) -> None:
    agent = Near()
    arm, _ = make(agent, **options)
    arm.tick()
    arm.player.control.pause()
    at, asked = arm.pose.copy(), len(agent.asked)
    for _ in range(HORIZON + 2):
        assert arm.tick().action == pytest.approx(at)
        arm.settle()
    assert len(agent.asked) >= asked + HORIZON
    assert not any(LEFTOVER in info for info in agent.asked[asked + 1 :])


def test_what_a_stopped_robot_did_not_execute_is_not_said_to_be(make: Any) -> None:
    agent = Near()
    arm, leader = make(agent, execute=1)
    leader.held = True
    given = [arm.tick().action.tolist() for _ in range(3)]
    arm.player.interrupt()
    arm.player.interrupt()
    leader.held = False
    arm.tick()
    told = [row.tolist() for info in agent.asked if EXECUTED in info for row in info[EXECUTED]]
    assert told == given[:2]


def test_a_human_takes_over_from_a_pause_and_gives_back_to_the_policy(make: Any) -> None:
    arm, leader = make(Near())
    control = arm.player.control
    states = []
    for held, command in (
        (False, None),
        (False, control.pause),
        (True, None),
        (True, None),
        (False, None),
    ):
        leader.held = held
        if command is not None:
            command()
        arm.tick()
        states.append(control.state)
    assert states == ["autonomous", "paused", "human", "human", "autonomous"]
    leader.held = True
    arm.tick()
    control.pause("look first")
    assert SAFE not in arm.tick().info, "the request begins at the release"
    leader.held = False
    assert arm.tick().info[SAFE] == "look first"


def test_a_leader_that_breaks_pauses_the_robot(make: Any) -> None:
    def unplugged() -> bool:
        raise OSError("no such device")

    arm, leader = make(Near())
    arm.tick()
    leader.wants = unplugged
    assert "no such device" in arm.tick().info[SAFE]
    leader.wants = lambda: False
    arm.player.control.resume()
    assert SAFE not in arm.tick().info
    leader.held = True
    leader.command = lambda _: 1 / 0
    assert "division by zero" in arm.tick().info[SAFE]


def test_without_a_safe_action_that_passes_a_pause_or_a_wrong_human_ends_the_loop(
    make: Any,
) -> None:
    arm, leader = make(Near(), safe=row(9.0), check=Guard(Near.contract))
    leader.held = True
    leader.command = row(9.0)
    with pytest.raises(InvalidAction, match="above the limit"):
        arm.tick()
    with ChunkPlayer(Near()) as player:
        arm = Arm(player)
        arm.tick()
        player.control.pause()
        with pytest.raises(InvalidAction, match="paused by an operator"):
            arm.tick()

    class Unstated(Near):
        contract = Contract(action=ActionSpec(dim=2))

    with (
        ChunkPlayer(Unstated(), override=ScriptedLeader(row(0))) as player,
        pytest.raises(ConfigError, match="safe"),
    ):
        player.reset(Obs(), "stack")


def lines_of(function: Any) -> list[int]:
    return sorted({line for _, _, line in function.__code__.co_lines() if line is not None})


# From the second line, since a human may take over from a pause that began before the tick.
@pytest.mark.parametrize("line", range(2, len(lines_of(RobotControl.update))))
@pytest.mark.parametrize("command", ["pause", "stop"])
def test_a_command_between_any_two_lines_of_a_tick_is_not_lost(line: int, command: str) -> None:
    leader = ScriptedLeader(ahead)
    leader.held = True
    control = RobotControl(leader)
    wanted, threads = lines_of(RobotControl.update)[line], []

    def trace(frame: Any, event: str, _: object) -> Any:
        if frame.f_code is not RobotControl.update.__code__:
            return None
        if event == "line" and frame.f_lineno == wanted and not threads:
            threads.append(
                threading.Thread(target=getattr(control, command), args=("by the operator",))
            )
            threads[0].start()
            # If the state is locked, the command takes longer and applies to the next tick.
            threads[0].join(0.01)
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    control.update()
    sys.settrace(before)
    for thread in threads:
        thread.join()
    leader.held = False
    control.update()
    if threads:
        assert control.state == ("paused" if command == "pause" else "stopped")
        assert control.held is not None


def test_a_stop_that_is_over_before_the_loop_looks_still_drops_the_plan() -> None:
    control = RobotControl()
    control.update()
    control.stop("by the operator")
    assert control.restart()
    assert control.hold() is not None
    assert control.hold() is None
