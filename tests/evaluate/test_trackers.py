"""Each case is reported to trackers once, when it is complete, and failing trackers never harm the
evaluation.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero
from in_process_evaluation import play

from vlagents_ray import registry
from vlagents_ray.errors import ConfigError, MissingDependency
from vlagents_ray.evaluate import EvalConfig, check, evaluate
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.trackers import TrackedPolicy, TrackerFeed
from vlagents_ray.registry import RegistryEntry

Config = Callable[..., EvalConfig]


class Listener:
    """A tracker that stores its calls."""

    begun: ClassVar[list[TrackedPolicy]] = []
    told: ClassVar[list[tuple[str, int | None, dict[str, float]]]] = []
    shown: ClassVar[list[tuple[str, list[str]]]] = []
    finished: ClassVar[list[str]] = []

    def __init__(self, about: TrackedPolicy) -> None:
        self.about = about
        self.begun.append(about)

    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        self.told.append((self.about.name, step, dict(metrics)))

    def videos(self, label: str, paths: Sequence[Path], step: int | None) -> None:
        assert all(path.is_file() for path in paths)
        self.shown.append((label, [path.name for path in paths]))

    def finish(self) -> None:
        self.finished.append(self.about.name)


class Broken(Listener):
    def log(self, metrics: Mapping[str, float], step: int | None) -> None:
        raise RuntimeError("no such project")


@pytest.fixture(autouse=True)
def listening(monkeypatch: pytest.MonkeyPatch) -> None:
    classes = {"listener": Listener, "broken": Broken}
    entries = {name: RegistryEntry(f"{__name__}:{cls.__name__}") for name, cls in classes.items()}
    entries["lacking"] = RegistryEntry(
        f"{__name__}:Listener",
        needs=("no_such_tracker",),
        extra="lacking",
        distribution="lab-trackers",
    )
    monkeypatch.setitem(registry._BUILT_IN, "trackers", entries)
    for kept in (Listener.begun, Listener.told, Listener.shown, Listener.finished):
        kept.clear()


def tell(config: EvalConfig) -> list[tuple[str, int | None, dict[str, float]]]:
    """Report the current results to a new tracker, and return its calls."""
    Listener.told.clear()
    with TrackerFeed(resolve(config)) as told:
        told.update()
    return list(Listener.told)


def test_rates_return_and_steps_of_each_task_and_in_total_stand_at_the_training_step(
    config: Config,
) -> None:
    settings = config(envs=[LINE, OTHER_LINE], episodes=4, steps=[10, 20], track=["listener"])
    results = play(settings)
    told = tell(settings)
    assert [(step, min(metrics).rpartition("/")[0]) for _, step, metrics in told] == [
        (10, LINE), (10, OTHER_LINE), (20, LINE), (20, OTHER_LINE), (10, "total"), (20, "total")
    ]  # fmt: skip
    counted = results.cases[0].counted
    assert told[0][2] == {
        f"{LINE}/success_once": sum(bool(one.success_once) for one in counted) / 4,
        f"{LINE}/success_at_end": sum(bool(one.success_at_end) for one in counted) / 4,
        f"{LINE}/return": pytest.approx(sum(one.episode_return for one in counted) / 4),
        f"{LINE}/steps": 10.0,
        f"{LINE}/episodes": 4.0,
    }
    assert told[4][2]["total/episodes"] == 8
    assert Listener.finished == ["policy"]


def test_an_unfinished_case_is_told_by_the_run_that_completes_it_and_no_other_twice(
    config: Config,
) -> None:
    settings = config(envs=[LINE, OTHER_LINE], episodes=3, track=["listener"])
    one_env = {"suites": [settings.suites[0].model_copy(update={"envs": [LINE]})]}
    play(settings, left_out=[2])
    assert tell(settings) == []
    play(settings.model_copy(update={"resume": True, "accept_changes": True} | one_env))
    assert [min(metrics) for _, _, metrics in tell(settings)] == [f"{LINE}/episodes"]
    assert tell(settings) == []
    play(settings.model_copy(update={"resume": True}))
    assert [min(metrics) for _, _, metrics in tell(settings)] == [
        f"{OTHER_LINE}/episodes",
        "total/episodes",
    ]
    ids = {about.id for about in Listener.begun}
    assert len(ids) == 1


def test_the_weights_of_the_server_are_in_the_settings_of_the_run(config: Config) -> None:
    settings = config(episodes=1, track=["listener"])
    said = {
        "policy": "act",
        "checkpoint": "runs/last",
        "weights": {"digest": "x", "revision": None},
    }

    class Served(ToZero):
        metadata: ClassVar = {**said, "version": "1"}

    play(settings, Served)
    tell(settings)
    assert Listener.begun[0].config["served"] == said


def test_a_case_that_stopped_early_is_complete(config: Config) -> None:
    settings = config(episodes=40, stop={"target": 0.3}, track=["listener"])
    [case] = play(settings, left_out=range(30, 40)).cases
    assert case.stopped_at is not None
    assert [metrics[min(metrics)] for _, _, metrics in tell(settings)] == [case.stopped_at] * 2


def test_of_the_videos_a_few_are_shown_failures_first(config: Config) -> None:
    settings = config(
        episodes=12,
        video="all",
        env_options={"camera": [32, 32]},
        track=["listener"],
        tracking={"videos": 3},
    )
    play(settings)
    tell(settings)
    [(label, names)] = Listener.shown
    assert (label, len(names)) == (LINE, 3)
    assert all("_failure_" in name for name in names)


def test_a_tracker_that_fails_is_a_warning_and_the_others_go_on(
    config: Config, caplog: pytest.LogCaptureFixture
) -> None:
    settings = config(episodes=2, steps=[1], track=["broken", "listener"])
    play(settings)
    assert len(tell(settings)) == 2
    [record] = caplog.records
    assert (
        record.getMessage() == "broken: RuntimeError: no such project; nothing more is logged to it"
    )


def test_an_evaluation_tells_while_it_runs_and_at_its_end(config: Config) -> None:
    settings = config(envs=[LINE, OTHER_LINE], episodes=2, track=["listener"], workers=0)
    summary = evaluate(settings, agent_factory=ToZero)
    assert summary.state == "complete"
    assert sorted(min(metrics) for _, _, metrics in Listener.told) == [
        f"{LINE}/episodes", f"{OTHER_LINE}/episodes", "total/episodes"
    ]  # fmt: skip
    assert Listener.finished == ["policy"]
    assert {"code", "evaluation", "served"} == Listener.begun[0].config.keys()


def test_a_missing_package_is_an_error_before_anything_starts(config: Config) -> None:
    for use in (resolve, check):
        with pytest.raises(MissingDependency, match=r"pip install 'lab-trackers\[lacking\]'"):
            use(config(track=["lacking"]))


def test_an_unknown_tracker_is_an_error_with_the_registered_ones_before_anything_starts(
    config: Config,
) -> None:
    for use in (resolve, check):
        with pytest.raises(
            ConfigError,
            match=(
                r"expected one of .*, got 'listner', which is not registered; did you mean "
                r"'listener'"
            ),
        ):
            use(config(track=["listner"]))
