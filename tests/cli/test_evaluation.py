"""What the options of `eval` make of the settings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from vlagents_ray.cli import evaluation, watching
from vlagents_ray.cli.main import app
from vlagents_ray.evaluate import EvalConfig

WORDS = ["eval", "tabletop", "--policy", "http://127.0.0.1:9"]


def test_no_retry_is_a_number_of_retries(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[EvalConfig] = []
    monkeypatch.setattr(evaluation, "run_evaluation", lambda config, _address, **_: seen.append(config))
    done = CliRunner().invoke(app, [*WORDS, "--out", str(tmp_path / "out"), "--retries", "0"])
    assert done.exit_code == 0, done.output
    assert [config.retries for config in seen] == [0]


def test_a_checkpoint_may_count_at_once_and_the_first_step_be_the_last(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[dict[str, Any]] = []
    monkeypatch.setattr(watching, "watch_training", lambda *_args, **options: seen.append(options))
    words = [*WORDS, "--out", str(tmp_path / "out"), "--watch", str(tmp_path), "--settle", "0", "--until", "0"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert seen == [{"settle_s": 0.0, "until": 0}]
