from __future__ import annotations

import json
import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, OTHER_LINE
from rich.console import Console

from vlagents_ray.chunking.timeliness import TimeShare
from vlagents_ray.evaluate import EvalConfig, Summary, compare, print_summary, synchronous_twin
from vlagents_ray.evaluate.artifacts.storage import versions
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EnvInfo, EpisodeResult
from vlagents_ray.evaluate.plan.cases import plan_cases
from vlagents_ray.evaluate.plan.jobs import plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.report.page import write_report
from vlagents_ray.evaluate.results.comparison import clock_gaps
from vlagents_ray.evaluate.results.reader import Results
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import summarize, write_summary

Config = Callable[..., EvalConfig]


@pytest.fixture
def summary(config: Config) -> Summary:
    """Return the summary of two environments with 3 planned episodes each: one finished except for
    a lost episode, the other begun.
    """
    settings = config(
        envs=[LINE, OTHER_LINE], episodes=3, policy="act", policy_url="http://localhost:1"
    )
    jobs = plan_jobs(plan_cases(settings))
    keys = [job.key for job in jobs]
    with Store(resolve(settings)) as store:
        store.begin_run(versions())
        store.note_env(jobs[0].case.place, EnvInfo({"simulator": "line"}, {}))
        store.note_policy("act", {"policy": "act", "checkpoint": "a"})
        store.record(
            EpisodeResult(
                keys[0],
                "done",
                True,
                False,
                steps=10,
                episode_return=2.0,
                seconds=1.0,
                transport="http",
                policy_ms=3.0,
            ),
            1,
        )
        store.record(
            EpisodeResult(
                keys[1],
                "policy_error",
                False,
                False,
                steps=2,
                episode_return=1.0,
                seconds=0.5,
                transport="http",
            ),
            2,
        )
        store.record_attempt(jobs[1], Failure("policy", "connection_lost", "gone"), retried=True)
        store.record_attempt(
            replace(jobs[2], attempt=4), Failure("worker", "env_failed", "hung"), retried=False
        )
        store.record(EpisodeResult(keys[2], "infra_failed", error="hung"), 4)
        store.record(
            EpisodeResult(
                keys[3],
                "done",
                True,
                True,
                steps=6,
                episode_return=3.0,
                seconds=1.0,
                transport="websocket",
            ),
            1,
        )
        store.end_run("interrupted")
    return summarize(Results.load(settings.out))


def test_infrastructure_failures_are_in_no_rate(summary: Summary) -> None:
    group = summary.cases[0]
    assert (group.planned, group.episodes, group.infra_failures, group.policy_errors) == (
        3,
        2,
        1,
        1,
    )
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
    assert (summary.env_busy, summary.policy_busy) == (None, None), "no episode reports it"


def test_a_summary_is_plain_json_with_all_that_made_it(summary: Summary) -> None:
    written = json.loads(write_summary(summary).read_text())
    assert written["state"] == "interrupted"
    assert [case["env"] for case in written["cases"]] == [LINE, OTHER_LINE]
    [total] = written["totals"]
    assert (total["policy_id"], total["env"]) == ("act", "total")
    assert "wilson_95" not in total["success_once"], "the evaluation is not complete"
    assert total["success_once"]["confidence_sequence"][0] < 0.2077
    assert total["success_once"]["confidence_sequence"][1] > 0.9385
    assert written["confidence_sequences"] == ["planned episodes have no result yet"]
    assert written["config"]["suites"][0]["episodes"] == 3
    assert written["policies"] == {"act": {"policy": "act", "checkpoint": "a"}}
    assert [case["described"] for case in written["cases"]] == [{"simulator": "line"}, {}]
    assert {"python", "ray", "numpy", "vlagents-ray", "code"} <= set(written["versions"][0])


def test_the_report_shows_rates_and_what_was_not_the_policys_fault(summary: Summary) -> None:
    text = printed(summary)
    # An episode is lost, and some of the plan have no result yet.
    assert "50% [6, 94]" in text
    assert "67% [0, 100]" in text
    assert "1 attempts lost to infrastructure and repeated" in text
    assert "1 episodes lost to infrastructure" in text
    assert "--resume" in text
    assert not any(word in text for word in ("report:", "busy")), "these lines must be absent"
    page = write_report(summary.results, Path(summary.out) / "report.html")
    assert f"report: {page}" in printed(summary)


