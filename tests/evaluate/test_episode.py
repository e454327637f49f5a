from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np
import pytest
from eval_fakes import Line, ToZero

from vlagents_ray.contract import ActionSpec, Contract
from vlagents_ray.envs import EvalEnv
from vlagents_ray.errors import ConnectionLost, EnvFailed, InvalidAction
from vlagents_ray.evaluate.episode import run_episode
from vlagents_ray.evaluate.jobs import EpisodeKey
from vlagents_ray.interface import HIGH_RES, Act, Agent, Obs

KEY = EpisodeKey("script", 3, 11, "0")


class Script(EvalEnv):
    """Succeeds in the states whose numbers are in `solved`; keeps the actions it was given."""

    max_steps = 6

    def __init__(self, solved: tuple[int, ...] = (), terminates_at: int | None = None, obs: Obs | None = None) -> None:
        self.solved, self.terminates_at = solved, terminates_at
        self.obs = obs or Obs()
        self.actions: list[list[float]] = []
        self.resets: list[tuple[int, Mapping[str, Any] | None]] = []

    @property
    def contract(self) -> Contract:
        return Contract(action=ActionSpec(dim=2))

    @property
    def instruction(self) -> str:
        return "do it"

    def reset(self, *, seed: int, options: Mapping[str, Any] | None = None) -> tuple[Obs, dict[str, Any]]:
        self.resets.append((seed, options))
        return self.obs, {}

    def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
        self.actions.append(act.action.tolist())
        n = len(self.actions)
        return self.obs, 0.5, n == self.terminates_at, n == self.max_steps, {"success": n in self.solved}

    def close(self) -> None:
        self.actions = []


class Chunks(Agent):
    """Answers with the given actions, one after another; remembers what it was asked."""

    def __init__(self, *answers: Any) -> None:
        self.answers: Iterator[Any] = iter(answers)
        self.seen: list[Obs] = []
        self.began: dict[str, Any] = {}

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.began = {"instruction": instruction, **kwargs}
        return {}

    def act(self, obs: Obs) -> Act:
        self.seen.append(obs)
        answer = next(self.answers)
        if isinstance(answer, Exception):
            raise answer
        return answer if isinstance(answer, Act) else Act(np.asarray(answer, np.float32))


ROW = [1.0, 2.0]
CHUNK = [[1.0, 0.0], [2.0, 0.0], [3.0, 0.0]]


def test_a_chunk_is_executed_row_by_row_without_asking_again() -> None:
    env, agent = Script(), Chunks(CHUNK, CHUNK)
    result = run_episode(env, agent, KEY)
    assert env.actions == [[1, 0], [2, 0], [3, 0]] * 2
    assert (result.steps, result.acts) == (6, 2)


def test_only_the_first_rows_of_a_chunk_are_executed_when_so_set() -> None:
    env = Script()
    result = run_episode(env, Chunks(CHUNK, CHUNK, CHUNK), KEY, execute=2)
    assert env.actions == [[1, 0], [2, 0]] * 3
    assert (result.steps, result.acts) == (6, 3)


def test_a_finished_policy_ends_the_episode_after_its_rows() -> None:
    env = Script(solved=(4,))
    result = run_episode(env, Chunks(ROW, Act(np.asarray(CHUNK, np.float32), done=True)), KEY)
    assert (result.steps, result.ending, result.success_at_end) == (4, "policy_done", True)


def test_a_terminated_env_ends_the_episode_within_a_chunk() -> None:
    result = run_episode(Script(terminates_at=2), Chunks(CHUNK), KEY)
    assert (result.steps, result.ending) == (2, "terminated")


def test_the_step_limit_truncates() -> None:
    result = run_episode(Script(), Chunks(*[ROW] * 6), KEY)
    assert (result.steps, result.ending, result.episode_return) == (6, "truncated", 3.0)


def test_the_step_limit_holds_for_an_env_that_forgets_it() -> None:
    class Endless(Script):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            return (*super().step(act)[:3], False, {"success": False})

    assert run_episode(Endless(), Chunks(*[ROW] * 9), KEY).steps == 6


@pytest.mark.parametrize(
    ("solved", "once", "at_end"), [((), False, False), ((2,), True, False), ((2, 6), True, True), ((6,), True, True)]
)
def test_success_once_and_at_the_end_are_told_apart(solved: tuple[int, ...], once: bool, at_end: bool) -> None:
    result = run_episode(Script(solved), Chunks(*[ROW] * 6), KEY)
    assert (result.success_once, result.success_at_end) == (once, at_end)


def test_the_key_decides_both_resets() -> None:
    env, agent = Script(), Chunks(*[ROW] * 6)
    run_episode(env, agent, KEY, reset_options={"layout": 2})
    assert env.resets == [(11, {"layout": 2})]
    assert agent.began == {"instruction": "do it", "seed": 11, "env": "script"}


