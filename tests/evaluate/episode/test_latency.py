"""Real-time mode: the actions that are executed while the policy computes."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from eval_fakes import Line, ToZero
from hypothesis import given
from hypothesis import strategies as st
from in_process_episode import run_episode
from pydantic import ValidationError

from vlagents_ray.chunking.buffer import ChunkBuffer
from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate.episode.latency import ChunkExecutor
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import DELAY, GIVEN, LEFTOVER, Act, Agent, Obs

RELATIVE = Contract(action=ActionSpec(dim=2, delta=True, gripper_open=1.0), control_hz=10.0)
ABSOLUTE = Contract(action=ActionSpec(dim=2, delta=False), control_hz=10.0)
LIMITED = Contract(action=replace(RELATIVE.action, low=-1.0, high=5.0), control_hz=10.0)
# rows 1 to 6, with the gripper closed
CHUNK = np.array([[i, -1.0] for i in range(1, 7)], np.float32)


def played(player: ChunkExecutor, latency_s: float, rows: np.ndarray = CHUNK) -> list[float]:
    """Return the first component of each action that is executed because of an answer."""
    return [float(tick.action[0]) for tick in player.ticks(rows, latency_s)]


def clock(**settings: Any) -> ClockConfig:
    return ClockConfig(**{"latency": 0.2, "mode": "async"} | settings)


@pytest.mark.parametrize(
    ("execute", "settings", "env", "answers"),
    [
        # The first rows are dropped if the remaining rows of the last chunk were executed in their
        # place. The next rows lead back to the path of the chunk, 1 + 2 + 3 + 4, no faster than the
        # fastest row, or within the limits. A row beyond the limits, 6, is executed as 5.
        (4, {}, RELATIVE, [(0.0, [1, 2, 3, 4]), (0.1, [5, -2, 3, 4]), (0.2, [5, 6, -5, 4])]),
        (4, {}, LIMITED, [(0.0, [1, 2, 3, 4]), (0.1, [5, -1, 2, 4]), (0.2, [5, 6, -1, 1])]),
        # Targets need no way back.
        (4, {"neutral": [9, 9]}, ABSOLUTE, [(0.0, [1, 2, 3, 4]), (0.1, [5, 2, 3, 4])]),
        # The remaining rows are executed while the policy computes. When they end, relative actions
        # stop.
        (
            4,
            {},
            RELATIVE,
            [(0.2, [0, 0, 1, 2, 3, 4]), (0.2, [5, 6, -5, 4]), (0.3, [5, 6, 0, -5, 4])],
        ),
        # Absolute actions hold the last one.
        (4, {"neutral": [9, 9]}, ABSOLUTE, [(0.2, [9, 9, 1, 2, 3, 4]), (0.3, [5, 6, 6, 3, 4])]),
        # If the next request is due when an answer comes, its rows are executed after the request.
        (
            2,
            {"neutral": [9, 9]},
            ABSOLUTE,
            [(0.3, [9, 9, 9]), (0.3, [1, 2, 3]), (0.3, [4, 5, 6]), (0.0, [1, 2])],
        ),
        # By default, a request is due at each tick.
        (None, {"neutral": [9, 9]}, ABSOLUTE, [(0.1, [9]), (0.1, [1]), (0.1, [2]), (0.0, [1])]),
        # A robot that stops and waits executes all rows, or as many as it is told.
        (None, {"mode": "open_loop"}, RELATIVE, [(0.2, [0, 0, 1, 2, 3, 4, 5, 6])] * 2),
        (2, {"mode": "open_loop"}, RELATIVE, [(0.2, [0, 0, 1, 2]), (0.3, [0, 0, 0, 1, 2])]),
    ],
)
def test_what_is_executed_until_an_answer_comes_and_of_it(
    execute: int | None,
    settings: dict[str, Any],
    env: Contract,
    answers: list[tuple[float, list[int]]],
) -> None:
    player = ChunkExecutor(execute, clock(**settings), env)
    assert [played(player, latency_s) for latency_s, _ in answers] == [
        executed for _, executed in answers
    ]


@pytest.mark.parametrize("mode", ["open_loop", "async"])
@pytest.mark.parametrize("env", [RELATIVE, ABSOLUTE], ids=["relative", "absolute"])
def test_no_row_is_dropped_for_ticks_at_which_the_robot_held(mode: str, env: Contract) -> None:
    player = ChunkExecutor(6, clock(mode=mode, neutral=[0, 0]), env)
    executed = [played(player, latency_s) for latency_s in (0.2, 30.0, 0.0)]
    assert executed[0][-6:] == [1, 2, 3, 4, 5, 6]
    assert [*executed[1], *executed[2]][300:306] == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("mode", ["open_loop", "async"])
def test_a_robot_that_stands_keeps_its_grippers(mode: str) -> None:
    player = ChunkExecutor(6, clock(mode=mode), RELATIVE)
    list(player.ticks(CHUNK, 0.0))
    held = next(player.ticks(CHUNK, 0.1))
    assert (held.action.tolist(), held.waited, held.starved) == ([0, -1], True, True)


@pytest.mark.parametrize("settings", [{}, {"mode": "open_loop"}], ids=str)
@pytest.mark.parametrize("env", [RELATIVE, ABSOLUTE], ids=["relative", "absolute"])
def test_a_further_task_begins_with_the_last_targets_and_without_motion(
    env: Contract, settings: dict[str, Any]
) -> None:
    last = np.array([0.5, -1.0], np.float32)
    still = [0.0, -1.0] if env is RELATIVE else [0.5, -1.0]
    player = ChunkExecutor(4, clock(**settings), env, last)
    waiting = [tick.action.tolist() for tick in player.ticks(CHUNK, 0.3) if tick.waited]
    assert waiting == [still] * 3


@given(
    st.lists(
        st.tuples(st.integers(1, 6), st.integers(0, 9), st.integers(0, 9), st.booleans()),
        min_size=1,
        max_size=8,
    )
)
def test_an_answer_ends_the_episode_only_with_its_last_row(
    answers: list[tuple[int, int, int, bool]],
) -> None:
    """An answer that is too late for real-time chunking is dropped, as a chunk player drops it."""
    player = ChunkExecutor(2, clock(neutral=[0, 0]), ABSOLUTE)
    plan = ChunkBuffer()
    for count, late, continued, done in answers:
        rows = CHUNK[:count] + 0.5
        executed = player._plan.executed
        ticks = list(player.ticks(rows, late / 10, {GIVEN: continued}, done=done))
        plan.executed = player._plan.executed
        is_dropped = plan.outruns(executed, {GIVEN: continued}) and len(ticks) == late
        is_last_row = bool(ticks) and ticks[-1].action.tolist() == rows[-1].tolist()
        assert any(tick.done for tick in ticks) == (done and not is_dropped)
        if done and not is_dropped:
            assert is_last_row
            assert not any(tick.done for tick in ticks[:-1])
            return


def test_a_single_action_is_executed_however_late_it_comes() -> None:
    player = ChunkExecutor(None, clock(mode="open_loop"), RELATIVE)
    for latency_s in (0.2, 0.0, 0.9):
        assert played(player, latency_s, CHUNK[:1]) == [0] * round(10 * latency_s) + [1]
    late = ChunkExecutor(None, clock(neutral=[9, 9]), ABSOLUTE)
    assert [played(late, latency_s, CHUNK[:1]) for latency_s in (0.2, 0.2)] == [[9, 9], [1, 1]]


def test_an_answer_later_than_all_its_rows_is_good_for_its_last_one() -> None:
    player = ChunkExecutor(2, clock(), RELATIVE)
    played(player, 0.0)
    # The row stands for the pose 1 + 2 + 3, which is 6 behind the robot.
    assert played(player, 0.3, CHUNK[:3]) == [3, 4, 5]
    assert played(player, 0.1)[0] == -6


def test_a_started_tick_is_over_and_rounding_starts_none() -> None:
    for mode, further in (("open_loop", 1), ("async", 0)):
        for latency_s, ticks in ((1.1, 11), (1.1001, 12)):
            player = ChunkExecutor(None, clock(mode=mode), RELATIVE)
            assert len(played(player, latency_s, CHUNK[:1])) == ticks + further


@given(st.lists(st.integers(0, 5), min_size=1, max_size=5), st.integers(1, 12))
def test_answers_have_the_latencies_of_a_list_in_turn(delays: list[int], answers: int) -> None:
    latencies_s = [delay / 10 for delay in delays]
    varying = ChunkExecutor(4, clock(latency=latencies_s), RELATIVE)
    constant = ChunkExecutor(4, clock(), RELATIVE)
    for number in range(answers):
        latency_s = varying.latency_s(9.0)
        assert latency_s == latencies_s[number % len(latencies_s)]
        assert played(varying, latency_s) == played(constant, latency_s)


def test_what_a_clock_lacks_is_named() -> None:
    with pytest.raises(ConfigError, match=r"give clock\.neutral"):
        ChunkExecutor(None, clock(), ABSOLUTE)
    with pytest.raises(ConfigError, match=r"give clock\.neutral"):
        ChunkExecutor(None, clock(latency=[0.0, 0.1]), ABSOLUTE)
    for latency in (0, [0.0, 0.0]):
        ChunkExecutor(None, clock(latency=latency), ABSOLUTE)
    sizeless = Contract(action=replace(ABSOLUTE.action, dim=None), control_hz=10.0)
    with pytest.raises(
        ConfigError, match="expected 2 numbers, as the policy's actions have, got 3"
    ):
        played(ChunkExecutor(None, clock(neutral=[0, 0, 0]), sizeless), 0.1)
    for execute in (6, 7):
        with pytest.raises(ConfigError, match="all of which are executed before the next request"):
            played(ChunkExecutor(execute, clock(real_time_chunking=True), RELATIVE), 0.1)
    bare = Contract(action=RELATIVE.action)
    with pytest.raises(ConfigError, match=r"declare the rate of its steps, in 1/s"):
        ChunkExecutor(None, clock(), bare)


# For each key of the clock, a value that the contract contradicts and the reason, or the reason why
# no value can contradict it.
AGAINST_THE_CONTRACT: dict[str, tuple[dict[str, Any], Contract, str] | str] = {
    "latency": "a time of the policy; the environment's rate converts it to ticks",
    "mode": ({"mode": "open_loop"}, ABSOLUTE, "zeros might command a motion"),
    "real_time_chunking": "a choice of the policy",
    "fresh_grip": "a choice of the policy; without known grippers it has no effect",
    "neutral": ({"neutral": [0, 0, 0]}, ABSOLUTE, "2 numbers, as the environment's actions have"),
}


def test_no_key_of_a_clock_contradicts_the_contract() -> None:
    assert AGAINST_THE_CONTRACT.keys() == ClockConfig.model_fields.keys(), (
        "the rate is the environment's, and every other key is in this table"
    )
    refusals = [case for case in AGAINST_THE_CONTRACT.values() if not isinstance(case, str)]
    for settings, contract, reason in refusals:
        with pytest.raises(ConfigError, match=reason):
            ChunkExecutor(None, clock(**settings), contract)
    bounded = replace(ABSOLUTE, action=replace(ABSOLUTE.action, low=-1.0, high=1.0))
    for neutral in ([0, 1.5], [-1.01, 0]):
        with pytest.raises(ConfigError, match=r"clock\.neutral: expected numbers of at "):
            ChunkExecutor(None, clock(neutral=neutral), bounded)
    ChunkExecutor(None, clock(neutral=[-1, 1]), bounded)


@pytest.mark.parametrize(
    "wrong",
    [
        {"latency": -1},
        {"latency": float("inf")},
        {"latency": "guessed"},
        {"latency": []},
        {"latency": [0.1, -1]},
        {"latency": [0.1, "measured"]},
        {"mode": "dance"},
        {"mode": "ensemble"},
        {"real_time_chunking": True},
        {"mode": "open_loop", "real_time_chunking": True},
        {"hz": 10.0},
    ],
)
def test_a_clock_that_cannot_be_is_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        ClockConfig(**wrong)


def test_a_policy_that_chunks_in_real_time_is_told_what_is_left_and_for_how_long() -> None:
    class Listening(ToZero):
        def __init__(self) -> None:
            super().__init__(chunk=8)
            self.told: list[tuple[Any, Any]] = []

        def act(self, obs: Obs) -> Act:
            self.told.append((np.shape(obs.info.get(LEFTOVER)), obs.info.get(DELAY)))
            return super().act(obs)

    def told(**settings: Any) -> list[tuple[Any, Any]]:
        agent = Listening()
        timing = clock(neutral=[0], **settings)
        run_episode(Line(), agent, EpisodeKey("line", 0, 1, "0"), execute=5, clock=timing)
        return agent.told

    assert told(real_time_chunking=True) == [((), None), ((3, 1), 2)]
    assert told() == [((), None)] * 2


def test_an_answer_later_than_the_rows_it_was_given_is_dropped() -> None:
    player = ChunkExecutor(2, clock(real_time_chunking=True, neutral=[0, 0]), ABSOLUTE)
    assert played(player, 0.0) == [1, 2]
    late = [float(tick.action[0]) for tick in player.ticks(10 + CHUNK, 0.3, {GIVEN: 2})]
    assert late == [3, 4, 5]
    assert player.request_info()[LEFTOVER].shape == (1, 2), "the plan continues"
    in_time = [float(tick.action[0]) for tick in player.ticks(10 + CHUNK, 0.1, {GIVEN: 2})]
    assert in_time == [6, 12]


def episode(seed: int, timing: ClockConfig | None, execute: int | None = None) -> EpisodeResult:
    return run_episode(
        Line(), ToZero(chunk=6), EpisodeKey("line", 0, seed, "0"), clock=timing, execute=execute
    )


def outcome(result: EpisodeResult) -> dict[str, Any]:
    ticks_in_time = dict.fromkeys(TimeShare._fields)
    return result.outcome | {"latency_ms": 0} | ticks_in_time


@pytest.mark.parametrize("execute", [None, 1, 3])
@pytest.mark.parametrize("mode", ["open_loop", "async"])
def test_without_latency_it_is_the_synchronous_episode(mode: Any, execute: int | None) -> None:
    timing = ClockConfig(latency=0, mode=mode, neutral=[0])
    in_real_time = episode(3, timing, execute)
    synchronous = episode(3, None, 1 if mode == "async" and execute is None else execute)
    assert outcome(in_real_time) == outcome(synchronous)
    assert synchronous.time_share is None
    assert (in_real_time.ticks, in_real_time.starved) == (in_real_time.steps, 0)


def test_latency_lowers_success_and_repeats_exactly() -> None:
    timing = ClockConfig(latency=0.5, mode="open_loop", neutral=[0])
    synchronous, late, again = (
        [episode(seed, clock, 1) for seed in range(40)] for clock in (None, timing, timing)
    )
    assert sum(bool(one.success_once) for one in synchronous) > 2 * sum(
        bool(one.success_once) for one in late
    )
    assert all(
        one.latency_ms == pytest.approx(500) and one.ticks_waited >= 5 * (one.acts - 1)
        for one in late
    )
    assert [outcome(one) for one in again] == [outcome(one) for one in late]


class Endless(Line):
    """An environment that no action solves, and that counts its steps."""

    max_steps = 60
    steps = 0

    def reset(self, **arguments: Any) -> tuple[Obs, dict[str, Any]]:
        self.steps = 0
        return super().reset(**arguments)

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        obs, reward, _, _, _ = super().step(act)
        return obs, reward, False, self.steps == self.max_steps, {"success": False}


class Numbering(Agent):
    """A policy whose rows contain the step of their observation and their number in the chunk."""

    contract = Contract(action=ActionSpec(dim=1, delta=True))

    def __init__(self, env: Endless, rows: int) -> None:
        self._env, self._rows = env, rows

    def act(self, obs: Obs) -> Act:
        numbers = 1000.0 * (1 + self._env.steps) + np.arange(self._rows)
        return Act(numbers.astype(np.float32)[:, np.newaxis])


def observed(
    rows: int, execute: int | None, timing: ClockConfig
) -> tuple[EpisodeResult, list[float]]:
    """Run an episode. Return it with the ages in ms of the actions that an observer of the robot
    sees. An action that is not a row, or that repeats the row of the previous tick, has no age.
    """
    env = Endless()
    executed: list[float] = []
    result = run_episode(
        env,
        Numbering(env, rows),
        EpisodeKey("line", 0, 1, "0"),
        execute=execute,
        clock=timing,
        executed=lambda action, _reward, _success: executed.append(float(action[0])),
    )
    ages_ms = []
    for step, action in enumerate(executed):
        if action and (step == 0 or action != executed[step - 1]):
            ages_ms.append(1e3 * (step - (int(action) // 1000 - 1)) / 10.0)
    return result, ages_ms


@given(
    latency=st.floats(0, 2),
    rows=st.integers(1, 12),
    execute=st.none() | st.integers(1, 12),
    mode=st.sampled_from(["open_loop", "async"]),
)
def test_ticks_in_time_are_those_that_an_observer_of_the_robot_sees(
    latency: float, rows: int, execute: int | None, mode: Any
) -> None:
    timing = ClockConfig(latency=latency, mode=mode, neutral=[0])
    result, ages_ms = observed(rows, execute, timing)
    in_time = result.time_share
    assert in_time is not None
    assert in_time.ticks == Endless.max_steps
    assert in_time == TimeShare.from_ages(60, 60 - len(ages_ms), ages_ms)


def test_ticks_in_time_of_known_episodes() -> None:
    # The first 2 ticks have no row. The next 4 rows are 200 to 500 ms old; while the policy
    # computes, the 2 remaining rows are 600 and 700 ms old. After that, each chunk gives 4 rows of
    # 200 to 500 ms, the last two of them while the policy computes.
    timing = ClockConfig(latency=0.2, mode="async", neutral=[0])
    result, _ = observed(6, 4, timing)
    assert result.time_share == TimeShare(60, 2, 400.0, 500.0, 700.0)

    # Every second tick waits for an answer.
    result, _ = observed(1, None, ClockConfig(latency=0.1, mode="open_loop", neutral=[0]))
    assert result.time_share == TimeShare(60, 30, 100.0, 100.0, 100.0)
    assert result.time_share.share == 0.5

    # The first answer arrives after the end.
    result, _ = observed(4, None, ClockConfig(latency=9.0, neutral=[0]))
    assert result.time_share == TimeShare(60, 60, None, None, None)


def test_measured_latency_is_what_the_policy_took() -> None:
    class Slow(ToZero):
        def act(self, obs: Obs) -> Act:
            time.sleep(0.11)  # the measured delay, more than one tick
            return super().act(obs)

    timing = ClockConfig(neutral=[0])
    result = run_episode(Line(), Slow(chunk=8), EpisodeKey("line", 0, 1, "0"), clock=timing)
    assert result.latency_ms is not None
    assert result.latency_ms >= 110
    assert result.ticks_waited >= 2


@given(
    latency=st.floats(0, 5),
    rows=st.integers(1, 5),
    execute=st.none() | st.integers(1, 6),
    mode=st.sampled_from(["open_loop", "async"]),
)
def test_an_episode_never_has_more_steps_than_its_env_allows(
    latency: float, rows: int, execute: int | None, mode: Any
) -> None:
    timing = ClockConfig(latency=latency, mode=mode, neutral=[0])
    result = run_episode(
        Line(), ToZero(chunk=rows), EpisodeKey("line", 0, 1, "0"), execute=execute, clock=timing
    )
    assert result.steps <= Line.max_steps
    assert result.time_share is not None
    assert result.starved <= result.ticks_waited <= result.steps == result.ticks
    assert not rows > 1 or latency > 0 or result.ticks_waited == 0