def test_a_summary_says_how_busy_envs_and_policy_were(config: Config) -> None:
    settings = config(envs=[LINE], episodes=2, policy="act", policy_url="http://localhost:1")
    with Store(resolve(settings)) as store:
        store.begin_run(versions())
        for job in plan_jobs(store.cases):
            done = EpisodeResult(
                job.key,
                "done",
                True,
                True,
                steps=9,
                seconds=8.0,
                env_seconds=6.0,
                policy_seconds=1.0,
            )
            store.record(done, 1)
        store.end_run("complete")
    summary = summarize(Results.load(settings.out))
    assert summary.env_busy == pytest.approx(12 / 16)
    assert summary.policy_busy == pytest.approx(2 / summary.rollout_seconds)
    assert summary.to_json()["env_busy"] == summary.env_busy
    of_replica = f"{summary.policy_busy:.0%}"
    assert (
        f"envs busy for 75% of the workers' time, the policy for {of_replica} of one replica's"
        in printed(summary)
    )


def recorded(settings: EvalConfig, outcomes: dict[str, list[bool]], **fields: Any) -> Summary:
    """Return the summary of an evaluation with these outcomes by suite."""
    with Store(resolve(settings)) as store:
        store.begin_run(versions())
        for job in plan_jobs(store.cases):
            if job.key.episode < len(outcomes[job.case.suite.name]):
                success = outcomes[job.case.suite.name][job.key.episode]
                waited = fields if job.case.suite.clock else {}
                store.record(
                    EpisodeResult(job.key, "done", success, success, **{"steps": 10} | waited), 1
                )
        store.end_run("complete")
    return summarize(Results.load(settings.out))


def printed(summary: Summary) -> str:
    console = Console(file=StringIO(), width=200)
    print_summary(console, summary)
    return str(console.file.getvalue())  # type: ignore[attr-defined]


def in_real_time(
    out: Path, outcomes: dict[str, list[bool]], envs: Sequence[str] = (LINE,), **fields: Any
) -> tuple[Summary, str]:
    """Return the summary of suites of which only "waits" is synchronous, and its printed text."""
    suites = [
        {"name": name, "envs": list(envs), "episodes": len(solved)}
        | ({} if name == "waits" else {"clock": {"latency": 0.2}})
        | ({"env_options": {"state_dim": 2}} if name == "smaller" else {})
        for name, solved in outcomes.items()
    ]
    settings = EvalConfig.model_validate({"policies": [{}], "suites": suites, "out": out / "out"})
    summary = recorded(settings, outcomes, **fields)
    return summary, printed(summary)


def test_a_case_in_real_time_tells_its_gap_to_the_synchronous_one(tmp_path: Path) -> None:
    outcomes = {"waits": [True] * 4, "moves on": [True] + [False] * 3, "smaller": [True] * 4}
    summary, text = in_real_time(tmp_path, outcomes, ticks_waited=5)
    waits, moves, smaller = summary.results.cases
    assert synchronous_twin(summary.results, moves) is waits
    assert synchronous_twin(summary.results, waits) is None
    assert synchronous_twin(summary.results, smaller) is None, (
        "the suite differs in more than its clock"
    )
    assert [case["gap_to_synchronous"] for case in summary.to_json()["cases"]] == [
        None,
        -0.75,
        None,
    ]
    assert "policy, moves on in real time: -75.0 points to the synchronous score (" in text
    assert ", 4 pairs); 50% of its ticks waited for an answer" in text


def test_ticks_in_time_are_told_of_each_case_that_has_a_clock(tmp_path: Path) -> None:
    outcomes = {"waits": [True] * 4, "moves on": [True] * 4}
    figures = TimeShare(10, 2, 100.0, 200.0, 300.0)
    summary, text = in_real_time(tmp_path, outcomes, ticks_waited=5, **figures._asdict())
    in_time = {"ticks": 40, "starved": 8, "share": 0.8}
    in_time |= {"age_p50_ms": 100.0, "age_p95_ms": 200.0, "age_p99_ms": 300.0}
    cases = summary.to_json()["cases"]
    assert [case["time_share"] for case in cases] == [None, in_time]
    assert summary.to_json()["totals"][0]["time_share"] == in_time
    assert text.count("in time: ") == 1
    assert (
        f"policy moves on {LINE}: in time: 80.00% of 40 ticks of the policy; age of its actions "
        "p50 100 ms, p95 200 ms, p99 300 ms"
    ) in text
    [gap] = clock_gaps(summary.results)
    assert gap.to_json()["time_share_a"] == in_time
    assert gap.to_json()["time_share_b"] is None
    page = write_report(summary.results, tmp_path / "report.html").read_text()
    assert "80.00</td>" in page
    assert "Ticks in time do not apply to 1 case in which the env waits for the policy." in page


