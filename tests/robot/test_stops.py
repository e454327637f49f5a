"""Stops, pauses and marks: the actions that let the robot move again, and those that never do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scripted_leader import ScriptedLeader

from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.client.commands import COMMAND, CommandInbox
from vlagents_ray.columns import Columns
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.robot.loop import LoopOptions, run_loop
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.robot.watchdog import Watchdog


class Arm:
    """A robot that records its calls by tick."""

    def __init__(self, *, simulated: bool) -> None:
        self.simulated = simulated
        self.ticks = 0
        self.did: list[tuple[int, str]] = []

    def observe(self) -> Obs:
        self.ticks += 1
        return Obs()

    def apply(self, action: np.ndarray) -> None:
        self.did.append((self.ticks, "apply"))

    def stop(self) -> None:
        self.did.append((self.ticks, "stop"))


class Commanding(Agent):
    """A policy whose answers contain the commands in `told`, by tick."""

    def __init__(self, inbox: CommandInbox, told: dict[int, str]) -> None:
        self._inbox, self._told, self._asked = inbox, told, 0

    def act(self, obs: Obs) -> Act:
        self._asked += 1
        act = Act(np.zeros(2, np.float32))
        if do := self._told.get(self._asked):
            act.info[COMMAND] = {"id": do, "do": do, "text": "fold"}
        self._inbox.receive(act)
        return act


def applied(arm: Arm) -> list[int]:
    # The first observation belongs to the reset.
    return [tick - 1 for tick, did in arm.did if did == "apply"]


def test_a_paused_robot_stands_still_until_it_resumes_at_the_robot() -> None:
    arm, inbox = Arm(simulated=True), CommandInbox()

    def over() -> bool:
        if arm.ticks == 12:
            inbox.control.resume()
        return arm.ticks > 20

    report = run_loop(
        arm,
        Commanding(inbox, {5: "pause", 8: "resume", 9: "instruct"}),
        hz=200,
        until=over,
        options=LoopOptions(commands=inbox),
    )
    assert not set(range(5, 12)) & set(applied(arm))
    assert {4, 12} <= set(applied(arm))
    assert (report.safe, report.paused) == ({}, 7)


@pytest.mark.parametrize("label", ["success", "failure"])
def test_a_mark_ends_the_loop_before_another_action(label: str) -> None:
    arm, inbox = Arm(simulated=True), CommandInbox()
    report = run_loop(
        arm,
        Commanding(inbox, {6: label}),
        hz=200,
        until=lambda: arm.ticks > 20,
        options=LoopOptions(commands=inbox),
    )
    assert report.outcome == label
    assert applied(arm)[-1] == 5
    assert arm.did[-1][1] == "stop"


@pytest.mark.parametrize("simulated", [False, True])
@pytest.mark.parametrize("watched", [False, True])
def test_a_stop_from_the_page_is_over_when_a_person_restarts(
    *, simulated: bool, watched: bool
) -> None:
    dog = Watchdog(lambda _: None, {"loop": 10.0}) if watched else None
    arm, inbox = Arm(simulated=simulated), CommandInbox()
    agent = Commanding(inbox, {5: "stop", 8: "resume", 9: "instruct", 12: "success"})
    report = run_loop(arm, agent, hz=200, watchdog=dog, options=LoopOptions(commands=inbox))
    assert (report.outcome, report.barks, applied(arm)) == (
        "success",
        ["the live page"],
        [1, 2, 3, 4],
    )
    again = Arm(simulated=simulated)

    def over() -> bool:
        if again.ticks == 5:
            assert inbox.control.restart()
        return again.ticks > 8

    run_loop(again, agent, hz=200, watchdog=dog, until=over, options=LoopOptions(commands=inbox))
    assert applied(again)[0] == 5, "no tick before the restart"


@pytest.mark.parametrize("stop", ["trip", "bark"])
def test_a_protective_stop_outlives_the_run(stop: str) -> None:
    dog = Watchdog(lambda _: None, {"camera": 0.05 if stop == "bark" else 60.0})
    arm = Arm(simulated=False)
    inbox = CommandInbox()

    def over() -> bool:
        if stop == "trip" and arm.ticks == 5:
            dog.trip("a person is in the way")
        return dog.control.stopped

    run_loop(arm, Commanding(inbox, {}), hz=200, watchdog=dog, until=over)
    dog._limits["camera"] = 60.0
    for _ in range(2):
        before = len(applied(arm))
        run_loop(
            arm,
            Commanding(inbox, {}),
            hz=200,
            watchdog=dog,
            seconds=0.05,
            instruction="fold the cloth",
        )
        assert len(applied(arm)) == before
    assert dog.restart() is (stop == "trip")
    dog.heard("camera")
    assert dog.control.stopped is (stop == "bark")
    assert dog.restart()
    run_loop(arm, Commanding(inbox, {}), hz=200, watchdog=dog, seconds=0.05)
    assert len(applied(arm)) > before


def test_a_loop_without_commands_is_as_before() -> None:
    arm = Arm(simulated=True)
    report = run_loop(
        arm, Commanding(CommandInbox(), {3: "stop"}), hz=200, until=lambda: len(applied(arm)) > 8
    )
    assert report.safe == {}
    assert len(applied(arm)) == 9


def test_a_human_takes_over_in_a_pause_from_the_page_and_the_mark_labels_the_episode(
    tmp_path: Path,
) -> None:
    class Standing(Commanding):
        contract = Contract(action=ActionSpec(dim=2, delta=False))

    arm, inbox = Arm(simulated=False), CommandInbox()
    states: list[str] = []
    leader = ScriptedLeader(np.ones(2, np.float32), lambda: 8 <= arm.ticks < 12)
    agent = Standing(inbox, {3: "pause", 15: "pause", 18: "resume", 25: "success"})
    player = ChunkPlayer(agent, override=leader)

    def state() -> bool:
        states.append(player.control.state)
        return False

    with player, Recorder(tmp_path, 200, interventions=True) as recorder:
        report = run_loop(
            arm,
            player,
            hz=200.0,
            seconds=60.0,
            recorder=recorder,
            until=state,
            options=LoopOptions(commands=inbox),
        )
    changes = [state for state, before in zip(states[1:], states, strict=False) if state != before]
    assert changes == ["paused", "human", "autonomous", "paused"]
    assert (report.interventions, report.outcome) == (4, "success")
    assert report.paused >= 10
    [about] = pq.read_table(next(tmp_path.glob("meta/episodes/*/*.parquet"))).to_pylist()
    assert about["label"] == "success"


def test_a_pause_that_ends_between_the_players_decision_and_the_loops_moves_nothing() -> None:
    class Steady(Agent):
        contract = Contract(action=ActionSpec(dim=2, delta=True))

        def act(self, obs: Obs) -> Act:
            return Act(np.ones(2, np.float32))

    class Resumed(ChunkPlayer):
        def act(self, obs: Obs) -> Act:
            self.control.pause()
            act = super().act(obs)
            self.control.resume()
            return act

    arm = Arm(simulated=False)
    with Resumed(Steady(), PlayerSettings(deadline_s=1.0)) as player:
        report = run_loop(arm, player, hz=200.0, until=lambda: arm.ticks > 6)
    assert (report.paused, applied(arm)) == (6, [])


@pytest.mark.parametrize("delta", [False, True])
@pytest.mark.parametrize("arms", [None, ("left", "right")])
def test_a_simulated_robot_stops_where_it_is_and_keeps_its_grasp(
    delta: bool, arms: tuple[str, ...] | None
) -> None:
    dim = 3 * len(arms or ("",))
    spec = ActionSpec(dim=dim, delta=delta, gripper_open=1.0, gripper_closed=0.0, arms=arms)
    robot = SimulatedRobot(Contract(action=spec))
    robot.apply(np.full(dim, 1.0, np.float32))
    robot.observe()
    for _ in range(3):
        robot.stop()
    before = robot.observe().state["joints"]
    for _ in range(50):
        after = robot.observe().state["joints"]
    grippers = list(Columns.from_spec(spec, dim).grippers)
    assert np.allclose(np.delete(after, grippers), np.delete(before, grippers))
    assert np.allclose(after[grippers], 1.0), "as commanded before the stop"
