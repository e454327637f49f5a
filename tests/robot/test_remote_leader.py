"""A robot that a human at the live page may move: which commands count, and who goes first."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from manual_clock import Clock
from scripted_leader import ScriptedLeader

from vlagents_ray import Act, ActionSpec, Agent, ConfigError, Contract, Obs
from vlagents_ray.chunking.player import ChunkPlayer
from vlagents_ray.chunking.takeover import Leader
from vlagents_ray.client.credentials import ANONYMOUS
from vlagents_ray.client.steering import BEAT_S, IDLE_S, SILENT_S, Steering
from vlagents_ray.errors import InvalidAction, MalformedMessage
from vlagents_ray.interface import INTERVENTION, SAFE
from vlagents_ray.robot import Guard
from vlagents_ray.robot.operation.operated_loop import OperatedLoop
from vlagents_ray.robot.teleoperation import RemoteLeader
from vlagents_ray.robot.teleoperation.remote_link import RemoteLink

CONTRACT = Contract(
    action=ActionSpec(dim=4, delta=True, gripper_open=1.0, gripper_closed=-1.0, low=-1.0, high=1.0), gripper=True
)
DEADLINE_S = 0.3
SEEN = Obs(gripper=1.0)


class Still(Agent):
    contract = CONTRACT

    def act(self, obs: Obs) -> Act:
        return Act(np.array([0, 0, 0.25, 1], np.float32))


class Human:
    """A robot with a leader, and the human who moves it from far away; the test sets the time."""

    def __init__(self, clock: Clock, leader: RemoteLeader, guard: Guard | None = None) -> None:
        self.clock, self.leader = clock, leader
        self.player = ChunkPlayer(Still(), override=leader, check=guard)
        self.player.reset(SEEN, "stack")
        self.seq, self.holds, self.beat = 0, 0, 0

    def take(self) -> None:
        self.holds += 1
        self.seq = 0
        self.leader.receive({"do": "begin", "hold": f"hold {self.holds}", "by": "lab"})
        self.move(0)

    def move(self, x: float, *, beat: int | None = None, seq: int | None = None, grips: int = 0) -> None:
        """A command that answers a beat of this moment, unless the test says which."""
        if beat is None:
            beat = self.beat = int(self.leader.beat()["beat"])
        command = Steering(self.seq if seq is None else seq, beat, (x, 0, 0, 0, 0, 0), grips)
        self.seq += 1
        self.leader.receive(command.message(f"hold {self.holds}"))

    def tell(self, do: str, **more: str) -> None:
        self.leader.receive({"do": do, "hold": f"hold {self.holds}", **more})

    def tick(self) -> str:
        """What moves the robot, and in which way."""
        act = self.player.act(SEEN)
        if SAFE in act.info:
            return f"holds: {act.info[SAFE]}"
        return f"{'human' if act.info.get(INTERVENTION) else 'policy'} {act.action[0]:g}"

    @property
    def ended(self) -> str:
        why = self.leader.beat()["ended"]
        return str(why[1])


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    for module in ("remote", "relay"):
        monkeypatch.setattr(f"vlagents_ray.robot.teleoperation.{module}.time.monotonic", clock)
    monkeypatch.setattr(RemoteLink, "open", lambda link: setattr(link, "_thread", object()))
    monkeypatch.setattr(RemoteLink, "close", lambda link: setattr(link, "_thread", None))
    return clock


def made(local: Leader | None = None, **options: Any) -> RemoteLeader:
    agent: Any = SimpleNamespace(url="http://robots", credentials=ANONYMOUS, session="7f3a", contract=CONTRACT)
    return RemoteLeader(agent, local=local, deadline_s=DEADLINE_S, **options)


@pytest.fixture
def human(clock: Clock) -> Iterator[Human]:
    with made() as leader:
        yield Human(clock, leader)


def test_a_human_far_away_moves_the_robot_by_the_axes_of_any_device(human: Human) -> None:
    assert human.tick() == "policy 0"
    human.take()
    human.move(-0.5)
    assert human.tick() == "human -0.25"
    assert human.leader.beat()["moves"] is True
    human.tell("release")
    assert human.tick() == "policy 0"
    assert human.player.takeover.state == "autonomous"


def test_a_command_counts_until_the_deadline_after_the_beat_that_it_answers(human: Human) -> None:
    human.take()
    human.move(1)
    human.clock.now += DEADLINE_S - 0.01
    assert human.tick() == "human 0.5"
    human.clock.now += 0.02
    assert human.tick() == "holds: leader: relay: no command for 0.31 s"
    assert human.leader.beat()["moves"] is False
    human.move(1)
    assert human.tick() == "human 0.5"


def test_a_command_from_before_a_stall_of_the_network_does_not_count_when_it_comes(human: Human) -> None:
    human.take()
    human.clock.now += 1.0
    for _ in range(3):  # they were waiting on the way
        human.move(1, beat=human.beat)
    assert human.tick().startswith("holds: ")
    human.move(1, beat=10**6)
    assert human.tick().startswith("holds: "), "a beat that this robot has not sent"
    human.move(1)
    assert human.tick() == "human 0.5"


def test_a_command_out_of_order_does_not_count(human: Human) -> None:
    human.take()
    human.move(1, seq=8)
    human.move(-1, seq=7)
    human.move(-1, seq=8)
    assert human.tick() == "human 0.5"
    human.move(-1, seq=9, beat=human.beat)
    assert human.tick() == "human -0.5", "several commands may answer one beat"


@pytest.mark.parametrize(
    "message",
    [
        {},
        {"do": "move"},
        {"do": "move", "hold": "another", "seq": 1, "beat": 1, "axes": [1, 0, 0, 0, 0, 0], "grips": 0},
        {"do": "move", "hold": "hold 1", "seq": 1, "beat": 1, "axes": [2, 0, 0, 0, 0, 0], "grips": 0},
        {"do": "begin", "hold": 3},
        {"do": "dance", "hold": "hold 1"},
    ],
)
def test_a_message_of_another_form_moves_nothing(human: Human, message: dict[str, Any]) -> None:
    human.take()
    human.leader.receive(message)
    assert human.tick() == "human 0"


@pytest.mark.parametrize(
    "changed",
    [
        {"seq": -1},
        {"seq": True},
        {"beat": 1.5},
        {"grips": None},
        {"axes": [0] * 5},
        {"axes": [0] * 5 + [float("nan")]},
        {"axes": [0] * 5 + [1.01]},
        {"axes": [False] * 6},
        {"axes": "wasd"},
    ],
)
def test_a_command_of_another_form_is_malformed(changed: dict[str, Any]) -> None:
    right = {"seq": 3, "beat": 1, "axes": [0, 1, -0.5, 0, 0, 0], "grips": 2}
    assert Steering.of(right).message("a") == {"do": "move", "hold": "a", **right}
    with pytest.raises(MalformedMessage, match="want"):
        Steering.of(right | changed)


def test_the_gripper_moves_once_for_each_press_also_if_a_command_is_lost(human: Human) -> None:
    human.take()
    human.move(0, grips=1)
    human.move(0, grips=1)
    assert human.player.act(SEEN).action[-1] == -1
    human.move(0, grips=3)  # the command with 2 was lost
    assert human.player.act(SEEN).action[-1] == -1
    human.move(0, grips=4)
    assert human.player.act(SEEN).action[-1] == 1


@pytest.mark.parametrize("told", [True, False])
def test_a_robot_whose_human_is_gone_is_paused_until_somebody_resumes(human: Human, told: bool) -> None:
    human.take()
    human.tick()
    if told:
        human.tell("gone", why="the page has gone")
    else:
        human.clock.now += SILENT_S + 0.1
    why = "the page has gone" if told else "no command came for 3 s"
    assert human.tick() == f"holds: the human at the live page is gone: {why}"
    assert (human.player.takeover.state, human.ended) == ("paused", why)
    human.move(1)
    assert human.tick().startswith("holds"), "of a hold that is over"
    human.player.takeover.resume(here=False)
    assert human.tick() == "policy 0"


def test_one_who_took_over_and_sent_nothing_that_counts_leaves_the_robot_to_the_policy(human: Human) -> None:
    human.leader.receive({"do": "begin", "hold": "hold 1", "by": "lab"})
    assert (human.leader.by, human.tick()) == ("lab", "policy 0")
    human.clock.now += SILENT_S + 0.1
    assert human.tick() == "policy 0"
    assert human.leader.by is None


def test_another_human_who_takes_over_ends_the_hold_of_the_first(human: Human) -> None:
    human.take()
    human.take()
    assert human.ended == "somebody else has taken over"
    human.holds = 1
    human.move(1, seq=5)
    assert human.tick() == "human 0"


def test_any_pause_ends_the_hold_and_only_one_from_elsewhere_ends_by_taking_over_again(human: Human) -> None:
    takeover = human.player.takeover
    loop = OperatedLoop(None, None, manual=True, takeover=takeover)
    for pause, again in ((takeover.pause, False), (loop.pause, True)):
        human.take()
        human.move(1)
        assert human.tick() == "human 0.5"
        pause()
        assert human.tick().startswith("holds: paused"), "at once"
        assert human.ended.startswith("paused")
        human.move(1)
        assert human.tick().startswith("holds: paused"), "the next command does not end it"
        human.take()
        human.move(1)
        assert human.tick() == ("human 0.5" if again else "holds: paused by an operator")
        if not again:
            with pytest.raises(ConfigError, match="resume it there"):
                loop.resume()
            loop.pause()  # which makes it no weaker
            with pytest.raises(ConfigError, match="resume it there"):
                loop.resume()
            takeover.resume()
            assert human.tick() == "policy 0"


def test_a_stop_ends_the_hold_and_nobody_takes_over_while_it_lasts(human: Human) -> None:
    human.take()
    for _ in range(2):
        human.move(1)
        human.tick()
        human.player.interrupt()
        assert human.ended == "the robot was stopped"
        human.take()
    human.tick()
    human.player.interrupt()
    assert human.leader.by is None


def test_a_human_is_told_what_the_guard_refuses(clock: Clock) -> None:
    with made(step=0.8) as leader:
        human = Human(clock, leader, Guard(CONTRACT, high=np.array([0.5, 1, 1, 1])))
        human.take()
        human.move(1)
        assert human.tick().startswith("holds: ")
        said = leader.beat()
        assert said["moves"] is False
        assert "0.5" in said["why"]


def test_a_human_at_the_robot_goes_first(clock: Clock) -> None:
    local = ScriptedLeader(np.array([0.75, 0, 0, 1], np.float32))
    with made(local) as leader:
        human = Human(clock, leader)
        human.take()
        human.move(1)
        assert human.tick() == "human 0.5"
        local.held = True
        assert human.tick() == "human 0.75"
        assert human.ended == "somebody at the robot has taken over"
        human.take()
        human.move(1)
        assert human.tick() == "human 0.75"
        local.held = False
        assert human.tick() == "policy 0", "who was sent away has to take over again"


def test_a_robot_is_offered_only_inside_of_the_context(clock: Clock) -> None:
    leader = made()
    with pytest.raises(ConfigError, match="with RemoteLeader"):
        leader.engaged()
    with leader:
        assert not leader.engaged()


def test_what_cannot_be_moved_remotely_says_so() -> None:
    agent: Any = SimpleNamespace(url="serve://app", credentials=ANONYMOUS, session="7f3a", contract=CONTRACT)
    with pytest.raises(ConfigError, match="live page"):
        RemoteLeader(agent)
    agent.contract = None
    with pytest.raises(ConfigError, match=r"action\.dim"):
        RemoteLeader(agent)
    with pytest.raises(ConfigError, match="deadline_s"):
        RemoteLeader(agent, CONTRACT, deadline_s=0.0)


def test_beats_are_frequent_while_somebody_holds_the_robot(human: Human) -> None:
    assert human.leader.beat_s == IDLE_S
    human.take()
    assert human.leader.beat_s == BEAT_S
    assert human.leader.beat()["session"] == "7f3a"


def test_a_release_in_the_middle_of_a_tick_holds_the_robot_and_ends_no_pause(clock: Clock) -> None:
    local = ScriptedLeader(np.array([0.75, 0, 0, 1], np.float32))
    with made(local) as leader:
        human = Human(clock, leader)
        human.take()
        assert leader.engaged()
        human.tell("release")
        with pytest.raises(InvalidAction, match="given the robot back"):
            leader.action(SEEN)
        assert local.given == [], "who is at the robot has not engaged his leader"
        human.player.takeover.pause()
        engaged = leader.engaged

        def released() -> bool:
            human.take()
            was = engaged()
            human.tell("release")
            return was

        leader.engaged = released  # type: ignore[method-assign]
        for _ in range(2):
            assert human.tick() == "holds: paused by an operator"
