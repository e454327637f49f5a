"""Episodes played together come out as those played alone."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from eval_fakes import Line, ToZero
from in_process import Replicas

from vlagents_ray.envs.batch import BatchEnv, InTurn, make_batch
from vlagents_ray.envs.tabletop import Tabletop
from vlagents_ray.errors import ConfigError, ConnectionLost, EnvFailed, VLAgentsError
from vlagents_ray.evaluate.episode import EpisodeResult, run_episode
from vlagents_ray.evaluate.jobs import EpisodeKey
from vlagents_ray.evaluate.side_by_side import run_episodes
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


def together(env: BatchEnv, agent: Agent, wanted: Sequence[EpisodeKey], **options: Any) -> Any:
    return run_episodes(env, agent, [copy.deepcopy(agent) for _ in wanted], wanted, **options)


@pytest.mark.parametrize("execute", [None, 2])
@pytest.mark.parametrize("agent", [Scripted(), Random(), ToZero(chunk=3)], ids=lambda agent: type(agent).__name__)
def test_results_are_those_of_episodes_played_alone(agent: Agent, execute: int | None) -> None:
    on_line = isinstance(agent, ToZero)
    wanted = keys("line" if on_line else "tabletop", 4)
    alone: Any = Line() if on_line else Tabletop(**SIZE, max_steps=50)
    others = [Line() if on_line else Tabletop(**SIZE, max_steps=50) for _ in wanted]
    agent.initialize()
    expected = [run_episode(alone, copy.deepcopy(agent), key, execute=execute) for key in wanted]
    assert len({result.steps for result in expected}) > (isinstance(agent, Scripted))  # they do not end at one time
    with InTurn(others) as env:
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
    assert [replace(result, transport="local") for result in results] == local
    assert served.frames[:4] == [1, 1, 1, 3]  # resets have seeds of their own, and so messages of their own
    acts = [result.acts for result in results]
    assert sum(served.frames[3 : 3 + max(acts)]) == sum(acts)


def test_the_recorder_is_told_every_observation_of_its_own_episode() -> None:
    wanted = keys("tabletop", 2)
    recorded: dict[int, list[Obs]] = {0: [], 1: []}
    with make_batch("tabletop", 2, **SIZE, max_steps=30) as env:
        results = together(env, Scripted(), wanted, record=lambda i, obs: recorded[i].append(obs))
    alone: list[Obs] = []
    with Tabletop(**SIZE, max_steps=30) as env_alone:
        run_episode(env_alone, Scripted(), wanted[1], record=alone.append)
    assert [len(seen) for seen in recorded.values()] == [result.steps + 1 for result in results]
    for one, other in zip(recorded[1], alone, strict=True):
        np.testing.assert_array_equal(one.cameras["front"], other.cameras["front"])


class Odd(ToZero):
    """Fails as told for one of the seeds."""

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
    with InTurn([Line() for _ in wanted]) as env:
        results = untimed(together(env, agent, wanted))
    assert results == untimed(expected)
    assert [result.status for result in results] == ["done", "policy_error", "done"]


def test_a_lost_session_stands_in_place_of_its_result_alone() -> None:
    wanted = keys("line", 3)
    with InTurn([Line() for _ in wanted]) as env:
        results = together(env, Odd(wanted[0].seed, ConnectionLost("gone")), wanted)
    assert isinstance(results[0], ConnectionLost)
    assert untimed(results[1:]) == untimed([run_episode(Line(), ToZero(), key) for key in wanted[1:]])


def test_a_broken_simulator_ends_all() -> None:
    wanted = keys("line", 2)
    with (
        InTurn([Line(), Line(trouble={"raise": [wanted[1].seed]})]) as env,
        pytest.raises(EnvFailed, match="the simulator exploded"),
    ):
        together(env, ToZero(), wanted)


def test_initial_states_go_by_the_episodes_number_and_the_user_before_them() -> None:
    class Fixed(Line):
        init_states = 2
        begun: list[Any]

        def reset(self, *, seed: int, options: Any = None) -> Any:
            self.begun = [seed, options]
            return super().reset(seed=seed)

    envs = [Fixed() for _ in range(3)]
    together(InTurn(envs), ToZero(), keys("line", 3))
    assert [env.begun for env in envs] == [[100, {"init_state": 0}], [107, {"init_state": 1}], [114, {"init_state": 0}]]
    together(InTurn(envs), ToZero(), keys("line", 3), reset_options={"init_state": 1})
    assert all(env.begun[1] == {"init_state": 1} for env in envs)


def test_each_episode_needs_a_session_and_an_environment() -> None:
    with InTurn([Line()]) as env:
        for sessions, count in ((2, 2), (1, 2), (0, 0)):
            with pytest.raises(ConfigError, match="one session an episode"):
                run_episodes(env, ToZero(), [ToZero()] * sessions, keys("line", count))
