"""The chunk player with policies whose answers a test releases."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from eval_fakes import Clock, wait_for
from in_process_replicas import Replicas

from vlagents_ray import (
    Act,
    ActionSpec,
    Agent,
    ConfigError,
    Contract,
    InvalidObservation,
    NotReset,
    Obs,
    PolicyFailed,
    PolicyUnavailable,
)
from vlagents_ray.chunking.player import ChunkPlayer, PlayerSettings
from vlagents_ray.errors import InvalidAction
from vlagents_ray.interface import DELAY, GIVEN, LEFTOVER
from vlagents_ray.robot import Guard
from vlagents_ray.testing import check_agent

HORIZON = 6


class Counting(Agent):
    """A policy that answers the observation of tick t with the rows t, t + 0.1, t + 0.2, ..., when
    the test permits it.
    """

    shared = ("seen",)

    def __init__(
        self, *, gated: bool = False, rows: int = HORIZON, done_at: int | None = None
    ) -> None:
        self.seen: list[dict[str, Any]] = []  # info of its observations
        self.failure: Exception | None = None
        self.rows = rows
        self.done_at = done_at
        self.gated = gated
        self.gate = threading.Semaphore(0)

    contract = Contract(action=ActionSpec(dim=2, delta=False))

    def act(self, obs: Obs) -> Act:
        self.seen.append(obs.info)
        if self.gated and len(self.seen) > 1:  # `reset` waits for the first answer
            assert self.gate.acquire(timeout=30)
        if self.failure is not None:
            raise self.failure
        value = obs.info["t"]
        column = value + 0.1 * np.arange(self.rows)
        return Act(np.stack([column, column], 1).astype(np.float32), done=value == self.done_at)


def obs(t: int) -> Obs:
    return Obs(state={"joints": np.full(2, t, np.float32)}, info={"t": t})


def play(player: ChunkPlayer, ticks: range) -> list[float]:
    return [round(float(player.act(obs(t)).action[0]), 4) for t in ticks]


@pytest.fixture
def playing() -> Iterator[Callable[..., tuple[Counting, ChunkPlayer]]]:
    made: list[tuple[Counting, ChunkPlayer]] = []

    def make(agent: Counting, **options: Any) -> tuple[Counting, ChunkPlayer]:
        check = options.pop("check", None)
        player = ChunkPlayer(agent, PlayerSettings(**options), check=check)
        player.reset(obs(0), "stack")
        made.append((agent, player))
        return agent, player

    yield make
    for agent, player in made:
        agent.gate.release(100)
        player.close()


def let(agent: Counting, player: ChunkPlayer) -> None:
    """Permit one answer, and wait until the player can use it."""
    agent.gate.release()
    wait_for(lambda: player._caller is not None and not player._caller.busy, every_s=0.001)


Playing = Callable[..., tuple[Counting, ChunkPlayer]]


@pytest.mark.parametrize(
    ("rows", "options", "played", "asked"),
    [
        (3, {}, [0, 0.1, 0.2, 3, 3.1, 3.2, 6], [0, 3, 6]),  # whole chunks
        (3, {"execute": 2}, [0, 0.1, 2, 2.1, 4], [0, 2, 4]),
        # The player waits for an answer until the deadline.
        (1, {"deadline_s": 30.0}, [0, 1, 2, 3], [0, 1, 2, 3]),
        (
            6,
            {"mode": "ensemble", "ensemble_m": 0.0},
            [0, (0.1 + 1) / 2, (0.2 + 1.1 + 2) / 3],
            [0, 1, 2],
        ),
    ],
)
def test_a_chunk_is_executed_as_far_as_the_mode_says(
    playing: Playing, rows: int, options: dict[str, Any], played: list[float], asked: list[int]
) -> None:
    agent, player = playing(Counting(rows=rows), **options)
    assert play(player, range(len(played))) == pytest.approx(played, abs=1e-3)
    assert [info["t"] for info in agent.seen] == asked


def test_async_executes_the_old_chunk_while_the_next_is_made(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True), mode="async")
    # The request was sent at tick 1, and has no answer yet.
    assert play(player, range(3)) == [0, 0.1, 0.2]
    let(agent, player)
    # Rows 2 and 3 of the answer to tick 1, whose first two rows are late.
    assert play(player, range(3, 5)) == [1.2, 1.3]
    wait_for(lambda: len(agent.seen) == 3)
    # Only one request runs at a time; the next one has the newest observation.
    assert [info["t"] for info in agent.seen] == [0, 1, 3]


def test_a_policy_of_single_actions_has_one_for_each_tick(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True, rows=1), mode="async")
    done = []
    for t in range(8):
        act = player.act(obs(t))
        assert "safe" not in act.info
        done.append(round(float(act.action[0]), 4))
        let(agent, player)  # the answer arrives within the tick
    assert done == [0, 0, 1, 2, 3, 4, 5, 6]  # each action is one tick late


def test_a_policy_of_single_actions_that_takes_three_ticks_has_one_for_each_third(
    playing: Playing,
) -> None:
    agent, player = playing(Counting(gated=True, rows=1), mode="async")
    held = []
    for t in range(12):
        if t and t % 3 == 0:
            let(agent, player)
        held.append("safe" in player.act(obs(t)).info)
    assert held == [False, True, True] * 4


def test_async_asks_no_more_often_than_told(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True), mode="async", execute=4)
    assert play(player, range(4)) == [0, 0.1, 0.2, 0.3]
    assert len(agent.seen) == 1
    play(player, range(4, 5))
    wait_for(lambda: len(agent.seen) == 2)
    assert agent.seen[1]["t"] == 4


def test_async_executes_no_row_beyond_the_horizon_or_for_which_others_were_executed(
    playing: Playing,
) -> None:
    _, player = playing(Counting(gated=True), mode="async", horizon=2)
    play(player, range(2))
    assert "safe" in player.act(obs(2)).info
    agent, player = playing(Counting(gated=True), mode="async")
    agent.rows = 2
    play(player, range(HORIZON))
    let(agent, player)  # the answer to tick 1, with rows for ticks 1 and 2
    assert "so late" in player.act(obs(HORIZON)).info["safe"]


def test_without_an_action_in_time_the_safe_one_is_given_and_says_so(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True), mode="async")
    play(player, range(HORIZON))
    begun = time.monotonic()
    act = player.act(obs(HORIZON))
    assert time.monotonic() - begun < 25  # the policy's answer never arrives
    assert act.action.tolist() == pytest.approx([0.5, 0.5])
    assert "waiting" in act.info["safe"]
    assert act.info["silent_s"] > 0
    let(agent, player)
    # The answer to tick 1, of whose rows five were replaced by safe actions.
    late = player.act(obs(HORIZON + 1))
    assert (late.info["row"], late.info["age_ticks"]) == (5, HORIZON)
    assert "safe" not in late.info
    assert "safe" in player.act(obs(HORIZON + 2)).info
    let(agent, player)  # the answer to the tick after
    assert player.act(obs(HORIZON + 3)).action[0] == pytest.approx(HORIZON + 1 + 0.1)


def test_a_deadline_is_kept_in_every_mode(playing: Playing) -> None:
    for mode in ("open_loop", "ensemble", "async"):
        agent, player = playing(Counting(gated=True, rows=1), mode=mode, deadline_s=0.02)
        play(player, range(1))
        begun = time.monotonic()
        assert "safe" in player.act(obs(1)).info
        assert 0.02 <= time.monotonic() - begun < 25
        agent.gate.release(100)


def test_an_action_says_how_old_it_is_and_where_it_is_from(playing: Playing) -> None:
    _, player = playing(Counting(gated=True), mode="async")
    play(player, range(2))
    info = player.act(obs(2)).info
    assert (info["age_ticks"], info["chunk"], info["row"]) == (2, 0, 2)
    assert info["silent_s"] >= 0


def test_every_request_carries_its_time_of_capture_and_its_deadline(playing: Playing) -> None:
    before = time.time()
    agent, player = playing(Counting(gated=True), mode="async", timeout_s=3.0)
    play(player, range(2))
    wait_for(lambda: len(agent.seen) == 2)
    assert before <= agent.seen[0]["captured_at"] <= agent.seen[1]["captured_at"] <= time.time()
    assert agent.seen[1]["deadline_ms"] == 3000.0
    player.act(Obs(info={"t": 2, "captured_at": 5.0}))


def test_the_callers_observation_is_neither_changed_nor_kept(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True), mode="async")
    mine = obs(0)
    player.act(mine)
    asked = obs(1)
    player.act(asked)
    asked.state["joints"][:] = 77
    assert asked.info == {"t": 1}
    wait_for(lambda: len(agent.seen) == 2)


def test_rows_of_an_observation_from_before_the_loop_hung_are_not_executed(
    playing: Playing, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr("vlagents_ray.chunking.player.time.monotonic", clock)
    agent, player = playing(Counting(gated=True), mode="async", max_age_s=0.5)
    assert play(player, range(2)) == [0, 0.1]
    clock.now = 1.0
    assert "older than max_age_s" in player.act(obs(2)).info["safe"]
    let(agent, player)  # the answer to tick 1, which is equally old
    assert "older than max_age_s" in player.act(obs(3)).info["safe"]
    let(agent, player)  # the answer to tick 3, after the player had continued
    assert play(player, range(4, 5)) == [3.0]


def seen_at(t: int, captured_at: float) -> Obs:
    return Obs(info={"t": t, "captured_at": captured_at})


def test_what_was_captured_too_long_ago_is_neither_executed_nor_asked_about(
    playing: Playing,
) -> None:
    agent, player = playing(Counting(), deadline_s=30.0, max_age_s=60.0)
    play(player, range(HORIZON))
    frozen = time.time() - 3600
    for t in range(HORIZON, HORIZON + 3):
        act = player.act(seen_at(t, frozen))
        assert "a camera that hangs" in act.info["safe"]
        assert act.action[0] == pytest.approx(0.5)
    assert len(agent.seen) == 1
    assert play(player, range(9, 10)) == [9]


def test_an_episode_does_not_begin_with_what_was_captured_too_long_ago() -> None:
    agent, frozen = Counting(), seen_at(0, time.time() - 3600)
    with ChunkPlayer(agent, PlayerSettings(mode="async", max_age_s=60.0)) as player:
        player.reset(frozen)
        with pytest.raises(InvalidAction, match="a camera that hangs"):
            player.act(frozen)


def test_a_plan_grows_old_from_when_its_observation_was_captured(playing: Playing) -> None:
    _, player = playing(Counting(), deadline_s=30.0, max_age_s=60.0)
    play(player, range(HORIZON))
    player.act(seen_at(HORIZON, time.time() - 59.9))
    with pytest.MonkeyPatch.context() as patch:
        now = time.monotonic()
        patch.setattr("vlagents_ray.chunking.player.time.monotonic", lambda: now + 1.0)
        patch.setattr("vlagents_ray.chunking.buffer.time.monotonic", lambda: now + 1.0)
        # A new request was sent although five rows were left.
        assert play(player, range(8, 9)) == [8]


def test_after_an_interrupt_nothing_is_executed_that_was_planned_or_asked_before(
    playing: Playing,
) -> None:
    agent, player = playing(Counting(gated=True), mode="async")
    assert play(player, range(3)) == [0, 0.1, 0.2]  # requested at tick 1
    player.interrupt()
    let(agent, player)  # the answer to tick 1
    act = player.act(obs(3))
    assert "was stopped" in act.info["safe"]
    assert act.action[0] == pytest.approx(0.1)  # the row 0.2 was not executed
    let(agent, player)  # the answer to tick 3
    assert play(player, range(4, 6)) == [3, 3.1]


class Pose:
    """The robot's measured position."""

    def __init__(self, at: float) -> None:
        self.at = at

    def __call__(self, _: Obs) -> np.ndarray:
        return np.full(2, self.at)