def test_a_comparison_has_the_ticks_in_time_of_both_policies(tmp_path: Path) -> None:
    policies = [{"name": name, "url": "http://localhost:1"} for name in ("a", "b")]
    suite = {"name": "moves on", "envs": [LINE], "episodes": 2, "clock": {"latency": 0.2}}
    settings = EvalConfig.model_validate(
        {"policies": policies, "suites": [suite], "out": tmp_path / "out"}
    )
    summary = recorded(settings, {"moves on": [True, False]}, ticks=10, starved=1)
    compared = compare(summary.results, "a", "b").to_json()
    for policy in ("a", "b"):
        figures = compared[f"time_share_{policy}"]
        assert (figures["ticks"], figures["starved"], figures["share"]) == (20, 2, 0.9)


def test_episodes_without_an_executed_row_have_no_age(tmp_path: Path) -> None:
    outcomes = {"moves on": [False] * 3}
    summary, text = in_real_time(tmp_path, outcomes, ticks=10, starved=10)
    assert summary.total.time_share == TimeShare(30, 30, None, None, None)
    assert ": in time: 0.00% of 30 ticks of the policy\n" in text
    page = write_report(summary.results, tmp_path / "report.html").read_text()
    assert "do not apply" not in page


def test_a_case_in_real_time_without_a_single_step_has_no_ticks_that_waited(tmp_path: Path) -> None:
    _, text = in_real_time(tmp_path, {"waits": [True] * 2, "moves on": [False] * 2}, steps=0)
    assert "in real time: -100.0 points to the synchronous score (" in text
    assert "; 0% of its ticks" in text


@pytest.mark.parametrize("seed", range(12))
def test_failures_that_waiting_would_have_saved_are_those_of_a_direct_count(
    tmp_path: Path, seed: int
) -> None:
    draw = random.Random(seed)
    likely = draw.choice([0.0, 0.3, 0.9, 1.0])
    outcomes = {
        "waits": [draw.random() < 0.9 for _ in range(draw.randint(1, 9))],
        "moves on": [draw.random() < likely for _ in range(draw.randint(1, 9))],
    }
    summary, text = in_real_time(tmp_path, outcomes)
    page = write_report(summary.results, tmp_path / "report.html").read_text()

    pairs = list(zip(outcomes["moves on"], outcomes["waits"], strict=False))
    failures = sum(not solved for solved, _ in pairs)
    saved = sum(not solved and synchronously for solved, synchronously in pairs)
    told = (
        f"policy, moves on in real time: {saved} of {failures} failures under delay were solved "
        "synchronously on the same starts"
    )
    assert (told in text) == (failures > 0)
    assert (told.replace("1 failures", "1 failure") in page) == (failures > 0)
    if not failures:
        assert "under delay" not in text + page


def test_each_latency_is_paired_with_the_one_synchronous_suite(tmp_path: Path) -> None:
    outcomes = {"waits": [True] * 4, "moves on": [True] + [False] * 3, "late": [False] * 4}
    clocks = {"moves on": 0.1, "late": 0.3}
    suites = [
        {"name": name, "envs": [LINE], "episodes": 4}
        | ({"clock": {"latency": clocks[name]}} if name in clocks else {})
        for name in outcomes
    ]
    config = {"policies": [{}], "suites": suites, "out": tmp_path / "out"}
    text = printed(recorded(EvalConfig.model_validate(config), outcomes))
    assert "policy, moves on in real time: 3 of 3 failures under delay" in text
    assert "policy, late in real time: 4 of 4 failures under delay" in text


def test_console_report_and_summary_tell_the_same_gap(tmp_path: Path) -> None:
    # Two of the six synchronous episodes have no pair: the rates differ by -60 points, the pairs by
    # -50.
    outcomes = {"waits": [True] * 3 + [False] + [True] * 2, "moves on": [True] + [False] * 3}
    summary, text = in_real_time(tmp_path, outcomes, [LINE, OTHER_LINE])
    assert [case["gap_to_synchronous"] for case in summary.to_json()["cases"]] == [
        None,
        None,
        -0.5,
        -0.5,
    ]
    assert "moves on in real time: -50.0 points to the synchronous score (" in text
    assert ", 8 pairs)" in text
    page = write_report(summary.results, tmp_path / "report.html").read_text()
    assert "<strong>\N{MINUS SIGN}50.0</strong>" in page


