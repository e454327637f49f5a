"""An evaluation in the caller's process."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any, ClassVar

import pytest
from eval_fakes import LINE, OTHER_LINE, ToZero
from in_process_evaluation import flat_config

from vlagents_ray import Act, Agent, Obs
from vlagents_ray.errors import ClusterLost, ConfigError, EnvFailed
from vlagents_ray.evaluate import EvalConfig, EvaluationInterrupted, Summary, evaluate, run
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.plan import resolved
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import Job
from vlagents_ray.evaluate.workers import in_process, rollout
from vlagents_ray.evaluate.workers.in_process import InProcessWorkers
from vlagents_ray.evaluate.workers.rollout import Report
from vlagents_ray.serve.config.deployment import ServerArgs
from vlagents_ray.serve.local_agent import LocalPolicy
from vlagents_ray.signals import StopRequest

Config = Callable[..., EvalConfig]


def outcomes(summary: Summary) -> list[dict[str, Any]]:
    return [one.result.outcome for case in summary.results.cases for one in case.episodes]


def test_its_episodes_are_those_of_workers(
    config: Config, tmp_path: Path, shared_ray: None
) -> None:
    envs = {"envs": [LINE, OTHER_LINE]}
    usual = evaluate(config(**envs, out=tmp_path / "usual"), agent_factory=ToZero)
    here = evaluate(config(**envs, workers=0), agent_factory=ToZero)
    assert outcomes(here) == outcomes(usual)
    assert {worker.pid for worker in here.results.workers} == {os.getpid()}
    assert os.getpid() not in {worker.pid for worker in usual.results.workers}


def test_it_is_one_worker_without_ray(config: Config) -> None:
    summary = evaluate(config(workers=0), agent_factory=ToZero)
    assert (summary.state, summary.total.episodes) == ("complete", 6)
    assert [worker.pid for worker in summary.results.workers] == [os.getpid()]
    assert json.loads((summary.out / "summary.json").read_text()) == json.loads(
        json.dumps(summary.to_json())
    )
    rate = summary.total.success_once.successes / 6
    assert 0 < rate < 1
    assert f"{100 * rate:.1f} %" in (summary.out / "report.html").read_text()


@pytest.mark.parametrize(
    ("changes", "workers"),
    [
        ({}, 0),
        ({"workers": 3}, 3),
        ({"episodes": 33}, 0),
        ({"episodes": 34}, 1),
        ({"episodes": 34, "env_options": {"max_steps": 10}}, 0),
        ({"gpus_per_worker": 0.5}, 1),
        ({"policy_url": "serve://pi0"}, 1),
        ({"runtime_env": {"pip": ["einops"]}}, 1),
    ],
)
def test_a_short_evaluation_that_needs_no_ray_has_no_workers(
    changes: dict[str, Any], workers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setattr(resolved, "node_of_this_process", lambda: None)
    config = flat_config(envs=[LINE], out="out", **changes)
    assert resolved.chosen_workers(config, plan_cases(config)) == workers


def test_a_process_in_a_cluster_plays_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "10.0.0.1:6379")
    assert resolved.resolve(flat_config(envs=[LINE], out="out")).workers == 1


def test_a_second_evaluation_of_a_process_reads_the_state_of_its_code_from_memory(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = evaluate(config(workers=0, out=tmp_path / "first"), agent_factory=ToZero)
    commands = []
    start = subprocess.Popen.__init__

    def noted(self: Any, args: Any, *rest: Any, **options: Any) -> None:
        commands.append(args)
        start(self, args, *rest, **options)

    monkeypatch.setattr(subprocess.Popen, "__init__", noted)
    second = evaluate(config(workers=0, out=tmp_path / "second"), agent_factory=ToZero)
    assert commands == []
    assert second.results.runs[0].versions == first.results.runs[0].versions


def test_it_goes_on_with_what_has_no_result(config: Config) -> None:
    evaluate(config(workers=0), agent_factory=ToZero, only=(2, 2))
    with pytest.raises(ConfigError, match="already has results"):
        evaluate(config(workers=0), agent_factory=ToZero)
    summary = evaluate(config(workers=0, resume=True), agent_factory=ToZero)
    assert [one.run for case in summary.results.cases for one in case.episodes] == [
        2,
        2,
        1,
        2,
        2,
        2,
    ]


def test_a_simulator_that_breaks_is_made_again_and_its_episode_repeated(
    config: Config, tmp_path: Path
) -> None:
    trouble = {"folder": str(tmp_path), "trouble": {"raise": [2]}}
    summary = evaluate(config(env_options=trouble, workers=0), agent_factory=ToZero)
    with closing(sqlite3.connect(summary.out / "results.db")) as db:
        assert db.execute("SELECT episode FROM episodes WHERE attempts = 2").fetchall() == [(2,)]
    assert len(summary.results.workers) == 2, "one worker for each simulator"
    whole = evaluate(config(out=tmp_path / "whole", workers=0), agent_factory=ToZero)
    assert [one | {"key": 0} for one in outcomes(summary)] == [
        one | {"key": 0} for one in outcomes(whole)
    ]


def test_suites_whose_workers_differ_have_their_turns(config: Config) -> None:
    [suite] = config(episodes=2).suites
    other = suite.model_copy(
        update={"envs": [OTHER_LINE], "worker": config(cpus_per_worker=2.0).worker}
    )
    both = config(workers=0).model_copy(update={"suites": [suite, other]})
    assert evaluate(both, agent_factory=ToZero).total.episodes == 4


@pytest.mark.parametrize("cluster_is_lost", [False, True])
def test_what_a_signal_to_the_whole_group_ends_first_costs_no_attempt(
    config: Config, cluster_is_lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    class EndedFirst(InProcessWorkers):
        def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
            waiting = [job for one in self._workers for job in one.jobs]
            reports = [*super().wait(timeout_s)]
            if waiting and waiting[0].key.episode == 2:
                # The signal arrives during this wait.
                threading.Timer(0.02, os.kill, (os.getpid(), signal.SIGTERM)).start()
                if cluster_is_lost:
                    raise ClusterLost("no head")
                reports = [
                    (job, Report(failure=Failure("worker", EnvFailed.code, "killed")))
                    for job in waiting
                ]
            yield from reports

    monkeypatch.setattr(in_process, "InProcessWorkers", EndedFirst)
    with pytest.raises(EvaluationInterrupted) as stopped:
        evaluate(config(workers=0), agent_factory=ToZero)
    assert stopped.value.summary.total.episodes == 2
    with closing(sqlite3.connect(config().out / "results.db")) as db:
        assert db.execute("SELECT count(*) FROM attempts").fetchone() == (0,)


def test_failures_that_come_together_wait_for_a_signal_once(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lost policy fails an episode of each environment at once. All workers wait for a signal
    together, only once.
    """
    once, limits, wait = [True], [], StopRequest.wait

    class FailsOnce(InProcessWorkers):
        def free_slot(self) -> bool:
            return len(self._workers) < 3

        def wait(self, timeout_s: float) -> Iterator[tuple[Job, Report]]:
            reports = [*super().wait(timeout_s)]
            for job, report in reports:
                yield (
                    job,
                    Report(failure=Failure("policy", "unavailable", "gone")) if once[0] else report,
                )
            once[0] = once[0] and not reports

    def waited(stop: StopRequest, timeout_s: float) -> bool:
        limits.append(timeout_s)
        return wait(stop, timeout_s)

    monkeypatch.setattr(StopRequest, "wait", waited)
    monkeypatch.setattr(run, "SIGNAL_S", 0.0123)
    monkeypatch.setattr(in_process, "InProcessWorkers", FailsOnce)
    summary = evaluate(config(workers=0), agent_factory=ToZero)
    assert summary.total.episodes == 6
    with closing(sqlite3.connect(summary.out / "results.db")) as db:
        assert db.execute("SELECT count(*) FROM attempts").fetchone() == (3,)
    assert limits.count(0.0123) == 1


