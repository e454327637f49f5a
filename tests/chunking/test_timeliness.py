"""The ticks that count as in time, and the reports of a player to its server about them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from eval_fakes import wait_for
from hypothesis import given, settings
from hypothesis import strategies as st

from vlagents_ray import Act, ActionSpec, Agent, Contract, Obs, PolicyUnavailable
from vlagents_ray.chunking import player as player_module
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.chunking.timeliness import Timeliness, TimeShare, in_words
from vlagents_ray.errors import ConnectionLost, DeadlineExceeded, Overloaded, TooManyRequests
from vlagents_ray.interface import (
    AGE_MS,
    EXECUTED_AGE,
    IN_TIME,
    INTERVENTION,
    REPLAN,
    SAFE,
    SLACK,
    TICKS,
)


class Answers(Agent):
    """A policy that answers with `rows` rows when the test permits it. The first request, which
    belongs to a reset, is answered at once.
    """

    contract = Contract(action=ActionSpec(dim=1, delta=True))

    def __init__(self, rows: int) -> None:
        self.rows = rows
        self.infos: list[dict[str, Any]] = []  # infos of the observations in its requests
        self.answer_info: dict[str, Any] = {}
        self.failure: Exception | None = None
        self.let = 1  # number of requests that it answers
        self.answered = 0

    def reset(self, obs: Obs, instruction: str | None = None, **kwargs: Any) -> dict[str, Any]:
        return {}

    def act(self, obs: Obs) -> Act:
        self.infos.append(obs.info)
        wait_for(lambda: self.let >= len(self.infos), every_s=0.0005)
        self.answered += 1
        if self.failure is not None:
            raise self.failure
        return Act(np.ones((self.rows, 1), np.float32), info=dict(self.answer_info))


class Driver:
    """A robot whose operator counts the actions that move it."""

    def __init__(self, rows: int, **options: Any) -> None:
        self.agent = Answers(rows)
        self.player = ChunkPlayer(self.agent, PlayerSettings(mode="async", **options))
        self.player.reset(Obs(), "stack")
        self.ticks = self.starved = 0
        self._waits_after_stop = False

    def tick(self) -> Act:
        """Act, and count the tick according to the executed action."""
        act = self.player.act(Obs())
        if self.player.control.state != "autonomous":
            self._waits_after_stop = True
            return act
        moved = SAFE not in act.info
        if moved:
            self._waits_after_stop = False
        if not self._waits_after_stop:
            self.ticks += 1
            self.starved += not moved
        return act

    def answer(self) -> None:
        """Permit the policy's answer to the current request, and wait until the player can
        use it.
        """
        caller = self.player._caller
        assert caller is not None
        if not caller.busy:
            return
        agent = self.agent
        wait_for(
            lambda: not caller.busy or len(agent.infos) > agent.answered,
            every_s=0.0005,
        )
        self.agent.let = max(self.agent.let, len(self.agent.infos))
        wait_for(lambda: not caller.busy, every_s=0.0005)

    def request(self, number: int) -> dict[str, Any]:
        """Return the info of a request as soon as it has been sent. Request 0 is the request of the
        reset.
        """
        wait_for(lambda: len(self.agent.infos) > number, every_s=0.0005)
        return self.agent.infos[number]

    def stop(self) -> None:
        """Stop the robot, and let it continue."""
        self.player.interrupt()
        self._waits_after_stop = True

    def close(self) -> None:
        self.agent.let = 10**9
        self.player.close()


@given(
    rows=st.sampled_from([1, 2, 8]),
    steps=st.lists(
        st.sampled_from(["tick", "tick", "tick", "answer", "pause", "resume", "stop"]),
        max_size=40,
    ),
)
@settings(max_examples=40, deadline=None)
def test_the_player_counts_what_an_observer_of_the_robot_counts(
    rows: int, steps: list[str]
) -> None:
    driver = Driver(rows)
    try:
        for step in steps:
            if step == "tick":
                act = driver.tick()
                assert act.info.get(IN_TIME, SAFE not in act.info) is (SAFE not in act.info)
            elif step in ("pause", "resume"):
                getattr(driver.player.control, step)()
            else:
                getattr(driver, step)()
        assert driver.player.timeliness.ticks == driver.ticks
        assert driver.player.timeliness.starved == driver.starved
    finally:
        driver.close()


def test_a_lost_server_starves_its_robot() -> None:
    driver = Driver(2)
    driver.agent.failure = PolicyUnavailable("gone")
    for _ in range(4):
        driver.tick()
        driver.answer()
    assert driver.player.timeliness.starved == 2
    driver.close()


def test_a_row_that_the_guard_refuses_was_in_time_and_the_wait_after_it_does_not_count() -> None:
    def refuse(action: np.ndarray, last: np.ndarray | None, obs: Obs | None = None) -> np.ndarray:
        if action.any():
            raise player_module.InvalidAction("too far")
        return action

    agent = Answers(4)
    player = ChunkPlayer(agent, PlayerSettings(mode="async"), check=refuse)
    player.reset(Obs(), "stack")
    act = player.act(Obs())
    assert act.info[IN_TIME] is True
    assert SAFE in act.info
    assert player.timeliness.time_share.share == 1.0

    # The policy has not yet answered to an observation made after the rejection.
    for _ in range(3):
        act = player.act(Obs())
        assert SAFE in act.info
        assert IN_TIME not in act.info
    assert (player.timeliness.ticks, player.timeliness.starved) == (1, 0)
    agent.let = 10**9
    player.close()


def test_a_request_reports_the_ticks_since_the_last_one_and_the_slack() -> None:
    driver = Driver(4)
    for _ in range(2):
        driver.tick()
    of_the_reset = driver.request(0)
    assert (of_the_reset[SLACK], of_the_reset[TICKS]) == (0.0, [0, 0])
    first = driver.request(1)
    assert first[TICKS] == [1, 0]  # requested at the second tick, after the first was counted
    assert first[EXECUTED_AGE] >= 0

    # begin times of ticks at 1 Hz
    driver.player._tick_begins.extend(float(tick) for tick in range(20))
    for _ in range(4):
        driver.tick()
    driver.answer()
    driver.tick()
    last = driver.request(2)
    ticks, starved = last[TICKS]
    assert (ticks, starved) == (5, 2)  # the rows of the first answer have ended
    driver.close()


@pytest.mark.parametrize(
    ("failure", "next_report"),
    [
        (TooManyRequests("over 5 requests a second"), [3, 0]),
        (Overloaded("no memory"), [3, 0]),
        (PolicyUnavailable("no replica"), [3, 0]),
        (ConnectionLost("closed"), [3, 0]),
        # The server may have counted the ticks of this request.
        (DeadlineExceeded("after 2 s"), [2, 0]),
    ],
    ids=lambda value: type(value).__name__,
)
def test_the_ticks_of_a_rejected_request_are_reported_again_with_the_next_one(
    failure: Exception, next_report: list[int]
) -> None:
    driver = Driver(4)
    for _ in range(3):
        driver.tick()
    assert driver.request(1)[TICKS] == [1, 0]
    driver.agent.failure = failure
    driver.answer()
    driver.tick()
    assert driver.request(2)[TICKS] == next_report
    driver.close()


@pytest.mark.parametrize(("rows_left", "slack_ms"), [(1, 1000.0), (2, 2000.0), (5, 5000.0)])
def test_the_slack_is_the_time_of_the_rows_that_are_left(rows_left: int, slack_ms: float) -> None:
    driver = Driver(rows_left)
    driver.player._tick_begins.extend(float(tick) for tick in range(20))
    assert driver.player._slack_ms() == slack_ms
    driver.player._wire_ms = 300.0
    assert driver.player._slack_ms() == max(0.0, slack_ms - 300.0)
    driver.close()


def test_a_player_asks_no_sooner_than_the_server_wants_but_never_starves_for_it() -> None:
    driver = Driver(10)
    driver.player._period_ms = lambda: 1000.0  # type: ignore[method-assign]
    # A batch takes two ticks, and the network half a tick.
    driver.agent.answer_info = {REPLAN: 1e6, "timing": {"inference_ms": 2000.0, "wire_ms": 500.0}}
    driver.agent.let = 10**9
    for _ in range(3):
        driver.tick()
        driver.answer()
    requests = len(driver.agent.infos)

    played = 0
    while len(driver.agent.infos) == requests:
        driver.tick()
        driver.answer()
        played += 1
        assert played < 10
    # The request was sent with three rows left after the current one: slack for the batch and half
    # a tick.
    assert driver.player._plan.known == 3
    assert driver.player.timeliness.starved == 0
    driver.close()


def test_the_answer_at_the_reset_sets_the_pace_too() -> None:
    """Otherwise all robots of a fleet that begins at once would send their second requests
    at once.
    """
    agent = Answers(10)
    agent.answer_info = {REPLAN: 1e6, "timing": {"inference_ms": 0.0, "wire_ms": 0.0}}
    agent.let = 10**9
    player = ChunkPlayer(agent, PlayerSettings(mode="async"))
    player.reset(Obs(), "stack")
    for _ in range(5):
        assert SAFE not in player.act(Obs()).info
    assert len(agent.infos) == 1
    player.close()


@pytest.mark.parametrize("replan_ms", ["soon", None, float("nan"), float("inf"), -1.0, 10**400])
def test_a_wrong_time_of_the_next_request_delays_none(replan_ms: Any) -> None:
    driver = Driver(10)
    driver.agent.answer_info = {REPLAN: replan_ms}
    driver.agent.let = 10**9
    for _ in range(4):
        driver.tick()
        driver.answer()
    assert len(driver.agent.infos) >= 3
    driver.close()


@pytest.mark.parametrize("timing", [None, 5, "soon", []])
def test_an_agent_may_use_the_name_of_the_timing_for_something_else(timing: Any) -> None:
    driver = Driver(4)
    driver.agent.answer_info = {"timing": timing}
    driver.agent.let = 10**9
    for _ in range(3):
        assert SAFE not in driver.tick().info
        driver.answer()
    driver.close()


def test_an_operators_ticks_do_not_count() -> None:
    timeliness = Timeliness()
    timeliness.count({INTERVENTION: True})
    timeliness.count({IN_TIME: True, AGE_MS: 30.0})
    timeliness.count({IN_TIME: False})
    timeliness.count_missed(2)
    assert timeliness.time_share == TimeShare(4, 3, 30.0, 30.0, 30.0)
    assert timeliness.time_share.share == 0.25


def test_figures_have_nearest_rank_ages_and_are_unknown_without_ticks() -> None:
    assert Timeliness().time_share.to_json() == {
        "ticks": 0,
        "starved": 0,
        "age_p50_ms": None,
        "age_p95_ms": None,
        "age_p99_ms": None,
        "share": None,
    }
    time_share = TimeShare.from_ages(200, 100, map(float, range(100, 0, -1)))
    assert time_share == (200, 100, 50.0, 95.0, 99.0)
    assert in_words(time_share) == (
        "in time: 50.00% of 200 ticks of the policy; age of its actions p50 50 ms, p95 95 ms, "
        "p99 99 ms"
    )
    assert in_words(TimeShare(3, 3)) == "in time: 0.00% of 3 ticks of the policy"
