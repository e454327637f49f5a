"""The progress of a running evaluation, in a document of its recorded results, in a terminal, and
in a log.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from in_process_evaluation import flat_config
from recorded_results import HOSTILE, record, runs
from rich.console import Console

from vlagents_ray.evaluate import Rate, Results, progress_for
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult, Status
from vlagents_ray.evaluate.plan.cases import EvalCase, plan_cases
from vlagents_ray.evaluate.plan.config import EvalConfig
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job, plan_jobs
from vlagents_ray.evaluate.plan.resolved import resolve
from vlagents_ray.evaluate.report import results_document, terminal
from vlagents_ray.evaluate.report.results_document import ProgressDocument, ResultsDocument
from vlagents_ray.evaluate.report.terminal import LineProgress, LiveProgress, Progress
from vlagents_ray.evaluate.results.reader import rate_of
from vlagents_ray.evaluate.results.store import Store
from vlagents_ray.evaluate.results.summary import summarize


@pytest.fixture(autouse=True)
def at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results_document, "_EVERY_S", 0.0)
    monkeypatch.setattr(results_document, "_SHARE", float("inf"))


def read(document: ResultsDocument) -> dict[str, Any]:
    """Return the document as a browser receives it."""
    found: dict[str, Any] = json.loads(json.dumps(document.read(), allow_nan=False))
    return found["evaluation"]


class Played:
    """An evaluation of four episodes in one case, whose results are recorded one by one."""

    def __init__(self, out: Path, document: ProgressDocument, **changes: Any) -> None:
        self.config = runs(out, episodes=4, **changes)
        self.document = document
        self.store = Store(resolve(self.config))
        self.jobs = plan_jobs(self.store.cases)
        self.store.begin_run({})
        document.begin(self.store.cases, {}, len(self.jobs))

    def play(self, job: Job, solved: bool | None, status: Status = "done") -> None:
        result = EpisodeResult(job.key, status, solved, solved, steps=5, instruction="go")
        self.store.record(result, 1)
        self.document.episode(job.case, result)

    def end(self, state: str) -> None:
        self.store.end_run(state)
        self.document.end()


@pytest.fixture
def document(tmp_path: Path) -> ProgressDocument:
    return ProgressDocument(tmp_path)


@pytest.fixture
def played(tmp_path: Path, document: ProgressDocument) -> Iterator[Played]:
    one = Played(tmp_path, document, steps=[1000])
    yield one
    one.store.close()


def test_it_is_empty_before_there_are_results(tmp_path: Path) -> None:
    said = read(ProgressDocument(tmp_path / "later"))
    assert (said["name"], said["state"], said["cases"], said["failures"]) == (
        "later",
        "starting",
        [],
        [],
    )


def test_cases_fill_with_their_intervals(document: ProgressDocument, played: Played) -> None:
    first = played.jobs[0]
    before = read(document)
    assert (before["state"], before["done"], before["planned"], before["ends"]) == (
        "running",
        0,
        24,
        None,
    )
    for job, solved in zip(played.jobs, (True, False, True), strict=False):
        played.play(job, solved)
    said = read(document)
    assert said["done"] == 3
    [case] = [one for one in said["cases"] if one["done"]]
    rate = rate_of([Results.load(played.config.out).cases[0]], "success_once")
    assert (case["policy"], case["task"]) == (first.case.policy_id, f"one {first.key.env}")
    assert (case["successes"], case["episodes"], case["rate"]) == (2, 3, rate.rate)
    assert (case["low"], case["high"]) == rate.interval
    assert {one["rate"] for one in said["cases"] if not one["done"]} == {None}


def test_the_time_left_is_that_of_the_episodes_to_come(
    document: ProgressDocument, played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    for job in played.jobs[:4]:
        played.play(job, True)
    [run] = Results.load(played.config.out).runs
    monkeypatch.setattr(results_document.time, "time", lambda: run.started + 40)
    assert read(document)["ends"] == pytest.approx(run.started + 40 + 40 / 4 * 20)


def test_failures_come_newest_first_with_what_went_wrong(
    document: ProgressDocument, played: Played
) -> None:
    a, b, c, d = played.jobs[:4]
    played.play(a, True)
    played.play(b, False)
    played.play(c, False, "policy_error")
    document.retry(d, Failure("worker", "env_failed", "it exploded"))
    played.play(d, None, "infra_failed")
    said = read(document)
    assert [one["episode"] for one in said["failures"]] == [3, 2, 1]
    assert [one["outcome"] for one in said["failures"]] == [
        "infra_failed",
        "policy_error",
        "failure",
    ]
    assert said["failed"] == 3
    [case] = [one for one in said["cases"] if one["done"]]
    # episodes that infrastructure lost are in no rate
    assert (case["done"], case["episodes"]) == (4, 3)


@pytest.mark.parametrize(
    ("state", "reason", "said"),
    [
        ("complete", None, "complete"),
        ("interrupted", None, "interrupted"),
        ("running", "the disk is full", "stopped"),
    ],
)
def test_it_says_how_the_evaluation_ended(
    document: ProgressDocument, played: Played, state: str, reason: str | None, said: str
) -> None:
    played.end(state)
    assert read(document)["state"] == state
    if reason is not None:
        document.fail(reason)
    document.close()
    found = read(document)
    assert (found["state"], found.get("reason") or None) == (said, reason)


def test_a_training_waits_between_its_versions_and_has_a_learning_curve(tmp_path: Path) -> None:
    document = ProgressDocument(tmp_path, goes_on=True)
    for step in (1000, 2000):
        learner = {"name": "learner", "url": "http://localhost:1", "steps": [step]}
        config = runs(tmp_path, policies=[learner], resume=step == 2000)
        document.begin(plan_cases(config), {}, len(plan_jobs(plan_cases(config))))
        record(config)
        document.end()
        assert read(document)["state"] == "waiting"
    said = read(document)
    [curve] = said["curves"]
    assert curve["policy"] == "learner"
    assert [point["step"] for point in curve["points"]] == [1000, 2000]
    totals = {
        group.policy_id: group.success_once for group in summarize(Results.load(tmp_path)).totals
    }
    assert [point["rate"] for point in curve["points"]] == [
        totals[f"learner@{step}"].rate for step in (1000, 2000)
    ]
    assert all(
        point["whole"] and point["low"] < point["rate"] < point["high"] for point in curve["points"]
    )
    document.close()
    assert read(document)["state"] == "complete"


def test_videos_are_found_by_number_alone(tmp_path: Path) -> None:
    record(runs(tmp_path, episodes=2), videos=True)
    document = ProgressDocument(tmp_path)
    assert document.video(0) is None  # no document that names the video has been read yet
    failures = read(document)["failures"]
    assert HOSTILE in failures[0]["instruction"]
    for one in failures:
        [number] = one["videos"]
        path = document.video(number)
        assert path is not None
        assert path.is_relative_to(tmp_path.resolve() / "videos")
        assert f"ep{one['episode']:04d}_seed{one['seed']}_failure" in path.name
    assert document.video(-1) is document.video(len(failures)) is None
    [number] = failures[0]["videos"]
    path = document.video(number)
    assert path is not None
    path.unlink()
    assert document.video(number) is None
    path.symlink_to("/etc/hostname")  # as in a folder that another user created
    assert document.video(number) is None


def test_the_results_are_read_for_a_share_of_the_time_at_most(
    document: ProgressDocument, played: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = document.read()
    monkeypatch.setattr(results_document, "_EVERY_S", 1e9)
    played.play(played.jobs[0], True)
    assert document.read() is before
    played.end("complete")  # the end must always be shown
    assert document.read() is not before


def test_calls_reach_the_terminal_too(tmp_path: Path) -> None:
    terminal = Mock(Progress)
    document = ProgressDocument(tmp_path, terminal)
    one = Played(tmp_path, document)
    one.play(one.jobs[0], True)
    document.retry(one.jobs[1], Failure("worker", "env_failed", "it exploded"))
    document.stopped(one.jobs[1].case, 1, 3)
    one.end("complete")
    one.store.close()
    assert [call[0] for call in terminal.method_calls] == [
        "begin",
        "episode",
        "retry",
        "stopped",
        "end",
    ]


def test_cases_that_may_stop_early_have_a_confidence_sequence(tmp_path: Path) -> None:
    config = EvalConfig.model_validate(
        runs(tmp_path, steps=[1000], episodes=40).model_dump()
        | {"stop": {"width": 0.9, "at_least": 5}}
    )
    record(config, lambda _case, _seed: 3)
    found = read(ProgressDocument(tmp_path))["cases"]
    assert all(case["sequence"] and case["stopped"] for case in found)
    assert all(case["done"] == case["planned"] < 40 for case in found)


def test_a_folder_that_another_process_writes_says_how_its_last_run_stands(tmp_path: Path) -> None:
    followed = ResultsDocument(tmp_path)
    assert read(followed)["state"] == "starting"
    (tmp_path / "results.db").touch()  # the file is just being created
    assert read(followed)["state"] == "starting"
    (tmp_path / "results.db").unlink()
    one = Played(tmp_path, ProgressDocument(tmp_path))
    one.play(one.jobs[0], False)
    said = read(followed)
    assert (said["state"], said["done"], len(said["failures"])) == ("running", 1, 1)
    assert said["ends"] is not None
    one.end("interrupted")
    one.store.close()
    assert read(followed)["state"] == "interrupted"


RETRY = Failure("worker", "env_failed", "the simulator exploded\nwith a long story")


def planned(episodes: int) -> EvalCase:
    [case] = plan_cases(flat_config(envs=["tabletop"], episodes=episodes, out="out"))
    return case


TEN = planned(10)


def key(i: int) -> EpisodeKey:
    return EpisodeKey("tabletop", i, i, TEN.fingerprint)


def result(i: int, success: bool | None, status: Status = "done") -> EpisodeResult:
    return EpisodeResult(key(i), status, success, success, steps=5)


def shown(progress: Progress, out: StringIO) -> str:
    progress.begin([TEN], {TEN.fingerprint: Rate(2, 4)}, 6)
    progress.episode(TEN, result(4, True))
    progress.retry(Job(key(5), TEN), RETRY)
    progress.episode(TEN, result(5, False))
    progress.episode(TEN, result(6, None, "infra_failed"))
    progress.end()
    return out.getvalue()


def test_a_terminal_gets_a_live_table_and_a_log_gets_lines() -> None:
    assert isinstance(progress_for(Console(force_terminal=True)), LiveProgress)
    assert isinstance(progress_for(Console(file=StringIO())), LineProgress)


@pytest.mark.parametrize("terminal", [True, False])
def test_progress_tells_success_so_far_and_what_infrastructure_cost(terminal: bool) -> None:
    out = StringIO()
    last = shown(progress_for(Console(file=out, force_terminal=terminal, width=120)), out)
    assert "7/10" in last
    assert "50%" in last
    assert "50% [" not in last, "an interval would be of a biased sample"
    assert "1 infrastructure retry" in last
    assert "1 infrastructure failures" in last
    assert "tabletop episode 5: attempt 1 failed, trying again: the simulator exploded" in last
    assert "long story" not in last
    assert " left" in last


def test_lines_are_sparse(monkeypatch: pytest.MonkeyPatch) -> None:
    out = StringIO()
    monkeypatch.setattr(terminal, "LINE_EVERY_S", 1e9)
    progress = LineProgress(Console(file=out, width=120))
    many = planned(100)
    progress.begin([many], {}, many.planned)
    for i in range(100):
        progress.episode(many, result(i, True))
    progress.end()
    lines = out.getvalue().splitlines()
    assert len(lines) == 2
    assert "0/100" in lines[0]
    assert "waiting for the first episode" in lines[0]
    assert "100/100" in lines[1]
