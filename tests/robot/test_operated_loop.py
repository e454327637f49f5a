"""What commands from the live page have a control loop do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scripted_leader import ScriptedLeader

from vlagents_ray.chunking.player import ChunkPlayer
from vlagents_ray.client.commands import COMMAND, CommandInbox
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.robot.loop import LoopReport, run_loop
from vlagents_ray.robot.operation.operated_loop import OperatedLoop
from vlagents_ray.robot.record import Recorder
from vlagents_ray.robot.safety import Watchdog


class Arm:
    """A robot that notes at which tick it was told what."""

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
    """A policy whose answers bring commands, at the ticks of `told`."""

    def __init__(self, inbox: CommandInbox, told: dict[int, str]) -> None:
        self._inbox, self._told, self._asked = inbox, told, 0

    def act(self, obs: Obs) -> Act:
        self._asked += 1
        act = Act(np.zeros(2, np.float32))
        if do := self._told.get(self._asked):
            act.info[COMMAND] = {"id": do, "do": do, "text": "fold" if do == "instruct" else ""}
        self._inbox.came(act)
        return act


def run(
    told: dict[int, str],
    *,
    ticks: int = 20,
    simulated: bool = True,
    watchdog: Watchdog | None = None,
) -> tuple[Arm, LoopReport, CommandInbox]:
    arm, inbox = Arm(simulated=simulated), CommandInbox()
    report = run_loop(
        arm,
        Commanding(inbox, told),
        hz=200,
        until=lambda: arm.ticks > ticks,
        commands=inbox,
        watchdog=watchdog,
    )
    return arm, report, inbox


def applied(arm: Arm) -> list[int]:
    return [tick - 1 for tick, did in arm.did if did == "apply"]  # the first observation is that of the reset


def test_a_paused_robot_stands_still_until_it_resumes() -> None:
    arm, report, _ = run({5: "pause", 12: "resume"})
    assert not set(range(5, 12)) & set(applied(arm))
    assert {4, 12} <= set(applied(arm))
    assert report.safe == {"paused from the live page": 7}


@pytest.mark.parametrize("label", ["success", "failure"])
def test_a_mark_ends_the_loop_before_another_action(label: str) -> None:
    arm, report, _ = run({6: label})
    assert report.outcome == label
    assert applied(arm)[-1] == 5
    assert arm.did[-1][1] == "stop"


def test_another_instruction_ends_the_loop() -> None:
    arm, report, _ = run({6: "instruct"})
    assert (report.next_instruction, report.outcome) == ("fold", "")
    assert applied(arm)[-1] == 5


def test_a_stopped_simulation_holds_until_it_resumes() -> None:
    arm, report, _ = run({5: "stop", 12: "resume"})
    assert not set(range(5, 12)) & set(applied(arm))
    assert 12 in applied(arm)
    assert report.safe == {"stopped from the live page": 7}


def test_a_stopped_robot_without_a_watchdog_ends_its_loop() -> None:
    arm, _, _ = run({5: "stop"}, simulated=False)
    assert applied(arm)[-1] == 4
    assert arm.did[-1][1] == "stop"


def test_a_stopped_robot_is_started_by_a_person_and_not_from_the_page() -> None:
    stopped: list[str] = []
    arm, report, inbox = run(
        {5: "stop", 12: "resume"}, simulated=False, watchdog=Watchdog(stopped.append, {"loop": 10.0})
    )
    assert stopped == ["stopped from the live page"]
    assert applied(arm)[-1] == 4
    assert report.barks == stopped
    assert "start it where it stands" in inbox.asking(Obs()).info["commanded"]["resume"]


def test_a_person_restarts_a_tripped_watchdog() -> None:
    with Watchdog(lambda _: None, {"loop": 10.0}) as watchdog:
        loop = OperatedLoop(None, watchdog, manual=True)
        loop.stop("lab")
        assert watchdog.barks == ["stopped from the live page by lab"]
        assert "waiting for a restart" in str(loop.holds())
        with pytest.raises(ConfigError):
            loop.resume()
        assert watchdog.restart()
        assert loop.holds() is None
        loop.pause()
        loop.resume()
        assert loop.holds() is None


def test_a_loop_without_commands_is_as_before() -> None:
    arm = Arm(simulated=True)
    report = run_loop(arm, Commanding(CommandInbox(), {3: "stop"}), hz=200, until=lambda: len(applied(arm)) > 8)
    assert report.safe == {}
    assert len(applied(arm)) == 9


def test_a_human_takes_over_in_a_pause_from_the_page_and_the_mark_labels_the_episode(tmp_path: Path) -> None:
    class Standing(Commanding):
        contract = Contract(action=ActionSpec(dim=2, delta=False))

    arm, inbox = Arm(simulated=False), CommandInbox()
    states: list[str] = []
    leader = ScriptedLeader(np.ones(2, np.float32), lambda: 8 <= arm.ticks < 12)
    agent = Standing(inbox, {3: "pause", 15: "pause", 18: "resume", 25: "success"})
    player = ChunkPlayer(agent, override=leader)

    def state() -> bool:
        states.append(player.takeover.state)
        return False

    with player, Recorder(tmp_path, 200, interventions=True) as recorder:
        report = run_loop(arm, player, hz=200.0, seconds=60.0, commands=inbox, recorder=recorder, until=state)
    changes = [state for state, before in zip(states[1:], states, strict=False) if state != before]
    assert changes == ["paused", "human", "autonomous", "paused", "autonomous"]
    assert (report.interventions, report.outcome) == (4, "success")
    assert report.paused >= 5
    assert (1, "stop") not in arm.did[:-1], "the safe action holds it"
    [about] = pq.read_table(next(tmp_path.glob("meta/episodes/*/*.parquet"))).to_pylist()
    assert about["label"] == "success"


def test_the_page_lets_a_policy_go_on_that_asked_for_help() -> None:
    class Doubting(Commanding):
        contract = Contract(action=ActionSpec(dim=2, delta=True))

        def act(self, obs: Obs) -> Act:
            act = super().act(obs)
            act.info["uncertainty"] = 1.0
            return act

    arm, inbox = Arm(simulated=False), CommandInbox()
    with ChunkPlayer(Doubting(inbox, {6: "resume", 12: "success"}), ask_for_help=0.5) as player:
        report = run_loop(arm, player, hz=200.0, seconds=60.0, commands=inbox)
    assert report.outcome == "success"
    assert 5 <= report.paused <= 7