def test_the_first_action_is_compared_with_the_measured_pose(playing: Playing) -> None:
    pose = Pose(5.0)
    agent, player = playing(
        Counting(gated=True), mode="async", check=Guard(max_step=0.15, measure=pose)
    )
    act = player.act(obs(0))
    assert "expected a step of at most max_step" in act.info["safe"]
    assert act.action.tolist() == [5, 5]  # the robot's position
    pose.at = 1.0
    assert "safe" in player.act(obs(1)).info  # the plan is empty
    let(agent, player)
    assert play(player, range(2, 4)) == [1, 1.1]


def test_after_an_interrupt_the_measured_pose_counts_and_not_what_was_commanded_before(
    playing: Playing,
) -> None:
    pose = Pose(0.0)
    agent, player = playing(
        Counting(gated=True), mode="async", check=Guard(max_step=0.15, measure=pose)
    )
    assert play(player, range(3)) == [0, 0.1, 0.2]
    let(agent, player)
    player.interrupt()
    pose.at = 3.1  # moved by hand
    # The robot holds this position.
    assert player.act(obs(3)).action.tolist() == pytest.approx([3.1, 3.1])
    let(agent, player)
    assert play(player, range(4, 6)) == [3, 3.1]


def test_after_an_interrupt_nothing_leads_back_to_what_was_commanded_before_it(
    playing: Playing,
) -> None:
    pose = Pose(0.0)
    home = np.full(2, -9.0, np.float32)
    guard = Guard(low=0.0, high=1.0, max_step=0.15, measure=pose)
    agent, player = playing(Counting(gated=True), mode="async", check=guard, safe=home)
    assert play(player, range(3)) == [0, 0.1, 0.2]
    player.interrupt()
    pose.at = 0.9
    # The home position is rejected.
    assert player.act(obs(3)).action.tolist() == pytest.approx([0.9, 0.9])
    player.interrupt()
    pose.at = 5.0  # beyond the limits, so that no action is accepted
    with pytest.raises(InvalidAction, match="above the limit 1"):
        player.act(obs(4))
    agent.gate.release(100)


