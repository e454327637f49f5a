"""How many workers, and environments a worker, an evaluation is given: chosen by measured rates."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from vlagents_ray.bench import evaluation
from vlagents_ray.bench.evaluation import EvaluationTuner
from vlagents_ray.errors import EnvFailed
from vlagents_ray.evaluate import EvalConfig

START_S = 10.0


@pytest.fixture
def played(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[int, int], float]], list[EvalConfig]]:
    """Replace `evaluate` by one whose rate, in episodes a minute, is a function of workers and environments."""

    def play(rate: Callable[[int, int], float]) -> list[EvalConfig]:
        configs: list[EvalConfig] = []

        def evaluate(config: EvalConfig) -> SimpleNamespace:
            configs.append(config)
            episodes = sum(len(suite.envs) * len(suite.seeds) * suite.episodes for suite in config.suites)
            seconds = 60 * episodes / rate(config.workers, config.suites[0].num_envs)
            total = SimpleNamespace(episodes=episodes, infra_failures=0)
            return SimpleNamespace(total=total, rollout_seconds=seconds, wall_seconds=seconds + START_S)

        monkeypatch.setattr(evaluation, "evaluate", evaluate)
        return configs

    monkeypatch.setattr(evaluation, "_available_mib", lambda: 1000.0)
    return play


def tuner(*, workers: int = 1, minutes: float = 60, most: int = 8, **suite: object) -> EvaluationTuner:
    config = EvalConfig.model_validate({
        "policies": [{"url": "http://127.0.0.1:1", "steps": [100, 200]}],
        "suites": [{"envs": ["tabletop"], "seeds": [0, 1000], "episodes": 50, **suite}],
        "out": "runs/none", "workers": workers, "track": ["tensorboard"],
    })  # fmt: skip
    return EvaluationTuner(config, time.monotonic() + 60 * minutes, most, progress=lambda _: None)


def test_workers_are_doubled_while_that_helps_then_their_environments(played) -> None:
    configs = played(lambda workers, envs: 30 * min(workers, 4) * (1.5 if envs == 2 else 1))
    found = tuner()
    assert found.measure() == found.found
    tried = [(one.workers, one.num_envs) for one in found.found]
    assert tried == [(1, 1), (2, 1), (4, 1), (8, 1), (4, 2), (4, 4), (4, 8)]
    assert (found.chosen.workers, found.chosen.num_envs) == (4, 2)
    assert found.chosen.total_s == pytest.approx(START_S + 60 * 2 * 2 * 50 / 180)
    assert found.left_out == []
    assert all(config.policies[0].steps == [100] and config.track == [] for config in configs)
    assert all(config.suites[0].envs == ["tabletop"] and config.suites[0].seeds == [0] for config in configs)
    assert configs[0].suites[0].episodes == 2


def test_fewer_environments_at_once_that_take_hardly_longer_are_chosen(played) -> None:
    played(lambda workers, _: 30 * (1 + 0.01 * workers))
    found = tuner()
    found.measure()
    assert (found.chosen.workers, found.chosen.num_envs) == (1, 1)
    assert [one.workers for one in found.found][:3] == [1, 2, 4]  # two in a row that do not help


def test_a_measured_clock_keeps_its_one_environment(played) -> None:
    played(lambda workers, _: 30.0 * workers)
    found = tuner(most=2, clock={"hz": 10})
    found.measure()
    assert {one.num_envs for one in found.found} == {1}


def test_what_takes_too_long_or_fails_is_left_out_and_said(played, monkeypatch: pytest.MonkeyPatch) -> None:
    played(lambda *_: 1.0)
    late = tuner(minutes=1.5)
    late.measure()
    assert late.left_out == ["2 workers of 1: no time was left", "1 worker of 2: no time was left"]

    def broken(workers: int, envs: int) -> float:
        if workers * envs > 1:
            raise EnvFailed("out of memory")
        return 600.0

    played(broken)
    failed = tuner()
    failed.measure()
    assert failed.left_out == ["2 workers of 1: out of memory", "1 worker of 2: out of memory"]


def test_what_would_take_more_memory_than_there_is_is_not_tried(played, monkeypatch: pytest.MonkeyPatch) -> None:
    played(lambda workers, _: 600.0 * workers)
    found = tuner()
    monkeypatch.setattr(EvaluationTuner, "_probe", lambda _, workers, envs: evaluation.MeasuredEvaluation(
        workers, envs, 1.0, 600.0 * workers, 300.0 * workers * envs, 100.0 / workers,
    ))  # fmt: skip
    found.measure()
    assert [one.workers for one in found.found] == [1, 2]
    assert found.left_out[0] == "4 workers of 1: would take about 1200 MiB, 1000 are available"


def test_memory_is_that_of_this_machine() -> None:
    assert 0 < evaluation._available_mib() < 2**40
    with evaluation._memory_used() as used:
        assert used == [0.0]