def test_a_remote_policy_is_told_the_contract_of_the_env() -> None:
    class Remote(Chunks):
        metadata: ClassVar[dict[str, Any]] = {}
        transport = "websocket"

    agent = Remote(*[ROW] * 6)
    result = run_episode(Script(), agent, KEY)
    assert Contract.from_json(agent.began["contract"]) == Script().contract
    assert result.transport == "websocket"


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        (RuntimeError("CUDA out of memory"), "policy_failed"),
        ([float("nan"), 0.0], "invalid_action"),
        ([1.0, 2.0, 3.0], "invalid_action"),
        ("none", "policy_failed"),
    ],
)
def test_a_policy_that_fails_ends_its_episode_without_success(answer: Any, code: str) -> None:
    result = run_episode(Script(solved=(1,)), Chunks(ROW, answer), KEY)
    assert (result.status, result.ending, result.steps) == ("policy_error", "error", 1)
    assert (result.success_once, result.success_at_end) == (False, False)
    assert result.error is not None
    assert result.error.startswith(code)


def test_a_lost_connection_is_no_failure_of_the_policy() -> None:
    with pytest.raises(ConnectionLost):
        run_episode(Script(), Chunks(ROW, ConnectionLost("gone")), KEY)


@pytest.mark.parametrize("error", [RuntimeError("physics exploded"), SystemExit("an asset is missing")])
def test_whatever_a_simulator_raises_is_an_env_failure(error: BaseException) -> None:
    class Broken(Script):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            raise error

    with pytest.raises(EnvFailed, match=str(error)):
        run_episode(Broken(), Chunks(ROW), KEY)


def test_an_action_that_the_env_refuses_counts_against_the_policy() -> None:
    class Narrow(Script):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            raise InvalidAction("got 2 numbers, want 7")

    assert run_episode(Narrow(), Chunks(ROW), KEY).status == "policy_error"


def test_an_env_that_does_not_say_whether_it_is_solved_is_an_env_failure() -> None:
    class Silent(Script):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            return (*super().step(act)[:4], {})

    with pytest.raises(EnvFailed, match="want 'success'"):
        run_episode(Silent(), Chunks(ROW), KEY)


@pytest.mark.parametrize("reward", [math.nan, math.inf])
def test_a_reward_that_is_no_number_is_an_env_failure(reward: float) -> None:
    class Diverged(Script):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            obs, _, *rest = super().step(act)
            return obs, reward, *rest

    with pytest.raises(EnvFailed, match=f"got the reward {reward}, want a finite number"):
        run_episode(Diverged(), Chunks(ROW), KEY)


def test_views_for_the_record_are_recorded_and_never_reach_the_policy() -> None:
    obs = Obs(info={HIGH_RES: {"front": np.zeros((8, 8, 3), np.uint8)}, "note": "kept"})
    agent, recorded = Chunks(*[ROW] * 6), list[Obs]()
    run_episode(Script(obs=obs), agent, KEY, record=recorded.append)
    assert all(seen.info == {"note": "kept"} for seen in agent.seen)
    assert len(recorded) == 7
    assert all(HIGH_RES in one.info for one in recorded)


def test_every_call_is_announced_to_the_watch() -> None:
    phases: list[tuple[str, int]] = []
    run_episode(
        Script(terminates_at=2), Chunks(ROW, ROW), KEY, watch=lambda phase, steps: phases.append((phase, steps))
    )
    assert phases == [
        ("env reset", 0),
        ("policy reset", 0),
        ("policy act", 0),
        ("env step", 0),
        ("policy act", 1),
        ("env step", 1),
    ]


def test_two_runs_of_one_key_are_the_same_episode() -> None:
    def outcome() -> tuple[Any, ...]:
        result = run_episode(Line(), ToZero(chunk=2), EpisodeKey("line", 0, 5, "0"))
        return result.steps, result.episode_return, result.success_once, result.instruction

    assert outcome() == outcome()


def test_the_policys_options_reach_its_reset_and_the_result_says_what_checkpoint_played() -> None:
    class Named(Chunks):
        def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
            super().reset(obs, instruction, **kwargs)
            return {"checkpoint": f"runs/{kwargs['checkpoint_step']}"}

    agent = Named(*[np.zeros(2)] * 6)
    result = run_episode(Script(), agent, KEY, policy_options={"checkpoint_step": 20})
    assert agent.began["checkpoint_step"] == 20
    assert result.checkpoint == "runs/20"
    assert run_episode(Script(), Chunks(*[np.zeros(2)] * 6), KEY).checkpoint is None


@pytest.mark.parametrize(("images", "looked_at"), [(True, [True] * 6), (False, [False, False, True] * 2)])
def test_an_env_is_told_whether_anybody_looks(images: bool, looked_at: list[bool]) -> None:
    class Told(Script):
        def step(self, act: Act) -> tuple[Obs, float, bool, bool, dict[str, Any]]:
            told.append(self.looked_at)
            return super().step(act)

    told: list[bool] = []
    chunk = np.zeros((3, 2), np.float32)
    result = run_episode(Told(), Chunks(chunk, chunk), KEY, images=images)
    assert result.steps == 6
    assert told == looked_at
