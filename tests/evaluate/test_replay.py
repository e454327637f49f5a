"""Replaying an episode from its recording."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero
from in_process_evaluation import play

from vlagents_ray.errors import ConfigError
from vlagents_ray.evaluate import EvalConfig, Results, evaluate
from vlagents_ray.evaluate import exports as tables
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.config import PushedWeights
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.replay import actions_difference, compare, find
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.interface import Act, Obs

Config = Callable[..., EvalConfig]


class Noisy(ToZero):
    """A policy whose noise differs in each run from its fourth act, by more than rounding."""

    _draws: ClassVar[Iterator[int]] = itertools.count(10)

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self._acts = 0
        return super().reset(obs, instruction, **kwargs)

    def act(self, obs: Obs) -> Act:
        self._acts += 1
        act = super().act(obs)
        if self._acts < 4:
            return act
        return Act(act.action + np.float32(0.001 * next(self._draws)))


def test_a_deterministic_policy_does_the_same_byte_for_byte(config: Config, tmp_path: Path) -> None:
    results = play(config(episodes=4, seed=20))
    recorded = find(results, f"{LINE}#2")
    settings, only = recorded.config(tmp_path / "again"), recorded.number_and_seed
    here = settings.model_copy(update={"workers": 0})
    replayed = evaluate(here, agent_factory=ToZero, only=only).results
    assert compare(recorded, replayed) == []
    [episode] = replayed.cases[0].episodes
    assert episode.result.key == recorded.episode.result.key
    assert episode.trajectory is not None


def again(results: Any, name: str, out: Path, make: Callable[[], ToZero]) -> list[str]:
    recorded = find(results, name)
    number, _ = recorded.number_and_seed
    others = set(range(len(results.cases[0].episodes))) - {number}
    return compare(recorded, play(recorded.config(out), make, left_out=others))


def test_a_noisy_policy_is_told_with_the_step_at_which_it_differs(
    config: Config, tmp_path: Path
) -> None:
    results = play(config(episodes=2, record="all"), Noisy)
    first, *others = again(results, f"{LINE}#1", tmp_path / "again", Noisy)
    assert first.startswith("actions: they differ from step 3: expected [")
    assert any(line.startswith("episode_return: ") for line in others)


@pytest.mark.parametrize(
    ("record", "why"),
    [
        ("none", "but without a recorded trajectory .*--record all"),
        ("all", r"the first step is not known, as .*\.npz, the recorded trajectory, is missing$"),
    ],
)
def test_without_a_trajectory_it_is_said_that_the_actions_differ(
    config: Config, tmp_path: Path, record: str, why: str
) -> None:
    results = play(config(episodes=2, record=record), Noisy)
    for trajectory in results.out.rglob("*.npz"):
        trajectory.unlink()
    first, *_ = again(results, f"{LINE}#1", tmp_path / "again", Noisy)
    assert re.match(rf"actions: they differ[,;] {why}", first)


class Rounded(ToZero):
    """A policy that differs from the recorded one in its third action, as in a batch of another
    size.
    """

    def __init__(self, difference: float) -> None:
        super().__init__()
        self._difference, self._acts = difference, 0

    def act(self, obs: Obs) -> Act:
        self._acts += 1
        act = super().act(obs)
        return Act(act.action + np.float32(self._difference)) if self._acts == 3 else act


@pytest.mark.parametrize(
    ("difference", "is_rounding"), [(1e-6, True), (8e-6, True), (1e-3, False), (0.1, False)]
)
def test_rounding_is_told_from_another_action(
    config: Config, tmp_path: Path, difference: float, is_rounding: bool
) -> None:
    recorded = find(play(config(episodes=1, record="all")), f"{LINE}#0")
    replayed = play(recorded.config(tmp_path / "again"), lambda: Rounded(difference))
    found = actions_difference(recorded, replayed)
    assert found is not None
    assert found.step == 2
    assert 0 < found.at_first <= 1.1 * difference, (
        "the difference is relative, since the action is above 1"
    )
    assert found.is_rounding is is_rounding
    assert (compare(recorded, replayed) == []) is is_rounding


class Drifting(ToZero):
    """A policy that differs from its third act, by a number that grows with each act."""

    def __init__(self, first: float, factor: float) -> None:
        super().__init__()
        self._difference, self._factor, self._acts = first, factor, 0

    def act(self, obs: Obs) -> Act:
        self._acts += 1
        act = super().act(obs)
        if self._acts < 3:
            return act
        self._difference *= self._factor
        return Act(act.action + np.float32(self._difference))


@pytest.mark.parametrize(
    ("first", "factor", "is_rounding"),
    [(1e-7, 3.0, True), (1e-7, 5.0, False), (3e-3, 1.0, False)],
    ids=["grows a little", "grows to another motion", "begins with another action"],
)
def test_rounding_may_grow_with_the_steps_but_not_begin_as_another_action(
    config: Config, tmp_path: Path, first: float, factor: float, is_rounding: bool
) -> None:
    """A difference of 1e-7 at one step becomes 1e-5 some steps later, since each observation
    depends on earlier actions.
    """
    recorded = find(play(config(episodes=1, record="all")), f"{LINE}#0")
    replayed = play(recorded.config(tmp_path / "again"), lambda: Drifting(first, factor))
    found = actions_difference(recorded, replayed)
    assert found is not None
    assert found.largest >= found.at_first > 0
    assert (compare(recorded, replayed) == []) is is_rounding


def test_the_same_actions_have_no_difference_and_without_a_recording_it_is_unknown(
    config: Config, tmp_path: Path
) -> None:
    recorded = find(play(config(episodes=1, record="all")), f"{LINE}#0")
    assert actions_difference(recorded, play(recorded.config(tmp_path / "same"))) is None
    unrecorded = find(play(config(episodes=1, out=tmp_path / "other")), f"{LINE}#0")
    replayed = play(unrecorded.config(tmp_path / "again"), lambda: Rounded(1e-6))
    assert actions_difference(unrecorded, replayed) is None
    assert (
        "neither the first step nor the size of the difference is known"
        in compare(unrecorded, replayed)[0]
    )


class Tired(Noisy):
    """A policy that is done with its sixth act."""

    def act(self, obs: Obs) -> Act:
        self._acts += 1
        return Act(ToZero.act(self, obs).action, done=self._acts == 6)


def test_fewer_actions_are_told_as_such(config: Config, tmp_path: Path) -> None:
    longer = find(play(config(episodes=1, record="all")), f"{LINE}#0")
    found = compare(longer, play(longer.config(tmp_path / "again"), Tired))
    assert found[0] == "actions: expected 10, as recorded, got 6; the first 6 are the same"


def test_a_replay_that_infrastructure_kept_from_ending_is_no_difference(
    config: Config, tmp_path: Path
) -> None:
    recorded = find(play(config(episodes=1, record="all")), f"{LINE}#0")
    settings = recorded.config(tmp_path / "again")
    with Store(resolve(settings)) as store:
        store.begin_run({})
        store.record(
            EpisodeResult(recorded.episode.result.key, "infra_failed", error="it hung"), attempts=4
        )
    with pytest.raises(
        ConfigError, match=r"expected a finished replay to compare, got a failed replay: it hung"
    ):
        compare(recorded, Results.load(settings.out))


def test_an_episode_is_found_by_its_key_and_by_env_and_number_if_it_is_the_only_one(
    config: Config,
) -> None:
    results = play(config(envs=[LINE, OTHER_LINE], episodes=2))
    key = results.cases[1].episodes[1].result.key
    assert (
        find(results, str(key)).episode
        == find(results, f"{OTHER_LINE}#1").episode
        == results.cases[1].episodes[1]
    )
    for name in (LINE, f"{LINE}#7", "tabletop#0", f"{LINE}#0@0"):
        with pytest.raises(ConfigError, match="which no episode has"):
            find(results, name)


def test_seeds_are_not_guessed_and_episodes_beyond_the_point_of_stopping_are_found(
    config: Config, tmp_path: Path
) -> None:
    with pytest.raises(ConfigError, match=r"which 2 episodes have; use one of the keys .*@0.*@10"):
        find(play(config(episodes=1, seeds=[0, 10], out=tmp_path / "seeds")), f"{LINE}#0")
    results = play(config(episodes=30, stop={"target": 0.3}))
    assert not (last := results.cases[0].episodes[-1]).counts
    assert find(results, f"{LINE}#29").episode == last


def with_weights(results: Results, weights: str) -> Results:
    [case] = results.cases
    episodes = [replace(one, result=replace(one.result, weights=weights)) for one in case.episodes]
    return results.among([replace(case, episodes=tuple(episodes))])


def test_a_key_ends_with_the_weights_that_played_it(config: Config) -> None:
    results = with_weights(play(config(episodes=2)), f"sampled-sha256:{'9f2c' * 16}")
    first, second = results.cases[0].episodes
    assert second.result.full_key == f"{second.result.key}~9f2c9f2c9f2c9f2c"
    assert [row["key"] for row in tables.rows(results)] == [
        first.result.full_key,
        second.result.full_key,
    ]
    assert (
        find(results, second.result.full_key).episode
        == find(results, str(second.result.key)).episode
        == second
    )


def test_a_replay_that_differs_says_that_the_weights_are_others(
    config: Config, tmp_path: Path
) -> None:
    results = with_weights(play(config(episodes=1)), "a")
    recorded = find(results, f"{LINE}#0")
    assert compare(recorded, with_weights(play(recorded.config(tmp_path / "same")), "b")) == []
    found = compare(recorded, with_weights(play(recorded.config(tmp_path / "other"), Noisy), "b"))
    assert (
        found[-1]
        == "weights: expected a, as recorded, got b: another checkpoint, or other files in it"
    )


def test_the_settings_are_those_of_the_run_and_of_that_case_alone(
    config: Config, tmp_path: Path
) -> None:
    settings = config(envs=[LINE, OTHER_LINE], episodes=1, steps=[10, 20], execute=1, workers=2)
    results = play(settings)
    recorded = find(results, str(results.cases[3].episodes[0].result.key))
    alone = recorded.config(tmp_path / "again")
    [case] = plan_cases(alone)
    assert (case.env, case.step, case.fingerprint) == (OTHER_LINE, 20, recorded.case.case_id)
    assert (alone.workers, alone.out) == (None, tmp_path / "again")


def test_pushed_weights_are_asked_for_again(config: Config, tmp_path: Path) -> None:
    pushed = PushedWeights(version=3, fingerprint="of a test")
    policy = config().policies[0].model_copy(update={"pushed_weights": pushed})
    results = play(config(episodes=1).model_copy(update={"policies": [policy]}))
    recorded = find(results, f"{LINE}#0")
    [case] = plan_cases(recorded.config(tmp_path / "again"))
    assert (case.policy_id, case.fingerprint) == ("policy@3", recorded.case.case_id)


def test_a_policy_that_was_served_for_the_run_is_served_again_and_a_server_is_asked_again(
    config: Config, tmp_path: Path
) -> None:
    for source, url in (("scripted", None), (None, "http://gpu-box:8000")):
        settings = config(out=tmp_path / str(source), episodes=1)
        policy = settings.policies[0].model_copy(
            update={"source": source, "url": url or "serve://scripted", "config": {"a": 1}}
        )
        results = play(settings.model_copy(update={"policies": [policy]}))
        [found] = find(results, f"{LINE}#0").config(tmp_path / "again").policies
        assert (found.source, found.url, found.config) == (source, url, {"a": 1} if source else {})


def test_another_policy_takes_the_place_of_the_runs(config: Config, tmp_path: Path) -> None:
    recorded = find(play(config(episodes=1)), f"{LINE}#0")
    [policy] = recorded.config(
        tmp_path / "again", policy={"source": "noop", "url": None, "config": {}}
    ).policies
    assert (policy.source, "name" in policy.model_fields_set) == ("noop", False)