def test_after_safe_actions_one_may_begin_at_the_measured_pose_or_at_the_last_action(
    playing: Playing,
) -> None:
    pose = Pose(0.0)
    agent, player = playing(
        Counting(gated=True), mode="async", check=Guard(max_step=0.15, measure=pose)
    )
    play(player, range(HORIZON))
    pose.at = 9.0
    assert "safe" in player.act(obs(6)).info
    let(agent, player)  # the answer to tick 1, whose last row is 1.5
    assert "safe" in player.act(obs(7)).info
    let(agent, player)  # the answer to tick 7
    assert "safe" in player.act(obs(8)).info  # 7.0 is at neither position
    pose.at = 8.0
    let(agent, player)
    assert play(player, range(9, 11)) == [8, 8.1]


@pytest.mark.parametrize(
    ("failure", "curable"),
    [
        (PolicyFailed("out of memory"), True),
        (PolicyUnavailable("restarting"), True),
        (InvalidObservation("no wrist camera"), False),
        (ZeroDivisionError(), False),
    ],
)
def test_a_policy_in_trouble_gives_safe_actions_until_it_answers_again_unless_that_cures_nothing(
    playing: Playing, failure: Exception, curable: bool
) -> None:
    agent, player = playing(Counting(gated=True, rows=1), mode="async")
    agent.failure = failure
    play(player, range(2))
    let(agent, player)
    if not curable:
        with pytest.raises(type(failure)):
            player.act(obs(2))
        return
    assert str(failure) in player.act(obs(2)).info["safe"]
    agent.failure = None
    agent.rows = 3
    let(agent, player)
    assert "safe" not in player.act(obs(3)).info


