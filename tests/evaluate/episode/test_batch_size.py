"""Results do not depend on the number of environments, even if one of them fails."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from in_process_evaluation import flat_config

from vlagents_ray.contract import ActionSpec, Contract, StateSpec
from vlagents_ray.envs.base import ERROR, BatchEnv, EvalEnv, SequentialBatch
from vlagents_ray.errors import EnvFailed, InvalidAction
from vlagents_ray.evaluate import EvalConfig, evaluate
from vlagents_ray.evaluate import run as evaluation
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.summary import Summary
from vlagents_ray.interface import Act, Agent, Obs

Config = Callable[..., EvalConfig]
EPISODES = 8
NAME = f"{__name__}:Fragile"


class PhysicsError(RuntimeError):
    """An error with the name of dm_control's error."""


EXPLOSIONS: dict[str, Exception] = {  # Errors with which simulators report that they diverged.
    "MuJoCo": RuntimeError(
        "Nan, Inf or huge value in QACC at DOF 0. The simulation is unstable. Time = 0.0020."
    ),
    "dm_control": PhysicsError("Physics state is invalid. Warning(s) raised: mjWARN_BADQACC"),
    "numpy": FloatingPointError("overflow encountered in multiply"),
    "linear algebra": np.linalg.LinAlgError("Eigenvalues did not converge"),
    "SciPy": ValueError("array must not contain infs or NaNs"),
    "environment's own check": EnvFailed("env step: the state of 'arm' is not finite"),
}
AT_RESET = ["reset raises", "reset refuses", "reset sees nothing"]
TROUBLES = [
    *AT_RESET,
    "refuses",
    "diverges",
    "reward",
    "raises",
    "answers badly",
    "wrong state",
    *EXPLOSIONS,
]
_OTHERS = itertools.count(10)
_LIMIT = 1.0  # limit of an action, beyond which the environment fails


class Fragile(EvalEnv):
    """An environment that fails in one of several ways at an action beyond its limit."""

    max_steps = 5
    instruction = "hold"
    contract = Contract(state={"seed": StateSpec(1)}, action=ActionSpec(dim=1, delta=True))

    def __init__(self, trouble: str) -> None:
        self._trouble, self._seed, self._steps = trouble, 0, 0

    def reset(self, *, seed: int, options: object = None) -> tuple[Obs, dict[str, Any]]:
        self._seed, self._steps = seed, 0
        if seed % 3 == 1 and self._trouble == "reset raises":
            raise RuntimeError("the assets of this scene are missing")
        if seed % 3 == 1 and self._trouble == "reset refuses":
            raise InvalidAction("action: expected one with which the scene settles")
        if seed % 3 == 1 and self._trouble == "reset sees nothing":
            return self._look(np.nan), {}
        return self._look(), {}

    def step(self, act: Act) -> Any:
        self._steps += 1
        reward, width = 0.0, 1
        number = float(self._seed)
        if abs(act.action[0]) > _LIMIT:
            if self._trouble == "refuses":
                raise InvalidAction(
                    f"action: expected a finite number of at most {_LIMIT}, got {act.action[0]}"
                )
            if self._trouble in EXPLOSIONS:
                raise EXPLOSIONS[self._trouble]
            if self._trouble == "raises":
                raise RuntimeError("the simulator exploded")
            if self._trouble == "answers badly":
                return None
            number = np.nan if self._trouble == "diverges" else number
            reward = np.inf if self._trouble == "reward" else reward
            width = 2 if self._trouble == "wrong state" else width
        over = self._steps == self.max_steps
        return self._look(number, width), reward, False, over, {"success": over}

    def close(self) -> None:
        pass

    def _look(self, number: float | None = None, width: int = 1) -> Obs:
        return Obs(
            state={"seed": np.full(width, self._seed if number is None else number, np.float32)}
        )


class InOneSimulator(SequentialBatch):
    """Environments of one simulator. If one environment raises an error, the simulator raises it
    for all of them.
    """

    def step(self, acts: Any) -> Any:
        steps = super().step(acts)
        for info in steps[-1]:
            if ERROR in info:
                raise info[ERROR]
        return steps


class FragileTogether(Fragile):
    @classmethod
    def batched(cls, num_envs: int, **options: Any) -> BatchEnv | None:
        return InOneSimulator([cls(**options) for _ in range(num_envs)])


class Extreme(Agent):
    """A policy that exceeds the limit in the third step of every third episode. If it is
    `restless`, the action differs each time.
    """

    def __init__(self, restless: bool = False) -> None:
        self._restless, self._steps, self._extreme = restless, 0, 10.0

    def sessions(self, number: int) -> list[Agent]:
        return [Extreme(self._restless) for _ in range(number)]

    def reset(self, obs: Obs, instruction: str | None, **kwargs: object) -> dict[str, Any]:
        self._steps = 0
        if self._restless:
            self._extreme = float(next(_OTHERS))
        return {}

    def act(self, obs: Obs) -> Act:
        self._steps += 1
        exceeds = self._steps == 3 and obs.state["seed"][0] % 3 == 1
        return Act(np.array([self._extreme if exceeds else 0.5], np.float32))

    def act_batch(self, observations: list[Obs], sessions: Any) -> list[Act]:
        return [session.act(obs) for obs, session in zip(observations, sessions, strict=True)]


