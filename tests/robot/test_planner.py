"""A robot with a planner: the policy's observations while the planner is punctual, late or down, in
virtual time.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from eval_fakes import Clock, wait_for

from vlagents_ray import Act, ActionSpec, Agent, ConfigError, Contract, Obs, PolicyUnavailable
from vlagents_ray.errors import VLAgentsError
from vlagents_ray.interface import (
    DEADLINE,
    FURTHER_MODEL,
    GOAL,
    SLACK,
    SLO,
    SUBTASK,
    SUBTASK_AGE,
    TICKS,
)
from vlagents_ray.robot import RobotWithPlanner, run_loop

PERIOD_S = 0.1  # period of the robot's ticks


class Planner(Agent):
    """A planner that answers request n with the subtask "n" when the test permits it."""

    contract = Contract(action=ActionSpec(dim=2))
    reads_slo = True

    def __init__(self) -> None:
        self.infos: list[dict[str, Any]] = []  # infos of the observations in its requests
        self.options: dict[str, Any] = {}
        self.instruction: str | None = None
        self.failure: Exception | None = None
        self.answer_info: dict[str, Any] = {}
        self.slo: dict[str, Any] = {"load": 0.1, "in_time": True}
        self.done = False
        self.closed = False
        self.gate = threading.Semaphore(1)  # the robot waits for the first answer

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.instruction, self.options = instruction, kwargs
        return {SLO: self.slo}

    def act(self, obs: Obs) -> Act:
        self.infos.append(obs.info)
        assert self.gate.acquire(timeout=60)
        if self.failure is not None:
            raise self.failure
        number = len(self.infos) - 1
        info = {SUBTASK: str(number), **self.answer_info}
        return Act(np.full(2, number, np.float32), done=self.done, info=info)

    def close(self) -> None:
        self.closed = True


class Arm:
    simulated = True

    def __init__(self) -> None:
        self.applied: list[np.ndarray] = []
        self.stops = 0

    def observe(self) -> Obs:
        return Obs(state={"joints": np.zeros(2, np.float32)}, info={"of_the_robot": 1})

    def apply(self, action: np.ndarray) -> None:
        self.applied.append(action)

    def stop(self) -> None:
        self.stops += 1


class Ticks:
    """Ticks of a robot in virtual time."""

    def __init__(self, clock: Clock, planner: Planner, robot: RobotWithPlanner) -> None:
        self._clock, self.planner, self.robot = clock, planner, robot
        self._begun_s = clock.now
        self._ticks = 0

    def run(self, seconds: float) -> Obs:
        """Let time pass, and return the last observation."""
        for _ in range(round(seconds / PERIOD_S)):
            self._ticks += 1
            self._clock.now = self._begun_s + round(self._ticks * PERIOD_S, 6)
            obs = self.robot.observe()
        return obs

    def answer(self) -> None:
        """Permit one answer of the planner, and wait until the robot can read it."""
        caller = self.robot._caller
        assert caller is not None
        self.planner.gate.release()
        wait_for(lambda: not caller.busy, every_s=0.001)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    clock.now = 100.0
    monkeypatch.setattr("vlagents_ray.robot.planner.time", SimpleNamespace(monotonic=clock))
    return clock


@pytest.fixture
def ticks(clock: Clock) -> Iterator[Ticks]:
    planner = Planner()
    robot = RobotWithPlanner(Arm(), planner, instruction="tidy up", hz=1.0, max_age_s=3.0)
    with robot:
        yield Ticks(clock, planner, robot)
        planner.gate.release(100)
    assert planner.closed


def test_each_observation_has_the_newest_subtask_and_its_age(ticks: Ticks) -> None:
    assert ticks.planner.instruction == "tidy up"
    obs = ticks.run(0.5)
    assert obs.info["of_the_robot"] == 1
    assert obs.info[SUBTASK] == "0"
    assert obs.info[GOAL].tolist() == [0, 0]
    assert obs.info[SUBTASK_AGE] == pytest.approx(500)
    assert len(ticks.planner.infos) == 1, "the next request should not be due yet"

    ticks.run(0.6)
    ticks.answer()
    obs = ticks.run(0.1)
    assert (obs.info[SUBTASK], obs.info[GOAL].tolist()) == ("1", [1, 1])
    # The subtask was computed from the observation at 1.0 s, and it is now 1.2 s.
    assert obs.info[SUBTASK_AGE] == pytest.approx(200)
    assert not hasattr(ticks.robot, "holds")


def test_a_request_states_how_long_the_planner_has_and_how_punctual_it_was(ticks: Ticks) -> None:
    assert ticks.planner.options[SLO] == {"hz": 1.0, "age_ms": 3000.0, "share": 0.98, "rows": 1}
    for _ in range(2):
        ticks.run(1.0)
        ticks.answer()
    ticks.run(1.0)
    wait_for(lambda: len(ticks.planner.infos) == 4)
    *_, last = ticks.planner.infos
    assert (last[SLACK], last[DEADLINE], last[TICKS]) == (1000.0, 3000.0, [1, 0])
    assert last[FURTHER_MODEL] is True, "the robot is counted only by the policy's server"
    assert "captured_at" in last
    figures = ticks.robot.planner_timeliness
    assert (figures.ticks, figures.starved) == (3, 0)


def test_a_late_planner_leaves_the_last_subtask_and_is_not_asked_twice(ticks: Ticks) -> None:
    obs = ticks.run(2.9)
    wait_for(lambda: len(ticks.planner.infos) == 2)
    assert obs.info[SUBTASK] == "0"
    assert not hasattr(ticks.robot, "holds")
    figures = ticks.robot.planner_timeliness
    # The first answer was in time; at 2 s the second answer was missing.
    assert (figures.ticks, figures.starved) == (2, 1)

    ticks.answer()
    obs = ticks.run(0.1)
    assert obs.info[SUBTASK] == "1"
    # The subtask comes from the observation at 1.0 s.
    assert obs.info[SUBTASK_AGE] == pytest.approx(2000)


def test_a_subtask_that_is_too_old_holds_the_robot_until_there_is_a_newer_one(
    ticks: Ticks,
) -> None:
    ticks.run(3.2)
    assert ticks.robot.holds == (
        "planner: expected a subtask of at most 3 s, got a subtask of 3.2 s: the planner has not "
        "answered yet; see the planner's server, or raise max_age_s"
    )
    ticks.answer()
    ticks.run(0.1)
    assert not hasattr(ticks.robot, "holds")


def test_a_planner_that_is_down_is_named_with_its_error_and_asked_again(
    ticks: Ticks, caplog: pytest.LogCaptureFixture
) -> None:
    ticks.planner.failure = PolicyUnavailable("http://gpu-box:8000/planner: connection refused")
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            ticks.run(1.0)
            ticks.answer()
        obs = ticks.run(0.1)
    assert (obs.info[SUBTASK], len(ticks.planner.infos)) == ("0", 4)
    [record] = [one for one in caplog.records if one.name == "vlagents_ray.robot.planner"]
    assert record.getMessage().startswith("planner: unavailable: http://gpu-box:8000/planner")
    assert "unavailable: http://gpu-box:8000/planner" in ticks.robot.holds
    assert ticks.robot.holds.startswith(
        "planner: expected a subtask of at most 3 s, got a subtask of 3.1"
    )

    ticks.planner.failure = None
    ticks.run(0.9)
    ticks.answer()
    obs = ticks.run(0.1)
    assert obs.info[SUBTASK] == "4"
    assert not hasattr(ticks.robot, "holds")
    assert ticks.planner.infos[-1][TICKS] == [4, 3], "no replica has counted the earlier ticks"


def test_an_answer_without_a_text_as_its_subtask_is_not_used(
    ticks: Ticks, caplog: pytest.LogCaptureFixture
) -> None:
    ticks.planner.answer_info = {SUBTASK: 7}
    ticks.run(1.0)
    ticks.answer()
    obs = ticks.run(0.1)
    assert obs.info[SUBTASK] == "0"
    assert caplog.messages[-1].startswith(
        "planner: invalid_action: info['subtask']: expected a text, got 7"
    )


def test_a_planner_that_fails_at_once_ends_the_episode_before_it_begins(clock: Clock) -> None:
    planner = Planner()
    planner.failure = PolicyUnavailable("connection refused")
    with pytest.raises(PolicyUnavailable, match="planner: connection refused"):
        RobotWithPlanner(Arm(), planner).__enter__()
    assert planner.closed


def test_a_planner_that_cannot_be_served_in_time_is_told_before_the_first_motion(
    clock: Clock, caplog: pytest.LogCaptureFixture
) -> None:
    planner = Planner()
    planner.slo = {"load": 1.3, "in_time": False, "reason": "add a replica"}
    with RobotWithPlanner(Arm(), planner):
        assert "planner: slo: add a replica" in caplog.messages


def test_the_same_robot_begins_another_episode(clock: Clock) -> None:
    planner = Planner()
    robot = RobotWithPlanner(Arm(), planner)
    for _ in range(2):
        planner.gate = threading.Semaphore(1)
        planner.done = True
        with robot:
            assert robot.task_done
            assert SUBTASK in robot.observe().info
    assert SUBTASK not in robot.observe().info, (
        "outside of an episode the wrapper passes the robot's observations unchanged"
    )


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"hz": 0}, "hz: expected a rate of the planner above 0 Hz, got 0"),
        ({"hz": float("nan")}, "hz: expected a rate"),
        (
            {"hz": 1, "max_age_s": 0.5},
            "max_age_s: expected at least the period of the planner, 1 s",
        ),
        ({"max_age_s": float("nan")}, "max_age_s: expected at least"),
    ],
)
def test_wrong_numbers_are_refused(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        RobotWithPlanner(Arm(), Planner(), **settings)


class Follower(Agent):
    """A policy that acts on the goal in its observation."""

    contract = Contract(action=ActionSpec(dim=2, delta=False))

    def __init__(self) -> None:
        self.subtasks: list[str] = []

    def act(self, obs: Obs) -> Act:
        self.subtasks.append(obs.info[SUBTASK])
        return Act(obs.info[GOAL])


def test_the_control_loop_holds_the_robot_for_an_old_subtask_and_goes_on() -> None:
    """In real time, the planner is silent from its second request, and answers again after the
    robot has held for some ticks.
    """
    planner, arm = Planner(), Arm()
    policy = Follower()
    held_ticks = 0

    with RobotWithPlanner(arm, planner, hz=20.0, max_age_s=0.1) as robot:

        def is_over() -> bool:
            nonlocal held_ticks
            if hasattr(robot, "holds"):
                held_ticks += 1
            if held_ticks == 5:
                planner.gate.release(1000)
            return policy.subtasks[-1:] > ["0"] and not hasattr(robot, "holds")

        report = run_loop(robot, policy, hz=100.0, seconds=60, until=is_over)
    assert report.safe["robot"] >= 4
    assert report.reasons["robot"].startswith("planner: expected a subtask of at most 0.1 s")
    assert {"0", policy.subtasks[-1]} <= set(policy.subtasks)
    assert policy.subtasks[-1] != "0"
    assert arm.stops >= 1


def test_errors_of_a_planner_keep_their_type(clock: Clock) -> None:
    planner = Planner()
    planner.failure = ValueError("not this package's")
    with pytest.raises(ValueError, match=r"^not this package's"):
        RobotWithPlanner(Arm(), planner).__enter__()
    assert not isinstance(planner.failure, VLAgentsError)