def test_a_broken_answer_is_not_executed(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True), mode="async")
    play(player, range(2))
    agent.rows = 0
    let(agent, player)
    act = player.act(obs(2))
    assert act.action[0] == pytest.approx(0.2)  # from the previous chunk
    assert act.info["chunk"] == 0


@pytest.mark.parametrize("safe", ["hold", np.full(2, -9.0, np.float32)])
def test_an_action_that_the_guard_refuses_is_replaced_by_the_safe_one_or_by_the_last(
    playing: Playing, safe: Any
) -> None:
    _, player = playing(
        Counting(rows=3), deadline_s=30.0, check=Guard(low=0.0, high=2.5), safe=safe
    )
    assert play(player, range(3)) == [0, 0.1, 0.2]
    act = player.act(obs(3))
    assert act.action.tolist() == pytest.approx([0.2, 0.2])
    assert "above the limit 2.5" in act.info["safe"]
    assert ("below the limit 0" in act.info["safe"]) is not isinstance(safe, str)


@pytest.mark.parametrize(
    ("guard", "options", "passed"),
    [
        (Guard(high=0.15), {}, 2),  # this mode has no safe action in open loop without a deadline
        (Guard(low=5.0), {"mode": "async"}, 0),  # before the first action there is none to hold
    ],
)
def test_without_a_safe_action_what_the_guard_refuses_is_raised(
    playing: Playing, guard: Guard, options: dict[str, Any], passed: int
) -> None:
    _, player = playing(Counting(rows=3), check=guard, **options)
    play(player, range(passed))
    with pytest.raises(InvalidAction, match="the limit"):
        player.act(obs(passed))


@pytest.mark.parametrize("wrong", [np.full(3, 0.1), np.full((1, 2), 0.1), np.full(2, np.nan)])
def test_a_safe_action_that_no_robot_could_take_is_replaced_without_a_guard(
    playing: Playing, wrong: Any
) -> None:
    _, player = playing(Counting(gated=True, rows=1), mode="async", safe=lambda _: wrong)
    assert play(player, range(1)) == [0]
    assert player.act(obs(1)).action.tolist() == [0, 0]


