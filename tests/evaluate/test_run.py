from __future__ import annotations

import contextlib
import functools
import json
import signal
import socket
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import CLINGING, EVERY, LINE, Silent, Teller, ToZero, wait_for

from vlagents_ray.errors import ConfigError, ConnectionLost, ContractMismatch, UnknownEnv
from vlagents_ray.evaluate import (
    EvalConfig,
    EvaluationInterrupted,
    Progress,
    SuiteConfig,
    Summary,
    check,
    evaluate,
)
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.plan.resolved import ResolvedPlan, resolve
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.workers import pool, rollout
from vlagents_ray.evaluate.workers.cluster import ray_cluster
from vlagents_ray.interface import Agent

Config = Callable[..., EvalConfig]


def query(config: EvalConfig, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(config.out / "results.db")) as db:
        return db.execute(sql).fetchall()


def outcomes(config: EvalConfig) -> list[tuple[Any, ...]]:
    return query(
        config,
        "SELECT env, episode, seed, status, success_once, success_at_end, steps, episode_return, "
        "instruction FROM episodes ORDER BY env, episode",
    )


def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "WATCH_S", 0.1)
    monkeypatch.setattr(pool, "GRACE_S", 0.2)


def here(settings: EvalConfig, make: Callable[[], Agent] = ToZero) -> Summary:
    """Evaluate in this process."""
    return evaluate(settings.model_copy(update={"workers": 0}), agent_factory=make)