@pytest.fixture(autouse=True)
def no_signal(monkeypatch: pytest.MonkeyPatch) -> None:
    """Do not wait for a signal after a failure, since these tests send none; test_in_process.py
    sends one.
    """
    monkeypatch.setattr(evaluation, "SIGNAL_S", 0.0)


@pytest.fixture
def run(config: Config, tmp_path: Any) -> Callable[..., Summary]:
    def play(trouble: str, num_envs: int = 1, **options: Any) -> Summary:
        settings = flat_config(
            env_options={"trouble": trouble},
            episodes=EPISODES,
            num_envs=num_envs,
            workers=0,
            video="none",
            out=tmp_path / f"{num_envs}",
            abort_after=0,
            **{"envs": [NAME], "retries": 1, **options},
        )
        return evaluate(settings, agent_factory=Extreme)

    return play


def outcomes(summary: Summary) -> dict[int, tuple[object, ...]]:
    """Return status, success and actions of each episode by number."""
    return {
        one.result.key.episode: (
            one.result.status,
            one.result.success_once,
            one.result.actions_sha256,
        )
        for one in summary.results.cases[0].episodes
    }


@pytest.mark.slow
@pytest.mark.parametrize("trouble", TROUBLES)
def test_an_episode_that_fails_leaves_those_beside_it_as_they_are(
    run: Callable[..., Summary], trouble: str
) -> None:
    alone = outcomes(run(trouble))
    assert len(alone) == EPISODES
    assert {episode for episode, (status, *_) in alone.items() if status != "done"} == {1, 4, 7}
    assert outcomes(run(trouble, num_envs=4)) == alone
    assert outcomes(run(trouble, num_envs=3)) == alone


@pytest.mark.slow
@pytest.mark.parametrize("trouble", ["refuses", *EXPLOSIONS])
def test_an_error_of_a_simulator_of_several_environments_names_its_episode(
    run: Callable[..., Summary], trouble: str
) -> None:
    """After an error of one of several episodes, each episode is run alone."""
    alone = outcomes(run(trouble))
    together = run(trouble, num_envs=4, envs=[f"{__name__}:FragileTogether"], retries=2)
    assert outcomes(together) == alone
    assert together.cases[0].infra_failures == 0


@pytest.mark.slow
@pytest.mark.parametrize("retries", [1, 2, 3])
@pytest.mark.parametrize("trouble", ["raises", *AT_RESET])
def test_an_episode_that_breaks_the_simulator_of_several_loses_no_other_one(
    run: Callable[..., Summary], trouble: str, retries: int
) -> None:
    alone = outcomes(run(trouble))
    together = run(trouble, num_envs=4, envs=[f"{__name__}:FragileTogether"], retries=retries)
    assert outcomes(together) == alone
    assert together.cases[0].infra_failures == 3


@pytest.mark.slow
@pytest.mark.parametrize("trouble", ["diverges", "reward", *EXPLOSIONS])
@pytest.mark.parametrize("num_envs", [1, 4])
def test_a_simulation_that_diverges_again_under_the_same_actions_is_a_failure_of_the_policy(
    run: Callable[..., Summary], trouble: str, num_envs: int
) -> None:
    summary = run(trouble, num_envs)
    [group] = summary.cases
    assert (group.success_once.successes, group.success_once.episodes, group.infra_failures) == (
        5,
        EPISODES,
        0,
    )
    failed = [
        one.result for one in summary.results.cases[0].episodes if one.result.status != "done"
    ]
    assert {(one.status, one.steps, one.success_once) for one in failed} == {
        ("policy_error", 3, False)
    }
    assert all("diverged, and again when it was repeated" in str(one.error) for one in failed)
    assert len(summary.results.cases[0].attempts) == 3, (
        "the first attempts of all episodes are kept"
    )


def test_a_simulation_that_diverges_under_other_actions_is_a_failure_after_its_retries(
    tmp_path: Any,
) -> None:
    settings = flat_config(
        envs=[NAME],
        env_options={"trouble": "diverges"},
        episodes=EPISODES,
        workers=0,
        out=tmp_path / "out",
        retries=1,
    )
    summary = evaluate(settings, agent_factory=lambda: Extreme(restless=True))
    [group] = summary.cases
    once = group.success_once
    assert (once.successes, once.episodes, group.infra_failures) == (5, EPISODES, 0)


def test_the_bounds_with_lost_episodes_stand_beside_the_rate(
    run: Callable[..., Summary], tmp_path: Any
) -> None:
    summary = run("raises")
    [group] = summary.cases
    assert (group.success_once.episodes, group.infra_failures) == (5, 3)
    assert group.with_lost(group.success_once) == (5 / 8, 1.0)
    assert summary.to_json()["cases"][0]["with_lost"]["success_once"] == (5 / 8, 1.0)
    page = write_report(summary.results, tmp_path / "page.html").read_text()
    assert "62.5 to 100.0" in page


def test_a_simulator_that_raises_is_lost_and_not_a_failure_of_the_policy(
    run: Callable[..., Summary],
) -> None:
    [group] = run("raises").cases
    assert (group.success_once.episodes, group.infra_failures) == (5, 3)
