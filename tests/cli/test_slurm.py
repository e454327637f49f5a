"""`vlagents-ray slurm`: what becomes of its words."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from vlagents_ray.cli.main import app

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "cluster" / "slurm.md"
DOCUMENTED = re.findall(r"^vlagents-ray slurm (.*)$", PAGE.read_text(), re.MULTILINE)

EVAL = ["eval", "tabletop", "--policy", "scripted", "--print"]
RUNS = """
policies: [{source: scripted}]
suites: [{envs: [tabletop], episodes: 2}]
workers: 3
"""


def slurm(*words: str) -> Result:
    return CliRunner().invoke(app, ["slurm", *words], env={"COLUMNS": "200"})


def arguments(script: str) -> list[str]:
    """What the job's first node is told to do."""
    found = re.search(r"^arguments=\((.*)\)$", script, re.MULTILINE)
    assert found is not None
    return shlex.split(found[1])


def test_an_evaluation_keeps_its_words_and_sbatch_gets_the_others(tmp_path: Path) -> None:
    out = tmp_path / "out"
    done = slurm(*EVAL, "--out", str(out), "--nodes", "4", "--gpus-per-node=2", "--resubmit", "3", "--seed", "7")
    assert done.exit_code == 0, done.output
    assert {"#SBATCH --nodes=4", "#SBATCH --gpus-per-node=2", "resubmit=3"} <= set(done.stdout.splitlines())
    words = ["tabletop", "--policy", "scripted", "--out", str(out), "--seed", "7"]
    assert arguments(done.stdout) == ["eval", "--fill=1", "--closing=60", "--", *words]
    assert not out.exists(), "--print writes nothing"


def test_a_number_of_workers_that_the_user_has_said_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "runs.yaml"
    file.write_text(RUNS)
    for words in (["eval", str(file), "--print"], [*EVAL, "--workers", "2"]):
        done = slurm(*words, "--out", str(tmp_path / "out"))
        assert arguments(done.stdout)[:2] == ["eval", "--closing=60"]


def test_workers_that_fill_a_job_have_the_cpus_that_the_file_gives_each(tmp_path: Path) -> None:
    file = tmp_path / "runs.yaml"
    file.write_text(RUNS.replace("workers: 3", "worker: {cpus: 2}"))
    assert "--fill=2" in arguments(slurm("eval", str(file), "--print").stdout)
    file.write_text(RUNS.replace("workers: 3", "worker: {gpus: 0.25}"))
    refused = slurm("eval", str(file), "--print")
    assert refused.exit_code == 2
    assert "workers" in refused.stderr


def test_tasks_of_an_array_write_to_folders_of_their_own(tmp_path: Path) -> None:
    done = slurm(*EVAL, "--out", f"{tmp_path}/%a", "--seed", "%a00", "--array=0-3")
    assert done.exit_code == 0, done.output
    assert f"folder={tmp_path}/slurm" in done.stdout.splitlines()
    assert "--seed %a00" in done.stdout
    refused = slurm(*EVAL, "--out", str(tmp_path), "--array=0-3")
    assert refused.exit_code == 2
    assert "%a" in refused.stderr


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--address", "auto"], "leave it out"),
        (["--watch", "runs"], "submit_evaluation"),
        (["--ntasks", "4"], "--cpus-per-task"),
        (["--set", "nonsense"], "KEY=VALUE"),
        (["--set", "no_such_setting=1"], "no_such_setting"),
    ],
)
def test_what_would_end_the_job_as_soon_as_it_began_is_told_before(words: list[str], text: str, tmp_path: Path) -> None:
    done = slurm(*EVAL, "--out", str(tmp_path / "out"), *words)
    assert done.exit_code == 2, done.output
    assert text in done.stderr


def test_a_server_has_a_key_made_for_it_unless_it_has_some() -> None:
    done = slurm("serve", "noop", "--set", "action_dim=3", "--time=60", "--print")
    assert done.exit_code == 0, done.output
    assert arguments(done.stdout) == ["serve", "--app=noop=/", "--key", "--", "noop", "--set", "action_dim=3"]
    mine = slurm("serve", "noop", "--keys", "mine.json", "--port", "9000", "--print").stdout
    assert "--key" not in arguments(mine)
    assert "--port=9000" in arguments(mine)


@pytest.mark.parametrize(("words", "text"), [(["--host", "localhost"], "leave it out"), (["--array=0-3"], "one job")])
def test_a_server_listens_where_its_job_is(words: list[str], text: str) -> None:
    done = slurm("serve", "noop", *words, "--print")
    assert done.exit_code == 2, done.output
    assert text in done.stderr


@pytest.mark.parametrize("line", DOCUMENTED)
def test_what_the_page_shows_becomes_a_script(line: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    done = slurm(*shlex.split(line), "--print")
    assert done.exit_code == 0, done.output
    assert done.stdout.startswith("#!/bin/bash")


def test_the_page_shows_evaluations_and_servers() -> None:
    assert {line.split()[0] for line in DOCUMENTED} == {"eval", "serve"}
