"""What the options of `eval` make of the settings."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NoReturn

import pytest
from typer.testing import CliRunner

import vlagents_ray.evaluate
from vlagents_ray.cli import evaluation, watching
from vlagents_ray.cli.main import app
from vlagents_ray.evaluate import EvalConfig, OutOfTime

WORDS = ["eval", "tabletop", "--policy", "http://127.0.0.1:9"]


def test_no_retry_is_a_number_of_retries(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[EvalConfig] = []
    monkeypatch.setattr(evaluation, "run_evaluation", lambda config, _address, **_: seen.append(config))
    done = CliRunner().invoke(app, [*WORDS, "--out", str(tmp_path / "out"), "--retries", "0"])
    assert done.exit_code == 0, done.output
    assert [config.retries for config in seen] == [0]


def test_workers_take_the_resources_that_are_said_unless_the_file_says_more(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[EvalConfig] = []
    monkeypatch.setattr(evaluation, "run_evaluation", lambda config, _address, **_: seen.append(config))
    file = tmp_path / "runs.yaml"
    suites = "{envs: [tabletop]}, {name: b, envs: [tabletop], worker: {threads: 2}}"
    more = "{name: c, envs: [tabletop], worker: {cpus: 3}}"
    file.write_text(f"policies: [{{url: 'http://127.0.0.1:9'}}]\nsuites: [{suites}, {more}]\n")
    done = CliRunner().invoke(app, ["eval", str(file), "--worker-cpus", "1", "--worker-gpus", "0.25"])
    assert done.exit_code == 0, done.output
    [config] = seen
    kinds = [suite.worker or config.worker for suite in config.suites]
    assert [(worker.cpus, worker.gpus) for worker in kinds] == [(1.0, 0.25), (1.0, 0.25), (3.0, 0.25)]


def test_a_checkpoint_may_count_at_once_and_the_first_step_be_the_last(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[dict[str, Any]] = []
    monkeypatch.setattr(watching, "watch_training", lambda *_args, **options: seen.append(options))
    words = [*WORDS, "--out", str(tmp_path / "out"), "--watch", str(tmp_path), "--settle", "0", "--until", "0"]
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    assert seen == [{"settle_s": 0.0, "until": 0}]


def test_out_of_time_has_an_exit_status_of_its_own(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    ends: list[float] = []

    def evaluate(_config: EvalConfig, *, end_at: float, **_: Any) -> NoReturn:
        ends.append(end_at)
        raise OutOfTime(SimpleNamespace(total=SimpleNamespace(episodes=3, planned=9), out=tmp_path))  # type: ignore[arg-type]

    monkeypatch.setattr(vlagents_ray.evaluate, "evaluate", evaluate)
    monkeypatch.setattr(vlagents_ray.evaluate, "print_summary", lambda *_: None)
    monkeypatch.setattr(evaluation, "served", lambda config, *_, **__: contextlib.nullcontext(config))
    words = [*WORDS, "--out", str(tmp_path / "out"), "--end-at", "2027-01-31T18:30+00:00"]
    done = CliRunner().invoke(app, words, env={"COLUMNS": "200"})
    assert done.exit_code == 75, done.output
    assert ends == [1_801_420_200.0]
    assert "out of time after 3 of 9 episodes; go on with --resume" in " ".join(done.stderr.split())


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--end-at", "soon"], "2027-01-31T18:30"),
        (["--end-at", "1", "--watch", "."], "exclude each other"),
        (["--replica-per-gpu"], "--address"),
    ],
)
def test_options_that_cannot_hold_are_told(words: list[str], text: str, tmp_path: Path) -> None:
    done = CliRunner().invoke(app, [*WORDS, "--out", str(tmp_path / "out"), *words], env={"COLUMNS": "200"})
    assert done.exit_code == 2, done.output
    assert text in done.stderr