@pytest.mark.usefixtures("shared_ray")
class TestOnACluster:
    @pytest.mark.parametrize(
        ("kind", "error"),
        [  # test_in_process.py tests a simulator that raises
            ("exit", f"the worker on {socket.gethostname()} died"),
            ("hang", "env step after 3 steps took longer than 8 s"),
            ("freeze", "no sign of life"),
        ],
    )
    def test_a_broken_worker_costs_a_retry_and_no_failure(
        self, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str, error: str
    ) -> None:
        impatient(monkeypatch)
        trouble = {"folder": str(tmp_path), "trouble": {kind: [2]}}
        settings = config(workers=1, env_options=trouble, env_timeout_s=8, make_timeout_s=120)
        summary = evaluate(settings, agent_factory=ToZero)
        undisturbed = config(out=tmp_path / "undisturbed")
        here(undisturbed)
        assert outcomes(settings) == outcomes(undisturbed)
        assert (summary.total.retries, summary.total.infra_failures) == (1, 0)
        ((attempt, cause, text, stack, log),) = query(
            settings, "SELECT attempt, cause, error, traceback, log FROM attempts"
        )
        assert (attempt, cause) == (1, "worker")
        assert error in text
        assert f"misbehaving: {kind}" in log
        assert "_misbehave" in stack or kind != "hang", "the error shows the line of the hang"

    def test_a_policy_that_never_answers_is_an_infrastructure_failure(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        impatient(monkeypatch)
        settings = config(workers=1, episodes=1, retries=0, policy_timeout_s=4)
        summary = evaluate(settings, agent_factory=Silent)
        assert (summary.total.episodes, summary.total.infra_failures) == (0, 1)
        ((text,),) = query(settings, "SELECT error FROM episodes")
        assert "policy act after 0 steps took longer than 4 s" in text

    def test_a_signal_keeps_what_is_finished_and_leaves_no_worker(
        self, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        # Names of processes when Ray is disconnected, which takes long if Ray is also being stopped
        found: list[str] = []

        @contextlib.contextmanager
        def looking(plan: ResolvedPlan) -> Iterator[None]:
            with ray_cluster(plan):
                yield
                found.append(json.loads((plan.out / "summary.json").read_text())["state"])

        monkeypatch.setattr("vlagents_ray.evaluate.workers.cluster.ray_cluster", looking)

        class SignalAfterTwo(Progress):
            seen = 0

            def episode(self, case: EvalCase, result: EpisodeResult) -> None:
                self.seen += 1
                if self.seen == 2:
                    wait_for((tmp_path / "gate-0").exists)  # the other worker may start later
                    signal.raise_signal(signal.SIGTERM)

        options = {"folder": str(tmp_path), "trouble": {"gate": [0]}}
        handlers = [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)]
        with pytest.raises(EvaluationInterrupted, match="--resume") as stopped:
            evaluate(config(env_options=options), agent_factory=ToZero, progress=SignalAfterTwo())
        assert [signal.getsignal(one) for one in (signal.SIGINT, signal.SIGTERM)] == handlers
        assert stopped.value.summary.state == "interrupted"
        assert found == ["interrupted"]
        assert 2 <= stopped.value.summary.total.episodes < 6
        pid = (tmp_path / "gate-0").read_text()
        wait_for(lambda: not Path(f"/proc/{pid}").exists())
        summary = here(config(env_options=options, resume=True))
        assert summary.total.episodes == 6
        assert [row[1] for row in outcomes(config())] == list(range(6))

    def test_workers_start_with_pinned_threads_and_the_users_variables(
        self, config: Config
    ) -> None:
        runtime_env = config().worker.runtime_env
        env_vars = {**runtime_env["env_vars"], "LP_NUM_THREADS": "5", "EXTRA": "yes"}  # type: ignore[dict-item]
        evaluate(
            config(
                workers=1, episodes=1, threads=3, runtime_env={**runtime_env, "env_vars": env_vars}
            ),
            agent_factory=Teller,
        )
        ((status, text),) = query(config(), "SELECT status, error FROM episodes")
        assert status == "policy_error"
        assert "{'OMP_NUM_THREADS': '3', 'LP_NUM_THREADS': '5', 'EXTRA': 'yes'}" in text

    def test_a_cluster_without_room_is_told_so(self, config: Config) -> None:
        with pytest.raises(ConfigError, match=r"within 0\.5 s, .*lower `workers`"):
            evaluate(config(cpus_per_worker=64, place_timeout_s=0.5), agent_factory=ToZero)

    def test_a_worker_that_does_not_leave_makes_room_for_one_of_another_kind(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(pool, "CLOSE_S", 0.5)
        base = config(workers=1, cpus_per_worker=3, place_timeout_s=120)
        suites = [
            SuiteConfig(envs=[CLINGING], episodes=2),
            SuiteConfig(
                envs=[LINE], episodes=1, worker=base.worker.model_copy(update={"threads": 2})
            ),
        ]
        summary = evaluate(base.model_copy(update={"suites": suites}), agent_factory=ToZero)
        assert (summary.state, summary.total.episodes) == ("complete", 3)


def test_settings_can_be_checked_before_anything_is_served(config: Config) -> None:
    for refuse in (here, check):
        with pytest.raises(UnknownEnv, match="'nowhere', which is not registered"):
            refuse(config(envs=["nowhere"]))
        assert not config().out.exists()
    check(config())
    with Store(resolve(config())) as store:
        store.begin_run({})
    with pytest.raises(ConfigError, match="--resume"):
        check(config())


def test_a_policy_must_be_somewhere(config: Config) -> None:
    with pytest.raises(ConfigError, match="policy 'policy': expected the `url` of its server"):
        evaluate(config())


def test_lost_episodes_have_no_success_and_are_played_on_resume_and_a_finished_evaluation_plays_nothing(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "FIRST_WAIT_S", 0.001)
    summary = here(config(retries=1), functools.partial(ToZero, lost_on=4))
    assert (summary.total.episodes, summary.total.infra_failures, summary.total.retries) == (
        5,
        1,
        1,
    )
    row = query(
        config(),
        "SELECT status, success_once, success_at_end, attempts FROM episodes WHERE episode = 4",
    )
    assert row == [("infra_failed", None, None, 2)]
    mended = config(resume=True, accept_changes=True)
    summary = here(mended)
    assert (summary.total.episodes, summary.total.infra_failures) == (6, 0)
    assert query(config(), "SELECT run, COUNT(*) FROM episodes GROUP BY run") == [(1, 5), (2, 1)]
    before = outcomes(config())
    assert here(mended, Silent).total.episodes == 6
    assert outcomes(config()) == before


def test_many_lost_episodes_in_a_row_stop_the_evaluation(
    config: Config, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rollout, "FIRST_WAIT_S", 0.001)
    settings = config(episodes=50, retries=0, abort_after=3)
    with pytest.raises(ConnectionLost, match="3 episodes in a row lost to infrastructure"):
        here(settings, functools.partial(ToZero, lost_on=EVERY))
    assert len(outcomes(settings)) == 3
    assert json.loads((settings.out / "summary.json").read_text())["state"] == "stopped"
    assert "Not complete: stopped" in (settings.out / "report.html").read_text()


def test_a_contract_mismatch_stops_the_evaluation_before_any_step(config: Config) -> None:
    settings = config(env_options={"state_dim": 3})
    with pytest.raises(ContractMismatch, match="the policy needs 2 numbers, the env provides 3"):
        here(settings, functools.partial(ToZero, state_dim=2))
    assert outcomes(settings) == []
