"""Early stopping: the error rate holds at any number of looks, and only outcomes decide when to
stop.
"""

from __future__ import annotations

import json
from collections.abc import Callable

import numpy as np
import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero
from pydantic import ValidationError

from vlagents_ray.errors import ConfigError, InvalidInput
from vlagents_ray.evaluate import EvalConfig, Results, evaluate
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.config import StopConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey
from vlagents_ray.evaluate.results.early_stopping import CaseStopping
from vlagents_ray.evaluate.results.reader import rate_of
from vlagents_ray.evaluate.results.statistics import Rate, confidence_sequence, pooled
from vlagents_ray.success import wilson

Config = Callable[..., EvalConfig]


def result(seed: int, success: bool | None, first: int = 0) -> EpisodeResult:
    key = EpisodeKey("line", seed - first, seed, "0")
    return EpisodeResult(key, "infra_failed" if success is None else "done", success, success)


def stopped_at(stop: StopConfig, outcomes: list[bool | None]) -> int | None:
    stopping = CaseStopping(stop, [0], len(outcomes))
    stopping.add_all(result(i, one) for i, one in enumerate(outcomes))
    return stopping.at


def test_bounds_are_those_of_robbins_formula() -> None:
    low, high = confidence_sequence(3, 4)
    for p in (low, high):  # 5 C(4, 3) p^3 (1 - p) = 0.05
        assert 5 * 4 * p**3 * (1 - p) == pytest.approx(0.05)
    assert low < 0.75 < high
    assert confidence_sequence(0, 20)[1] == pytest.approx(1 - (0.05 / 21) ** (1 / 20))


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (0, 50), (50, 50), (7, 20), (400, 1000)])
def test_looking_after_each_episode_costs_width(successes: int, trials: int) -> None:
    low, high = confidence_sequence(successes, trials)
    fixed_low, fixed_high = wilson(successes, trials)
    assert 0 <= low <= fixed_low <= successes / trials <= fixed_high <= high <= 1
    wider = confidence_sequence(successes, trials, 0.01)
    assert wider[0] <= low <= high <= wider[1]


def test_nothing_is_known_without_episodes() -> None:
    assert confidence_sequence(0, 0) == (0, 1)
    assert pooled([Rate(0, 0)], 0.05) == (0, 1)
    with pytest.raises(InvalidInput, match="expected 0 <= successes <= trials"):
        confidence_sequence(3, 2)


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.02, 0.3, 0.5, 0.9])
def test_the_true_rate_is_missed_no_more_often_than_is_said_whenever_one_looks(rate: float) -> None:
    streams, length, error_rate = 2000, 400, 0.05
    counts = np.cumsum(np.random.default_rng(5).random((streams, length)) < rate, axis=1)
    # The bounds depend only on counts, so each pair of counts is computed once.
    missed = np.zeros(streams, bool)
    for n in range(1, length + 1):
        here = counts[:, n - 1]
        bounds = {
            s: confidence_sequence(s, n, error_rate) for s in np.unique(here[~missed]).tolist()
        }
        missed |= [
            not done and not bounds[s][0] <= rate <= bounds[s][1]
            for done, s in zip(missed, here.tolist(), strict=True)
        ]
    assert missed.mean() <= error_rate
    fixed = [
        wilson(s, n)
        for s, n in ((int(counts[i, n - 1]), n) for i in range(100) for n in range(10, length, 10))
    ]
    looks = np.array([not low <= rate <= high for low, high in fixed]).reshape(100, -1).any(axis=1)
    assert looks.mean() > error_rate, (
        "intervals for one look must fail more often for the test to be meaningful"
    )


def test_several_cases_share_the_error_rate() -> None:
    low, high = pooled([Rate(9, 10), Rate(5, 30), Rate(0, 0)], 0.05)
    first, second = confidence_sequence(9, 10, 0.025), confidence_sequence(5, 30, 0.025)
    assert low == pytest.approx((first[0] * 10 + second[0] * 30) / 40)
    assert high == pytest.approx((first[1] * 10 + second[1] * 30) / 40)
    assert pooled([Rate(9, 10)], 0.05) == confidence_sequence(9, 10, 0.05)


