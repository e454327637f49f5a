"""The control loop, its chunk player and the server count the same ticks in time."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from eval_fakes import SimulatedTime, wait_for
from robot_trials import Policies, Reaching, ScriptedPerson, judged, plan, tasks

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.chunking.timeliness import Timeliness, TimeShare
from vlagents_ray.cli.robot import main as drive
from vlagents_ray.evaluate.robot import evaluate_on_robot
from vlagents_ray.interface import TICKS
from vlagents_ray.robot import LoopOptions, LoopReport, run_loop
from vlagents_ray.robot.simulated import SimulatedRobot
from vlagents_ray.serve.in_time import RobotReport, RobotTimes

HZ = 10.0


class VirtualTime(SimulatedTime):
    """A stand-in for the module `time`, including the time of day."""

    time = SimulatedTime.monotonic


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> VirtualTime:
    clock = VirtualTime()
    for module in ("chunking.buffer", "chunking.player", "robot.loop", "robot.pacing"):
        monkeypatch.setattr(f"vlagents_ray.{module}.time", clock)
    return clock


class Slow(Agent):
    """A policy that returns `rows` rows after `answer_s` of virtual time, and sums up the reports
    in requests.
    """

    contract = Contract(action=ActionSpec(dim=1, delta=False, low=-1.0, high=1.0))

    def __init__(self, clock: VirtualTime, answer_s: float, rows: int = 4) -> None:
        self._clock, self._answer_s, self._rows = clock, answer_s, rows
        self.times = RobotTimes()  # the same sums as in a server

    def act(self, obs: Obs) -> Act:
        report = RobotReport.of(obs.info)
        if report is not None:
            self.times.add(report, 0.0)
        self._clock.now += self._answer_s
        return Act(np.zeros((self._rows, 1), np.float32))


class Arm(SimulatedRobot):
    """An arm that records the times of its commands."""

    def __init__(self, clock: VirtualTime) -> None:
        super().__init__(Slow.contract)
        self._clock = clock
        self.commanded: list[float] = []

    def apply(self, action: np.ndarray) -> None:
        super().apply(action)
        self.commanded.append(self._clock.now)


def ran(clock: VirtualTime, agent: Agent, seconds: float) -> tuple[LoopReport, Arm]:
    arm = Arm(clock)
    return run_loop(arm, agent, hz=HZ, seconds=seconds), arm


@pytest.mark.parametrize(
    ("seconds", "expected"),
    [
        # Each chunk costs the tick after its request, even if the end of the run cuts the chunk
        # short.
        (4.0, TimeShare(40, 8, 250.0, 400.0, 400.0)),
        (3.7, TimeShare(37, 8, 250.0, 400.0, 400.0)),
        (3.6, TimeShare(36, 7, 250.0, 400.0, 400.0)),
    ],
)
def test_ticks_that_a_loop_missed_while_it_waited_are_starved(
    clock: VirtualTime, seconds: float, expected: TimeShare
) -> None:
    report, arm = ran(clock, ChunkPlayer(Slow(clock, 0.25)), seconds)
    assert report.timeliness.time_share == pytest.approx(expected, abs=1.0)
    assert len(arm.commanded) == expected.ticks - expected.starved, (
        "the robot's commands must give the same count"
    )
    assert report.jitter["missed"] == expected.starved


@pytest.mark.parametrize("mode", ["open_loop", "ensemble", "async"])
@pytest.mark.parametrize("answer_s", [0.0, 0.05, 0.25, 0.7])
def test_loop_player_and_server_count_the_same(
    clock: VirtualTime, mode: Any, answer_s: float
) -> None:
    agent = Slow(clock, answer_s)
    with ChunkPlayer(agent, PlayerSettings(mode, deadline_s=30.0)) as player:
        report, arm = ran(clock, player, 5.0)
        counted = report.timeliness
        assert counted is player.timeliness
        assert counted.ticks == report.jitter["ticks"] + report.jitter["missed"] == 50
        assert counted.ticks - counted.starved == len(arm.commanded)

        # The server knows the ticks until the last request.
        caller = player._caller
        assert caller is not None
        wait_for(lambda: not caller.busy)
        rest = RobotReport.of(player._request_info())
        assert rest is not None
        served = agent.times.lately(0.0)  # all reports are of this second
        ticks, starved = served.ticks + rest.ticks, served.starved + rest.starved
        assert (ticks, starved) == (counted.ticks, counted.starved)


class EntryPoints:
    """The programs that drive a robot for 40 ticks, with answers of 4 rows after 2.5 ticks. Each
    method returns the reported numbers of ticks and of starved ticks.
    """

    def __init__(
        self,
        clock: VirtualTime,
        tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        self._clock, self._tmp_path = clock, tmp_path
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def run_loop(self) -> tuple[int, int]:
        settings = PlayerSettings("open_loop", deadline_s=1.0)
        with ChunkPlayer(Slow(self._clock, 0.25), settings) as player:
            report, _ = ran(self._clock, player, 4.0)
        return report.timeliness.ticks, report.timeliness.starved

    def command(self) -> tuple[int, int]:
        clock = self._clock

        class Served(Slow):
            transport = "local"

            def __init__(self, *_: object, **__: object) -> None:
                super().__init__(clock, 0.25)

        self._monkeypatch.setattr("vlagents_ray.cli.robot.RemoteAgent", Served)
        drive(["http://nowhere", "--seconds", "4", "--hz", "10", "--mode", "open_loop"])
        said = re.search(r"in time: ([\d.]+)% of (\d+) ticks", self._capsys.readouterr().out)
        assert said is not None
        ticks = int(said[2])
        return ticks, round((1 - float(said[1]) / 100) * ticks)

    def trial(self) -> tuple[int, int]:
        clock = self._clock

        class Policy(Reaching):
            def act(self, obs: Obs) -> Act:
                clock.now += 0.25
                return super().act(obs)

        config = plan(
            self._tmp_path / "out",
            robot={"hz": 10, "tasks": tasks(max_steps=40)},
            suite={"envs": ["drawer"], "episodes": 1},
        )
        person = ScriptedPerson(judged("s"))
        summary = evaluate_on_robot(config, person, agent_factory=Policies(Policy))
        [(ticks, starved)] = {
            (result.ticks or 0, result.starved or 0) for result in summary.results.counted
        }
        return ticks, starved


@pytest.mark.parametrize("entry_point", ["run_loop", "command", "trial"])
def test_all_entry_points_tell_the_same_ticks(
    clock: VirtualTime,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    entry_point: str,
) -> None:
    programs = EntryPoints(clock, tmp_path, monkeypatch, capsys)
    # The reset waits for the first 4 rows. Each further chunk, every 5 ticks, costs one tick.
    assert getattr(programs, entry_point)() == (40, 7)


def test_an_agent_without_a_plan_is_counted_by_the_loop(clock: VirtualTime) -> None:
    class Single(Slow):
        def act(self, obs: Obs) -> Act:
            assert TICKS not in obs.info
            return Act(super().act(obs).action[0])

    report, arm = ran(clock, Single(clock, 0.25), 3.0)
    assert report.timeliness.time_share[:2] == (30, 18)
    assert len(arm.commanded) == 12


def test_a_report_of_the_caller_has_the_ticks_of_a_run_that_failed(clock: VirtualTime) -> None:
    class Failing(Slow):
        def act(self, obs: Obs) -> Act:
            if clock.now > 2.2:
                raise ValueError("broken")
            return super().act(obs)

    report = LoopReport(HZ)
    assert isinstance(report.timeliness, Timeliness)
    with pytest.raises(ValueError, match="broken"):
        run_loop(
            Arm(clock),
            ChunkPlayer(Failing(clock, 0.25)),
            hz=HZ,
            seconds=4.0,
            options=LoopOptions(report=report),
        )
    assert report.timeliness.time_share[:2] == (25, 5)
