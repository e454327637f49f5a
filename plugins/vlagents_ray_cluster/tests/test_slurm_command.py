"""Tests of the arguments of `vlagents-ray slurm`."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from vlagents_ray.cli.main import app

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "cluster" / "slurm.md"
DOCUMENTED = re.findall(r"^vlagents-ray slurm (.*)$", PAGE.read_text(), re.MULTILINE)

EVAL = ["eval", "tabletop", "--policy", "scripted", "--dry-run"]
RUNS = """
policies: [{source: scripted}]
suites: [{envs: [tabletop], episodes: 2}]
workers: 3
"""


def slurm(*words: str) -> Result:
    return CliRunner().invoke(app, ["slurm", *words], env={"COLUMNS": "200"})


def script(*words: str) -> str:
    done = slurm(*words)
    assert done.exit_code == 0, done.output
    return done.stdout


def arguments(*words: str) -> list[str]:
    """Return the arguments of the program on the job's first node."""
    match = re.search(r"^arguments=\((.*)\)$", script(*words), re.MULTILINE)
    assert match is not None
    return shlex.split(match[1])


def test_an_evaluation_keeps_its_words_and_sbatch_gets_the_others(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [
        *EVAL,
        "--out",
        str(out),
        "--nodes",
        "4",
        "--gpus-per-node=2",
        "--resubmit",
        "3",
        "--seed",
        "7",
    ]
    assert {"#SBATCH --nodes=4", "#SBATCH --gpus-per-node=2", "resubmit=3"} <= set(
        script(*command).splitlines()
    )
    words = ["tabletop", "--policy", "scripted", "--out", str(out), "--seed", "7"]
    assert arguments(*command) == ["eval", "--fill=1", "--closing-s=60", "--", *words]
    assert not out.exists(), "--dry-run writes nothing"


def test_workers_fill_a_job_with_the_cpus_of_each_unless_their_number_is_said(
    tmp_path: Path,
) -> None:
    file = tmp_path / "runs.yaml"
    file.write_text(RUNS)
    for words in (["eval", str(file), "--dry-run"], [*EVAL, "--workers", "2"]):
        assert arguments(*words, "--out", str(tmp_path / "out"))[:2] == ["eval", "--closing-s=60"]
    file.write_text(RUNS.replace("workers: 3", "worker: {cpus: 2}"))
    assert "--fill=2" in script("eval", str(file), "--dry-run")
    file.write_text(RUNS.replace("workers: 3", "worker: {gpus: 0.25}"))
    refused = slurm("eval", str(file), "--dry-run")
    assert refused.exit_code == 2
    assert "workers" in refused.stderr


def test_tasks_of_an_array_write_to_folders_of_their_own(tmp_path: Path) -> None:
    printed = script(*EVAL, "--out", f"{tmp_path}/%a", "--seed", "%a00", "--array=0-3")
    assert f"folder={tmp_path}/slurm" in printed.splitlines()
    assert "--seed %a00" in printed


SERVE = ["serve", "noop", "--dry-run"]


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (EVAL, "--out: expected a folder, which a repeated or requeued job continues"),
        ([*EVAL, "--out", "out", "--address", "auto"], "leave it out"),
        ([*EVAL, "--out", "out", "--watch", "runs"], "submit_evaluation"),
        ([*EVAL, "--out", "out", "--ntasks", "4"], "--cpus-per-task"),
        ([*EVAL, "--out", "out", "--set", "nonsense"], "KEY=VALUE"),
        ([*EVAL, "--out", "out", "--set", "no_such_setting=1"], "no_such_setting"),
        ([*EVAL, "--out", "out", "--array=0-3"], "%a"),
        ([*SERVE, "--host", "localhost"], "leave it out"),
        ([*SERVE, "--array=0-3"], "one job"),
    ],
)
def test_what_would_end_the_job_as_soon_as_it_began_is_refused_before(
    words: list[str], text: str
) -> None:
    done = slurm(*words)
    assert done.exit_code == 2, done.output
    assert text in done.stderr


def test_a_tracker_that_is_not_registered_is_refused_before_the_job_is_submitted(
    tmp_path: Path,
) -> None:
    done = slurm(*EVAL, "--out", str(tmp_path / "out"), "--track", "wandbb")
    assert done.exit_code == 2
    assert "got 'wandbb', which is not registered" in done.output
    assert "'wandb'" in done.output


def test_a_server_has_a_key_made_for_it_unless_it_has_some() -> None:
    without_keys = arguments(*SERVE, "--set", "action_dim=3", "--time=60")
    assert without_keys == ["serve", "--app=noop=/", "--key", "--", "noop", "--set", "action_dim=3"]
    with_keys = arguments(*SERVE, "--keys", "mine.json", "--port", "9000")
    assert "--key" not in with_keys
    assert "--port=9000" in with_keys


def test_what_the_page_shows_becomes_a_script(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    for line in DOCUMENTED:
        assert script(*shlex.split(line), "--dry-run").startswith("#!/bin/bash"), line
    assert {line.split()[0] for line in DOCUMENTED} == {"eval", "serve"}