def test_where_holding_would_go_on_moving_a_refused_safe_action_is_raised() -> None:
    class Deltas(Counting):
        contract = Contract(action=ActionSpec(dim=2, delta=True))

    agent = Deltas(gated=True, rows=1)
    with ChunkPlayer(agent, PlayerSettings(mode="async"), check=Guard(low=0.5)) as player:
        player.reset(obs(1))
        assert player.act(obs(1)).action.tolist() == [1, 1]
        with pytest.raises(
            InvalidAction,
            match=r"waiting.*the guard also rejects the safe action.*below the limit 0\.5",
        ):
            player.act(obs(2))
        agent.gate.release(100)


@pytest.mark.parametrize("delta", [None, False])
def test_a_safe_action_that_does_not_fit_is_refused_before_the_robot_moves(
    delta: bool | None,
) -> None:
    agent = Counting()
    agent.contract = Contract(action=ActionSpec(dim=2, delta=delta))
    with ChunkPlayer(agent, PlayerSettings(mode="async", safe="zero")) as player:
        with pytest.raises(ConfigError, match="safe"):
            player.initialize()
        with pytest.raises(ConfigError, match="safe"):
            player.reset(obs(0))


def test_a_reset_forgets_what_was_planned_and_what_is_under_way(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True), mode="async")
    play(player, range(3))
    agent.gate.release(2)  # the request of tick 1 and the one of the reset
    player.reset(obs(50), "unstack")
    act = player.act(obs(50))
    assert act.action[0] == 50
    assert act.info["chunk"] == 0


def test_done_is_said_with_the_last_row_of_the_chunk_that_says_so(playing: Playing) -> None:
    agent, player = playing(Counting(rows=3, done_at=3))
    assert [player.act(obs(t)).done for t in range(6)] == [False] * 5 + [True]
    assert len(agent.seen) == 2


@pytest.mark.parametrize(
    "options", [{}, {"execute": 2}, {"horizon": 2}, {"execute": 1, "horizon": 3}], ids=str
)
@pytest.mark.parametrize(
    "mode",
    [
        {},
        {"deadline_s": 30.0},
        {"mode": "ensemble"},
        {"mode": "async"},
        {"mode": "async", "real_time_chunking": True},
    ],
    ids=str,
)
def test_a_chunk_with_done_is_executed_whole_in_every_mode(
    playing: Playing, options: dict[str, Any], mode: dict[str, Any]
) -> None:
    agent, player = playing(Counting(rows=5, done_at=0), **options, **mode)
    acts = [player.act(obs(t)) for t in range(5)]
    assert [act.done for act in acts] == [False] * 4 + [True]
    assert [float(act.action[0]) for act in acts] == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    assert len(agent.seen) == 1


@pytest.mark.parametrize(
    "options",
    [
        {"mode": "fast"},
        {"execute": 0},
        {"horizon": 0},
        {"max_age_s": 0},
        {"merge": "average"},
        {"real_time_chunking": True},
    ],
)
def test_options_that_mean_nothing_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        ChunkPlayer(Counting(), PlayerSettings(**options))
    with pytest.raises(NotReset):
        ChunkPlayer(Counting()).act(obs(0))


@pytest.mark.parametrize("mode", ["open_loop", "ensemble"])
def test_a_player_keeps_the_promises_of_an_agent(mode: Any) -> None:
    class Chunks(Agent):
        def act(self, obs: Obs) -> Act:
            return Act(np.tile(obs.state["joints"], (3, 1)).astype(np.float32))

    check_agent(ChunkPlayer(Chunks(), PlayerSettings(mode=mode)), steps=5)


def test_a_reply_that_was_lost_replays_nothing() -> None:
    served = Replicas([Counting(rows=4)])
    player = ChunkPlayer(served.agent(), PlayerSettings(mode="async", execute=2))
    player.reset(obs(0))
    done, resumed = [], False
    for t in range(30):
        served.lose_reply |= t == 10
        act = player.act(obs(t))
        assert player._caller is not None
        wait_for(lambda: not player._caller.busy, every_s=0.001)
        resumed |= "resumed" in act.info
        done.append((t, round(float(act.action[0]), 4), act.info["age_ticks"]))
    player.close()
    served.close()
    assert resumed
    # Each value belongs to its own tick.
    assert all(value == pytest.approx(t - age + 0.1 * age) for t, value, age in done)


