"""`--dry-run`: what an evaluation would take."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import LINE, OTHER_LINE
from in_process_evaluation import flat_config, play

from vlagents_ray.cli.evaluation import forecasts, print_plan
from vlagents_ray.evaluate import EvalConfig, Results
from vlagents_ray.evaluate.plan.cases import cells


@pytest.fixture
def config(tmp_path: Path) -> Callable[..., EvalConfig]:
    def make(**changes: Any) -> EvalConfig:
        return flat_config(**{"envs": [LINE], "out": tmp_path / "out", **changes})

    return make


def test_what_was_played_is_not_planned_again_and_tells_the_time(config: Callable[..., EvalConfig]) -> None:
    results = play(config(episodes=3))
    [played, other] = forecasts(cells(config(envs=[LINE, OTHER_LINE], episodes=9)), results)
    assert (played.finished, played.left) == (3, 6)
    assert played.seconds == pytest.approx(sum(one.seconds for one in results.cells[0].counted) / 3)
    assert (other.finished, other.left, other.seconds) == (0, 9, None)


def test_nothing_is_left_of_a_cell_that_stopped(config: Callable[..., EvalConfig]) -> None:
    settings = config(episodes=30, stop={"target": 0.3})
    play(settings, left_out=range(20, 30))
    [found] = forecasts(cells(settings), Results.load(settings.out))
    assert (found.finished, found.left) == (20, 0)


def test_the_plan_is_printed_without_asking_any_policy(
    config: Callable[..., EvalConfig], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "150")
    settings = config(episodes=5, policy_url="http://127.0.0.1:9", steps=[10, 20], envs=[LINE, OTHER_LINE])
    print_plan(settings)
    text = capsys.readouterr().out
    assert "4 cells" in text
    assert "20 episodes, 0 of them finished" in text
    assert "policy@20" in text
    assert "and 4 cells whose envs were not played yet" in " ".join(text.split())
    assert not settings.out.exists(), "nothing is written"