READ = """
import sys
for name in ("jinja2", "ray", "rich", "torch"):
    sys.modules[name] = None  # as if it were not installed
from vlagents_ray.evaluate import Results, compare
results = Results.load(sys.argv[1])
print(sum(len(case.episodes) for case in results.cases))
"""


def test_results_are_read_without_ray(config: Callable[..., EvalConfig]) -> None:
    summary = evaluate(config(workers=0), agent_factory=ToZero)
    command = [sys.executable, "-W", "error", "-c", READ, str(summary.out)]
    told = subprocess.run(command, check=False, capture_output=True, text=True, timeout=60)
    assert told.returncode == 0, told.stderr
    assert told.stdout.strip() == str(summary.total.episodes)


class Slow(ToZero):
    """A policy whose actions take longer than the limit."""

    def act(self, obs: Obs) -> Act:
        time.sleep(0.5)
        return super().act(obs)


@pytest.mark.slow
def test_a_call_that_exceeds_its_limit_is_reported_with_its_line(
    config: Config, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(in_process, "_LOOK_S", 0.01)
    monkeypatch.setattr(rollout, "LONG_S", 0.01)
    evaluate(config(episodes=1, workers=0, policy_timeout_s=0.1), agent_factory=Slow)
    [first, *_] = [
        record.getMessage() for record in caplog.records if "may hang" in record.getMessage()
    ]
    assert "policy act after 0 steps has taken longer than 0.1 s" in first
    assert "time.sleep(0.5)" in first


def test_a_policy_that_ends_the_process_fails_its_episode_only(config: Config) -> None:
    before = os._exit

    class Ending(ToZero):
        def act(self, obs: Obs) -> Act:
            os._exit(0)

    summary = evaluate(config(episodes=1, workers=0), agent_factory=Ending)
    errors = [one.result.error or "" for case in summary.results.cases for one in case.episodes]
    assert errors
    assert all("os._exit(0) was called (test_in_process.py:" in error for error in errors)
    assert os._exit is before


class OneAtATime(ToZero):
    """A policy that fails if another one is in memory when it is loaded."""

    loaded: ClassVar[weakref.WeakSet[OneAtATime]] = weakref.WeakSet()
    events: ClassVar[list[str]] = []

    def __init__(self, checkpoint_step: int) -> None:
        super().__init__()
        self.step = checkpoint_step
        # A reference cycle, as in real policies: only garbage collection frees the policy.
        self.itself = self

    def initialize(self) -> None:
        assert len(self.loaded) == 0
        self.loaded.add(self)
        self.events.append(f"load {self.step}")

    def reset(self, obs: Obs, instruction: str | None, **kwargs: Any) -> dict[str, Any]:
        self.events.append(f"reset {self.step}")
        return super().reset(obs, instruction, **kwargs)

    def close(self) -> None:
        self.events.append(f"close {self.step}")


def local_policy(checkpoint_step: int) -> LocalPolicy:
    """Return the policy as `vlagents-ray eval` runs it in this process."""
    args = ServerArgs(policy=f"{__name__}:OneAtATime")
    return LocalPolicy(args, {"checkpoint_step": checkpoint_step})


@pytest.mark.parametrize("make", [OneAtATime, local_policy])
def test_a_checkpoint_is_closed_and_freed_before_the_next_one_is_loaded(
    config: Config, make: Callable[..., Agent]
) -> None:
    OneAtATime.events.clear()
    plan = config(episodes=2, steps=[10, 20], workers=0)
    assert evaluate(plan, agent_factory=make).total.episodes == 4
    # The next round of `--watch` is another evaluation.
    plan = config(episodes=2, steps=[30], workers=0, out=plan.out.with_name("later"))
    assert evaluate(plan, agent_factory=make).total.episodes == 2
    expected = []
    for step in (10, 20, 30):
        expected += [f"load {step}", f"reset {step}", f"reset {step}", f"close {step}"]
    assert OneAtATime.events == expected