def test_a_case_stops_when_the_target_is_excluded() -> None:
    at = stopped_at(StopConfig(target=0.9), [False] * 50)
    assert at is not None
    assert confidence_sequence(0, at)[1] < 0.9 <= confidence_sequence(0, at - 1)[1]
    assert stopped_at(StopConfig(target=0.9, at_least=20), [False] * 50) == 20


def test_a_case_stops_when_its_interval_is_narrow() -> None:
    at = stopped_at(StopConfig(width=0.2), [True] * 100)
    assert at is not None
    low, high = confidence_sequence(at, at)
    assert high - low < 0.2
    assert stopped_at(StopConfig(width=0.01), [True] * 100) is None


def test_nothing_after_an_episode_without_a_result_counts() -> None:
    stop = StopConfig(target=0.9)
    assert stopped_at(stop, [False] * 20) is not None
    assert stopped_at(stop, [False, None] + [False] * 20) is None


def test_where_a_case_stops_does_not_depend_on_the_order_in_which_episodes_arrive() -> None:
    rng = np.random.default_rng(1)
    outcomes = [
        result(seed, bool(rng.random() < 0.4), first)
        for first in (100, 0)
        for seed in range(first, first + 30)
    ]
    found = set()
    for _ in range(20):
        stopping = CaseStopping(StopConfig(target=0.8), [100, 0], 60)
        for index in rng.permutation(60):
            stopping.add(outcomes[index])
        found.add((stopping.at, tuple(stopping.counts(one.key) for one in outcomes)))
    [(at, counted)] = found
    assert at is not None
    assert counted == (True,) * at + (False,) * (60 - at), (
        "the planned order is the order of the seeds"
    )


def test_a_rule_has_an_end() -> None:
    with pytest.raises(ValidationError, match="expected a target, a width or both, got neither"):
        StopConfig()


STOP = {"target": 0.3, "at_least": 3}


@pytest.mark.usefixtures("shared_ray")
class TestOnACluster:
    def test_the_result_does_not_depend_on_the_number_of_workers(self, config: Config) -> None:
        out = config().out
        found = []
        for workers in (0, 3):
            settings = config(
                envs=[LINE, OTHER_LINE],
                episodes=40,
                workers=workers,
                stop=STOP,
                out=out / str(workers),
            )
            summary = evaluate(settings, agent_factory=ToZero)
            assert summary.state == "complete"
            found.append(
                [
                    (case.stopped_at, [outcome(one) for one in case.counted])
                    for case in summary.results.cases
                ]
            )
        assert all(one == found[0] for one in found)
        for (at, counted), case in zip(found[0], summary.results.cases, strict=True):
            assert at is not None
            assert at == len(counted) < 40
            assert len(case.episodes) >= at, "episodes beyond the stop are kept"


def test_what_a_stopped_case_says_holds_and_resuming_plays_nothing(config: Config) -> None:
    settings = config(episodes=40, stop=STOP, workers=0)
    summary = evaluate(settings, agent_factory=ToZero)
    [case] = summary.results.cases
    rate = rate_of([case], "success_once")
    assert rate.interval == confidence_sequence(rate.successes, rate.episodes)
    assert rate.interval[0] > 0.3
    [written] = json.loads((settings.out / "summary.json").read_text())["cases"]
    assert written["stopped_at"] == case.stopped_at == written["success_once"]["episodes"]
    assert written["success_once"]["error_rate"] == 0.05
    assert "wilson_95" not in written["success_once"]
    assert summary.total.infra_failures == 0
    evaluate(config(episodes=40, stop=STOP, workers=0, resume=True), agent_factory=ToZero)
    [again] = Results.load(settings.out).cases
    assert again.episodes == case.episodes
    with pytest.raises(ConfigError, match=r"plan: .*early stopping was"):
        evaluate(config(episodes=40, workers=0, resume=True), agent_factory=ToZero)
    whole = evaluate(
        config(episodes=40, workers=0, resume=True, accept_changes=True), agent_factory=ToZero
    )
    assert whole.total.episodes == 40
    assert whole.total.success_once.error_rate == 0.05, "the plan changed after the first results"


def outcome(one: EpisodeResult) -> tuple[object, ...]:
    return one.key, one.status, one.success_once, one.steps, one.episode_return
