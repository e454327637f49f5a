from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path

import pytest
from eval_fakes import LINE, OTHER_LINE
from rich.console import Console

from vlagents_ray.evaluate import EvalConfig, Summary, print_summary
from vlagents_ray.evaluate.cells import cells
from vlagents_ray.evaluate.episode import EpisodeResult
from vlagents_ray.evaluate.jobs import plan
from vlagents_ray.evaluate.provenance import versions
from vlagents_ray.evaluate.results import Results
from vlagents_ray.evaluate.rollout import Failure, Made
from vlagents_ray.evaluate.store import Store
from vlagents_ray.evaluate.summary import summarize, write_summary

Config = Callable[..., EvalConfig]


@pytest.fixture
def summary(config: Config) -> Summary:
    """Two envs with 3 planned episodes each: one finished but for a lost episode, one begun."""
    settings = config(envs=[LINE, OTHER_LINE], episodes=3, policy="act", policy_url="http://localhost:1")
    jobs = plan(cells(settings))
    keys = [job.key for job in jobs]
    with Store(settings) as store:
        store.begin_run(settings, versions())
        store.note_env(jobs[0].cell.place, Made({"simulator": "line"}, {}))
        store.note_policy("act", {"policy": "act", "checkpoint": "a"})
        store.record(
            EpisodeResult(
                keys[0], "done", True, False, steps=10, episode_return=2.0, seconds=1.0, transport="http", policy_ms=3.0
            ),
            1,
        )
        store.record(
            EpisodeResult(
                keys[1], "policy_error", False, False, steps=2, episode_return=1.0, seconds=0.5, transport="http"
            ),
            2,
        )
        store.record_attempt(jobs[1], Failure("policy", "connection_lost", "gone"), retried=True)
        store.record_attempt(replace(jobs[2], attempt=4), Failure("worker", "env_failed", "hung"), retried=False)
        store.record(EpisodeResult(keys[2], "infra_failed", error="hung"), 4)
        store.record(
            EpisodeResult(keys[3], "done", True, True, steps=6, episode_return=3.0, seconds=1.0, transport="websocket"),
            1,
        )
        store.end_run("interrupted")
    return summarize(Results.load(settings.out))


def test_infrastructure_failures_are_in_no_rate(summary: Summary) -> None:
    group = summary.cells[0]
    assert (group.planned, group.episodes, group.infra_failures, group.policy_errors) == (3, 2, 1, 1)
    assert (group.success_once.successes, group.success_at_end.successes) == (1, 0)
    assert (group.success_once.rate, group.mean_steps, group.mean_return) == (0.5, 6.0, 1.5)
    assert group.retries == 1


def test_the_total_counts_all_envs(summary: Summary) -> None:
    total = summary.total
    assert (total.planned, total.episodes, total.steps, total.retries) == (6, 3, 18, 1)
    assert (total.success_once.successes, total.success_at_end.successes) == (2, 1)
    assert total.policy_ms == 3.0
    assert summary.transports == ["http", "websocket"]
    assert summary.steps_per_second == pytest.approx(18 / summary.wall_seconds)


def test_a_summary_is_plain_json_with_all_that_made_it(summary: Summary) -> None:
    written = json.loads(write_summary(summary).read_text())
    assert written["state"] == "interrupted"
    assert [cell["env"] for cell in written["cells"]] == [LINE, OTHER_LINE]
    [total] = written["totals"]
    assert (total["contender"], total["env"]) == ("act", "total")
    assert total["success_once"]["wilson_95"] == pytest.approx([0.2077, 0.9385], abs=1e-4)
    assert written["config"]["suites"][0]["episodes"] == 3
    assert written["policies"] == {"act": {"policy": "act", "checkpoint": "a"}}
    assert [cell["described"] for cell in written["cells"]] == [{"simulator": "line"}, {}]
    assert {"python", "ray", "numpy", "vlagents-ray", "code"} <= set(written["versions"])


def test_a_summary_replaces_the_one_before_whole(summary: Summary) -> None:
    write_summary(summary)
    write_summary(summary)
    assert not list(Path(summary.out).glob("*.part"))


def test_the_report_shows_rates_and_what_was_not_the_policys_fault(summary: Summary) -> None:
    console = Console(file=StringIO(), width=100)
    print_summary(console, summary)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "50% [9, 91]" in text
    assert "67% [21, 94]" in text
    assert "1 attempts lost to infrastructure and repeated" in text
    assert "1 episodes lost to infrastructure" in text
    assert "--resume" in text