class Continuing(Agent):
    """A policy with simplified real-time chunking: new chunks begin with the frozen rows and
    continue by 0.1 per row.
    """

    contract = Contract(action=ActionSpec(dim=1, delta=False))

    def act(self, obs: Obs) -> Act:
        left, delay = obs.info.get(LEFTOVER), obs.info.get(DELAY, 0)
        frozen = left[: delay + 1] if left is not None else np.zeros((1, 1), np.float32)
        more = frozen[-1] + 0.1 * np.arange(1, 60 - len(frozen) + 1)[:, np.newaxis]
        return Act(np.concatenate([frozen, more]).astype(np.float32))


@pytest.mark.parametrize("real_time", [True, False])
def test_real_time_chunking_over_the_wire_joins_chunks_without_a_jump(real_time: bool) -> None:
    served = Replicas([Continuing()])
    player = ChunkPlayer(served.agent(), PlayerSettings(mode="async", real_time_chunking=real_time))
    player.reset(Obs())
    actions, chunks = [], set()
    caller = player._caller
    assert caller is not None
    for tick in range(60):
        if tick % 10 == 9:  # give the policy time to answer, however busy the machine is
            wait_for(lambda: not caller.busy, every_s=0.001)
        act = player.act(Obs())
        assert "safe" not in act.info
        actions.append(float(act.action[0]))
        chunks.add(act.info["chunk"])
    player.close()
    served.close()
    assert len(chunks) > 3
    jumps = np.abs(np.diff(actions) - 0.1)
    assert (jumps.max() < 1e-4) == real_time


class Given(Counting):
    """A policy that was trained with prefixes: its chunks begin with at most two rows of the plan,
    and continue faster each time.
    """

    def act(self, obs: Obs) -> Act:
        plain, left = super().act(obs), obs.info.get(LEFTOVER)
        if left is None:
            return plain
        given = min(obs.info[DELAY] or 2, 2)
        more = (
            left[given - 1]
            + 0.1 * len(self.seen) * np.arange(1, self.rows - given + 1)[:, np.newaxis]
        )
        return Act(np.concatenate([left[:given], more]).astype(np.float32), info={GIVEN: given})


def test_an_answer_later_than_the_rows_it_was_given_is_dropped_and_the_plan_goes_on(
    playing: Playing,
) -> None:
    agent, player = playing(Given(gated=True, rows=10), mode="async", real_time_chunking=True)
    actions, chunks = [], []
    for t, ticks in ((0, 2), (2, 4), (6, 1), (7, 1)):  # number of ticks until each answer arrives
        for tick in range(t, t + ticks):
            act = player.act(obs(tick))
            actions.append(round(float(act.action[0]), 4))
            chunks.append(act.info["chunk"])
            assert "safe" not in act.info
        let(agent, player)
    assert chunks == [0, 0, 1, 1, 1, 1, 1, 3], (
        "the third answer arrived after four rows, but its chunk begins with only one of them"
    )
    assert actions == pytest.approx([0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0, 1.4])


def test_a_player_is_driven_again_while_its_last_request_is_under_way(playing: Playing) -> None:
    class Connected(Counting):
        busy = False
        overlapped = False

        def initialize(self) -> None:
            self.overlapped |= self.busy

        def act(self, obs: Obs) -> Act:
            self.busy = True
            try:
                return super().act(obs)
            finally:
                self.busy = False

    agent, player = playing(Connected(gated=True), mode="async")
    play(player, range(2))
    wait_for(lambda: len(agent.seen) == 2)
    opener = threading.Timer(0.2, agent.gate.release)
    opener.start()
    player.initialize()  # like the next run of a loop
    opener.join()
    assert isinstance(agent, Connected)
    assert not agent.overlapped


def test_the_delay_of_a_cold_start_counts_only_until_the_next_answer(playing: Playing) -> None:
    agent, player = playing(Counting(gated=True, rows=40), mode="async", real_time_chunking=True)
    for t, ticks in ((0, 9), (9, 2), (11, 2), (13, 2)):
        play(player, range(t, t + ticks))
        let(agent, player)
    play(player, range(15, 16))
    wait_for(lambda: len(agent.seen) == 6)
    assert [info.get(DELAY) for info in agent.seen[1:]] == [0, 8, 2, 2, 2]
    let(agent, player)
    agent.gate.release()
    player.reset(obs(20))  # the policy is warm in the next episode
    play(player, range(20, 22))
    wait_for(lambda: len(agent.seen) == 8)
    assert agent.seen[-1][DELAY] == 2
