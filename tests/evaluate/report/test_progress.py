from __future__ import annotations

from io import StringIO

import pytest
from in_process_evaluation import flat_config
from rich.console import Console

from vlagents_ray.evaluate import Rate, progress_for
from vlagents_ray.evaluate.episode.failures import Failure
from vlagents_ray.evaluate.episode.records import EpisodeResult, Status
from vlagents_ray.evaluate.plan.cases import EvalCase, cells
from vlagents_ray.evaluate.plan.jobs import EpisodeKey, Job
from vlagents_ray.evaluate.report.progress import LineProgress, LiveProgress, Progress
from vlagents_ray.evaluate.results.stopping import confidence_sequence

RETRY = Failure("worker", "env_failed", "the simulator exploded\nwith a long story")


def planned(episodes: int) -> EvalCase:
    [cell] = cells(flat_config(envs=["tabletop"], episodes=episodes, out="out"))
    return cell


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
    assert str(Rate(3, 6)) in last
    assert "1 infrastructure retry" in last
    assert "1 infrastructure failures" in last
    assert "tabletop episode 5: attempt 1 failed, trying again: the simulator exploded" in last
    assert "long story" not in last
    assert " left" in last


def test_a_cell_that_may_stop_early_shows_its_confidence_sequence() -> None:
    out = StringIO()
    progress = LineProgress(Console(file=out, width=120))
    progress.begin([TEN], {TEN.fingerprint: Rate(7, 7, confidence_sequence(7, 7), 0.05)}, 3)
    progress.episode(TEN, result(7, True))
    progress.end()
    assert str(Rate(8, 8, confidence_sequence(8, 8), 0.05)) in out.getvalue()
    assert str(Rate(8, 8)) not in out.getvalue()


def test_lines_are_sparse(monkeypatch: pytest.MonkeyPatch) -> None:
    out = StringIO()
    progress = LineProgress(Console(file=out, width=120), every_s=1e9)
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
