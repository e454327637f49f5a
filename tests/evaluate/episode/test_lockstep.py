"""Episodes that run together have the same results as episodes that run alone."""

from __future__ import annotations

import copy
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from eval_fakes import Line, ToZero
from in_process_episode import run_episode
from in_process_replicas import Replicas

from vlagents_ray.envs.base import BatchEnv, SequentialBatch, make_batch
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import ConfigError, ConnectionLost, EnvFailed, VLAgentsError
from vlagents_ray.evaluate.episode.episode import Images, run_episodes
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import ClockConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.interface import Act, Agent, Obs
from vlagents_ray.policies.random import Random
from vlagents_ray.policies.scripted import Scripted

SIZE = {"width": 32, "height": 32}
TIMES: dict[str, Any] = {
    "timing_ms": {},
    "seconds": 0.0,
    "reset_ms": None,
    "env_step_ms": None,
    "policy_ms": None,
    "policy_p95_ms": None,
    "env_seconds": None,
    "policy_seconds": None,
}


def keys(env: str, count: int) -> list[EpisodeKey]:
    return [EpisodeKey(env, i, 100 + 7 * i, "0") for i in range(count)]


def untimed(results: Sequence[EpisodeResult | VLAgentsError]) -> list[EpisodeResult]:
    timeless = []
    for result in results:
        assert isinstance(result, EpisodeResult), result
        assert result.seconds > 0
        timeless.append(replace(result, **TIMES))
    return timeless


def together(
    env: BatchEnv,
    agent: Agent,
    wanted: Sequence[EpisodeKey],
    *,
    images: Images = "all",
    **settings: Any,
) -> Any:
    sessions = [copy.deepcopy(agent) for _ in wanted]
    return run_episodes(env, agent, sessions, wanted, **settings, images=images)


@pytest.mark.parametrize("execute", [None, 2])
@pytest.mark.parametrize(
    "agent", [Scripted(), Random(), ToZero(chunk=3)], ids=lambda agent: type(agent).__name__
)
def test_results_are_those_of_episodes_played_alone(agent: Agent, execute: int | None) -> None:
    on_line = isinstance(agent, ToZero)
    wanted = keys("line" if on_line else "tabletop", 4)
    alone: Any = Line() if on_line else Tabletop(**SIZE, max_steps=50)
    others = [Line() if on_line else Tabletop(**SIZE, max_steps=50) for _ in wanted]
    agent.initialize()
    expected = [run_episode(alone, copy.deepcopy(agent), key, execute=execute) for key in wanted]
    # The episodes end at different times.
    assert len({result.steps for result in expected}) > (isinstance(agent, Scripted))
    with SequentialBatch(others) as env:
        assert untimed(together(env, agent, wanted, execute=execute)) == untimed(expected)


@pytest.fixture
def served() -> Iterator[Replicas]:
    replicas = Replicas([Scripted()])
    yield replicas
    replicas.close()


def test_a_remote_policy_is_asked_once_a_step_for_all_sessions(served: Replicas) -> None:
    wanted = keys("tabletop", 3)
    with make_batch("tabletop", 3, **SIZE, max_steps=50) as env, served.agent() as agent:
        sessions = agent.sessions(3)
        results = untimed(run_episodes(env, agent, sessions, wanted))
        for session in sessions:
            session.close()
    with Tabletop(**SIZE, max_steps=50) as alone:
        local = untimed([run_episode(alone, Scripted(), key) for key in wanted])
    assert [result.outcome for result in results] == [result.outcome for result in local]
    assert served.frames[:2] == [3, 3]  # the resets, and the first acts
    acts = [result.acts for result in results]
    assert sum(served.frames[1 : 1 + max(acts)]) == sum(acts)


class Odd(ToZero):
    """A policy that fails in a given way for one of the seeds."""

    def __init__(self, seed: int, error: Exception | None = None) -> None:
        super().__init__()
        self._odd, self._error = seed, error

    def act(self, obs: Obs) -> Act:
        if self._seed != self._odd:
            return super().act(obs)
        if self._error is not None:
            raise self._error
        return Act(np.full(1, np.nan, np.float32))


@pytest.mark.parametrize("error", [None, RuntimeError("out of memory")])
def test_a_policy_error_ends_its_own_episode_alone(error: Exception | None) -> None:
    wanted = keys("line", 3)
    agent = Odd(wanted[1].seed, error)
    expected = [run_episode(Line(), copy.deepcopy(agent), key) for key in wanted]
    with SequentialBatch([Line() for _ in wanted]) as env:
        results = untimed(together(env, agent, wanted))
    assert results == untimed(expected)
    assert [result.status for result in results] == ["done", "policy_error", "done"]


