from __future__ import annotations

import contextlib
import functools
import json
import os
import signal
import socket
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import av
import pytest
from eval_fakes import CLINGING, EVERY, LINE, OTHER_LINE, Silent, Teller, ToZero, wait_for

from vlagents_ray.errors import ConfigError, ConnectionLost, ContractMismatch, UnknownEnv
from vlagents_ray.evaluate import (
    EvalConfig,
    EvaluationInterrupted,
    Progress,
    SuiteConfig,
    check,
    evaluate,
)
from vlagents_ray.evaluate.episode.records import EpisodeResult
from vlagents_ray.evaluate.plan.cases import EvalCase
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.workers import pool, worker
from vlagents_ray.evaluate.workers.cluster import ray_cluster

Config = Callable[..., EvalConfig]


def query(config: EvalConfig, sql: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(config.out / "results.db")) as db:
        return db.execute(sql).fetchall()


def outcomes(config: EvalConfig) -> list[tuple[Any, ...]]:
    return query(
        config,
        "SELECT env, episode, seed, status, success_once, success_at_end, steps, episode_return, instruction"
        " FROM episodes ORDER BY env, episode",
    )


def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker, "WATCH_S", 0.1)
    monkeypatch.setattr(worker, "GRACE_S", 0.2)


@pytest.mark.usefixtures("shared_ray")
class TestOnACluster:
    def test_results_do_not_depend_on_the_number_of_workers(self, config: Config, tmp_path: Path) -> None:
        one = config(envs=[LINE, OTHER_LINE], episodes=8, workers=1, out=tmp_path / "one")
        two = config(envs=[LINE, OTHER_LINE], episodes=8, workers=2, out=tmp_path / "two")
        summary = evaluate(one, agent_factory=ToZero)
        evaluate(two, agent_factory=ToZero)
        assert outcomes(one) == outcomes(two)
        assert len(outcomes(one)) == 16
        assert {row[4] for row in outcomes(one)} == {0, 1}, "both outcomes occur, or the test shows nothing"
        assert (summary.state, summary.total.episodes, summary.total.steps) == ("complete", 16, 160)
        assert json.loads((one.out / "summary.json").read_text()) == json.loads(json.dumps(summary.to_json()))
        assert (
            f"{summary.total.success_once.successes / 16:.1%}".replace("%", " %")
            in (one.out / "report.html").read_text()
        )

    @pytest.mark.parametrize(
        ("kind", "error"),
        [
            ("raise", "the simulator exploded"),
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
        settings = config(env_options=trouble, env_timeout_s=8, make_timeout_s=120)
        summary = evaluate(settings, agent_factory=ToZero)
        undisturbed = config(out=tmp_path / "undisturbed")
        evaluate(undisturbed, agent_factory=ToZero)
        assert outcomes(settings) == outcomes(undisturbed)
        assert (summary.total.retries, summary.total.infra_failures) == (1, 0)
        ((attempt, cause, text, stack, log),) = query(
            settings, "SELECT attempt, cause, error, traceback, log FROM attempts"
        )
        assert (attempt, cause) == (1, "worker")
        assert error in text
        assert f"misbehaving: {kind}" in log
        assert "_misbehave" in stack or kind in ("exit", "freeze"), "a hang shows where"

    def test_a_worker_killed_in_an_episode_costs_a_retry_and_no_failure(self, config: Config, tmp_path: Path) -> None:
        settings = config(env_options={"folder": str(tmp_path), "trouble": {"gate": [3]}})
        mark = tmp_path / "gate-3"

        def kill() -> None:
            wait_for(mark.exists)
            os.kill(int(mark.read_text()), signal.SIGKILL)

        killer = threading.Thread(target=kill)
        killer.start()
        summary = evaluate(settings, agent_factory=ToZero)
        killer.join()
        assert (summary.total.episodes, summary.total.retries, summary.total.infra_failures) == (6, 1, 0)
        assert query(settings, "SELECT episode, attempts FROM episodes WHERE attempts > 1") == [(3, 2)]

    def test_a_policy_that_never_answers_is_an_infrastructure_failure(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        impatient(monkeypatch)
        settings = config(episodes=1, retries=0, policy_timeout_s=4)
        summary = evaluate(settings, agent_factory=Silent)
        assert (summary.total.episodes, summary.total.infra_failures) == (0, 1)
        ((text,),) = query(settings, "SELECT error FROM episodes")
        assert "policy act after 0 steps took longer than 4 s" in text

    def test_lost_episodes_have_no_success_and_are_played_on_resume(self, config: Config) -> None:
        summary = evaluate(config(retries=1), agent_factory=functools.partial(ToZero, lost_on=4))
        assert (summary.total.episodes, summary.total.infra_failures, summary.total.retries) == (5, 1, 1)
        row = query(config(), "SELECT status, success_once, success_at_end, attempts FROM episodes WHERE episode = 4")
        assert row == [("infra_failed", None, None, 2)]
        summary = evaluate(config(resume=True), agent_factory=ToZero)
        assert (summary.total.episodes, summary.total.infra_failures) == (6, 0)
        assert query(config(), "SELECT run, COUNT(*) FROM episodes GROUP BY run") == [(1, 5), (2, 1)]

    def test_many_lost_episodes_in_a_row_stop_the_evaluation(self, config: Config) -> None:
        settings = config(episodes=50, retries=0, abort_after=3, workers=1)
        with pytest.raises(ConnectionLost, match="3 episodes in a row lost to infrastructure"):
            evaluate(settings, agent_factory=functools.partial(ToZero, lost_on=EVERY))
        assert len(outcomes(settings)) == 3
        assert json.loads((settings.out / "summary.json").read_text())["state"] == "stopped"
        assert "Not complete: stopped" in (settings.out / "report.html").read_text()

    def test_a_contract_mismatch_stops_the_evaluation_before_any_step(self, config: Config) -> None:
        settings = config(env_options={"state_dim": 3})
        with pytest.raises(ContractMismatch, match="the policy needs 2 numbers, the env gives 3"):
            evaluate(settings, agent_factory=functools.partial(ToZero, state_dim=2))
        assert outcomes(settings) == []

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_keeps_what_is_finished_and_leaves_no_worker(
        self, config: Config, tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        found: list[str] = []  # when Ray is left, which takes long if it is being stopped as well

        @contextlib.contextmanager
        def looking(settings: EvalConfig) -> Iterator[None]:
            with ray_cluster(settings):
                yield
                found.append(json.loads((settings.out / "summary.json").read_text())["state"])

        monkeypatch.setattr("vlagents_ray.evaluate.run.ray_cluster", looking)

        class SignalAfterTwo(Progress):
            seen = 0

            def episode(self, cell: EvalCase, result: EpisodeResult) -> None:
                self.seen += 1
                if self.seen == 2:
                    wait_for((tmp_path / "gate-0").exists)  # the other worker may start later
                    signal.raise_signal(number)

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
        summary = evaluate(config(env_options=options, resume=True), agent_factory=ToZero)
        assert summary.total.episodes == 6
        assert [row[1] for row in outcomes(config())] == list(range(6))

    def test_a_finished_evaluation_is_resumed_without_starting_anything(self, config: Config) -> None:
        evaluate(config(), agent_factory=ToZero)
        before = outcomes(config())
        assert evaluate(config(resume=True), agent_factory=Silent).total.episodes == 6
        assert outcomes(config()) == before

    def test_videos_of_failed_episodes_are_kept(self, config: Config) -> None:
        settings = config(video="failures", env_options={"camera": [32, 48]})
        evaluate(settings, agent_factory=ToZero)
        rows = query(settings, "SELECT success_once, steps, videos FROM episodes")
        assert {row[0] for row in rows} == {0, 1}
        for success, steps, videos in rows:
            paths = json.loads(videos)
            assert len(paths) == (0 if success else 1)
            for path in paths:
                assert path.endswith("_failure_front.mp4")
                with av.open(settings.out / path) as container:
                    assert sum(1 for _ in container.decode(video=0)) == steps + 1

    def test_workers_start_with_pinned_threads_and_the_users_variables(self, config: Config) -> None:
        runtime_env = config().worker.runtime_env
        env_vars = {**runtime_env["env_vars"], "LP_NUM_THREADS": "5", "EXTRA": "yes"}  # type: ignore[dict-item]
        evaluate(config(episodes=1, threads=3, runtime_env={**runtime_env, "env_vars": env_vars}), agent_factory=Teller)
        ((status, text),) = query(config(), "SELECT status, error FROM episodes")
        assert status == "policy_error"
        assert "{'OMP_NUM_THREADS': '3', 'LP_NUM_THREADS': '5', 'EXTRA': 'yes'}" in text

    def test_a_cluster_without_room_is_told_so(self, config: Config) -> None:
        with pytest.raises(ConfigError, match=r"no room for a worker in 0\.5 s.*lower `workers`"):
            evaluate(config(cpus_per_worker=64, place_timeout_s=0.5), agent_factory=ToZero)

    def test_a_worker_that_does_not_leave_makes_room_for_one_of_another_kind(
        self, config: Config, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(pool, "CLOSE_S", 0.5)
        base = config(workers=1, cpus_per_worker=3, place_timeout_s=120)
        suites = [
            SuiteConfig(envs=[CLINGING], episodes=2),
            SuiteConfig(envs=[LINE], episodes=1, worker=base.worker.model_copy(update={"threads": 2})),
        ]
        summary = evaluate(base.model_copy(update={"suites": suites}), agent_factory=ToZero)
        assert (summary.state, summary.total.episodes) == ("complete", 3)


def test_an_unknown_env_is_refused_before_anything_starts(config: Config) -> None:
    with pytest.raises(UnknownEnv, match="'nowhere' is not registered"):
        evaluate(config(envs=["nowhere"]), agent_factory=ToZero)
    assert not config().out.exists()


def test_settings_can_be_checked_before_anything_is_served(config: Config) -> None:
    check(config())
    with pytest.raises(UnknownEnv):
        check(config(envs=["nowhere"]))
    with Store(config()) as store:
        store.begin_run(config(), {})
    with pytest.raises(ConfigError, match="--resume"):
        check(config())


def test_a_policy_must_be_somewhere(config: Config) -> None:
    with pytest.raises(ConfigError, match="policy 'policy': got no url"):
        evaluate(config())