def test_real_time_and_synchronous_episodes_are_in_no_rate_together(tmp_path: Path) -> None:
    summary, text = in_real_time(tmp_path, {"waits": [True] * 4, "moves on": [False] * 4})
    [total] = summary.to_json()["totals"]
    assert (total["success_once"]["rate"], total["episodes"]) == (None, 8)
    assert "50%" not in text
    assert "total synchronous" in text
    page = write_report(summary.results, tmp_path / "report.html").read_text()
    assert ">50.0" not in page
    assert "solved, synchronous" in page
    assert ">100.0" in page, "the rate of synchronous episodes"
    assert ">0.0" in page, "the rate of real-time episodes"


def test_cases_that_stopped_after_different_numbers_have_no_rate_in_common(
    config: Config, tmp_path: Path
) -> None:
    settings = config(envs=[LINE, OTHER_LINE], episodes=40, stop={"target": 0.5, "at_least": 5})
    alike = recorded(settings.model_copy(update={"out": tmp_path / "alike"}), {"": [True] * 12})
    assert {case.stopped_at for case in alike.results.cases} != {None}
    assert alike.totals[0].success_once.rate == 1.0
    with Store(resolve(settings)) as store:
        store.begin_run({})
        # One task is always solved, the other in every second episode.
        for job in plan_jobs(store.cases):
            success = job.case.env == LINE or bool(job.key.episode % 2)
            if job.case.env == OTHER_LINE or job.key.episode < 12:
                store.record(
                    EpisodeResult(job.key, "done", success, success, first_success=3, steps=9), 1
                )
        store.end_run("complete")
    summary = summarize(Results.load(settings.out))
    first, second = summary.results.cases
    assert first.stopped_at is not None
    assert second.stopped_at is None
    [total] = summary.to_json()["totals"]
    assert total["success_once"]["rate"] is None
    assert total["success_once"]["confidence_sequence"] == [0.0, 1.0]
    assert "have no common rate" in printed(summary)
    page = write_report(summary.results, tmp_path / "report.html").read_text()
    assert "50.0 to 100.0 %" in page  # range of the tasks' rates, in the headline
    pooled = 100 * (first.stopped_at + 20) / (first.stopped_at + 40)
    assert f"{pooled:.1f}" not in page


def test_a_case_that_stopped_early_says_after_how_many_and_at_which_error_rate(
    config: Config,
) -> None:
    settings = config(episodes=40, stop={"target": 0.5, "error_rate": 0.01})
    summary = recorded(settings, {"": [True] * 20})
    [case] = summary.to_json()["cases"]
    at = case["stopped_at"]
    assert 5 < at < 20
    assert case["success_once"]["confidence_sequence"][0] > 0.5
    assert (case["success_once"]["error_rate"], case["episodes"], case["planned"]) == (0.01, at, 40)
    text = printed(summary)
    assert f"stopped after {at} of 40 (error rate 1 %)" in text
    assert "Wilson" not in text


@pytest.mark.parametrize(
    ("versions", "says"),
    [
        ([(None, None), (None, None)], None),
        ([(0, 0), (0, 0)], None),
        ([(3, 3), (3, 3)], "version 3 (digest 3)"),
        ([(0, 0), (2, 3)], "versions 0 to 3 in turn"),
    ],
)
def test_pushed_weights_are_named_with_the_checkpoint(
    config: Config, versions: list[tuple[int | None, int | None]], says: str | None
) -> None:
    settings = config(envs=[LINE], episodes=2, policy="act")
    with Store(resolve(settings)) as store:
        store.begin_run({})
        for job, (first, last) in zip(plan_jobs(plan_cases(settings)), versions, strict=True):
            done = EpisodeResult(
                job.key, "done", True, True, first_policy_version=first, policy_version=last
            )
            store.record(replace(done, policy_fingerprint=f"digest {last}"), 1)
    summary = summarize(Results.load(settings.out))
    assert summary.to_json()["cases"][0]["pushed_weights"] == says
    page = write_report(summary.results, settings.out / "report.html").read_text()
    printed = StringIO()
    print_summary(Console(file=printed, width=200), summary)
    for shown in (page, printed.getvalue()):
        assert ("version" in shown) >= (says is not None)
        assert says is None or says in shown