def test_a_lost_session_stands_in_place_of_its_result_alone() -> None:
    wanted = keys("line", 3)
    with SequentialBatch([Line() for _ in wanted]) as env:
        results = together(env, Odd(wanted[0].seed, ConnectionLost("gone")), wanted)
    assert isinstance(results[0], ConnectionLost)
    assert untimed(results[1:]) == untimed(
        [run_episode(Line(), ToZero(), key) for key in wanted[1:]]
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda *_: 1 / 0, "ZeroDivisionError"),
        # fails while the observations are combined
        (lambda _obs, *rest: (None, *rest), "env step: "),
        (lambda obs, *rest: (replace(obs, state={}), *rest), "state 'position' is missing"),
        (
            lambda *answer: (*answer[:4], {"success": "yes"}),
            r"expected info\['success'\] to be a bool, got 'yes'",
        ),
    ],
)
def test_what_one_env_does_wrong_is_no_failure_of_the_policy(change: Any, said: str) -> None:
    class Wrong(Line):
        def step(self, act: Act) -> Any:
            return change(*super().step(act))

    with SequentialBatch([Line(), Wrong()]) as env:
        right, wrong = together(env, ToZero(), keys("line", 2))
    assert isinstance(right, EpisodeResult)
    assert right.status == "done"
    assert isinstance(wrong, EnvFailed)
    assert re.search(said, str(wrong))


def test_initial_states_go_by_the_episodes_number_and_the_user_before_them() -> None:
    class Fixed(Line):
        init_states = 2
        begun: list[Any]

        def reset(self, *, seed: int, options: Any = None) -> Any:
            self.begun = [seed, options]
            return super().reset(seed=seed)

    envs = [Fixed() for _ in range(3)]
    together(SequentialBatch(envs), ToZero(), keys("line", 3))
    assert [env.begun for env in envs] == [
        [100, {"init_state": 0}],
        [107, {"init_state": 1}],
        [114, {"init_state": 0}],
    ]
    together(SequentialBatch(envs), ToZero(), keys("line", 3), reset_options={"init_state": 1})
    assert all(env.begun[1] == {"init_state": 1} for env in envs)


def test_each_episode_needs_a_session_and_an_environment() -> None:
    with SequentialBatch([Line()]) as env:
        for sessions, count in ((2, 2), (1, 2), (0, 0)):
            with pytest.raises(ConfigError, match="one session for each episode"):
                run_episodes(env, ToZero(), [ToZero()] * sessions, keys("line", count))


def test_each_episode_has_a_clock_of_its_own() -> None:
    wanted = keys("line", 4)
    clock = ClockConfig(latency=0.2, mode="async", neutral=[0.0], real_time_chunking=True)
    expected = [run_episode(Line(), ToZero(chunk=3), key, execute=2, clock=clock) for key in wanted]
    with SequentialBatch([Line() for _ in wanted]) as env:
        results = together(env, ToZero(chunk=3), wanted, execute=2, clock=clock)
    assert untimed(results) == untimed(expected)
    assert all(result.ticks_waited > 0 for result in results)


def test_a_missing_image_is_never_anothers() -> None:
    class Blind(Line):
        def step(self, act: Act) -> Any:
            obs, *rest = super().step(act)
            return replace(obs, cameras={}), *rest

    with (
        SequentialBatch([Line(camera=(4, 4)), Blind(camera=(4, 4))]) as env,
        pytest.raises(EnvFailed, match="front"),
    ):
        together(env, ToZero(), keys("line", 2))


@pytest.mark.parametrize("answers", [[], [None, None, None]])
def test_a_policy_that_does_not_answer_for_each_session_fails(answers: list[Any]) -> None:
    class Short(ToZero):
        def act_batch(self, obs: Sequence[Obs], sessions: Sequence[Agent]) -> Any:
            return answers

    with SequentialBatch([Line() for _ in range(2)]) as env:
        results = together(env, Short(), keys("line", 2))
    assert [result.status for result in results] == ["policy_error"] * 2
    assert all(
        f"expected 2 actions, one for each observation, got {len(answers)}" in result.error
        for result in results
    )


def test_an_answer_that_is_no_act_is_the_policys_failure() -> None:
    class Mute(ToZero):
        def act(self, obs: Obs) -> Any:
            return None

    assert run_episode(Line(), Mute(), keys("line", 1)[0]).status == "policy_error"
