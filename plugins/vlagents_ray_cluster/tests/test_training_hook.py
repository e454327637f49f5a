"""Tests of the hook that a training script calls."""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from vlagents_ray_cluster.slurm import HookFailed, submit_evaluation

WORDS = ["env/*", "--policy", "p", "--set", "checkpoint={checkpoint}", "--out", "runs/{step}"]
PYTHON = """#!/bin/bash
printf '%s\\n' "${{@:3}}" >>"{folder}/words"
[ -e "{folder}/broken" ] && {{ echo 'no partition' >&2; exit 2; }}
echo 77
"""


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """Return a fake Python interpreter, which records its arguments."""
    file = tmp_path / "python"
    file.write_text(PYTHON.format(folder=tmp_path))
    file.chmod(0o755)
    return file


def calls(folder: Path) -> int:
    return (folder / "words").read_text().split().count("--parsable")


def test_a_checkpoint_is_submitted_once_with_its_path_and_step(
    tmp_path: Path, python: Path
) -> None:
    def call(_number: int) -> str | None:
        return submit_evaluation(
            WORDS, checkpoint="/c/20", step=20, record=tmp_path / "record", python=python
        )

    with ThreadPoolExecutor(8) as ranks:
        jobs = list(ranks.map(call, range(8)))
    assert sorted(jobs, key=str) == ["77", *[None] * 7]
    assert calls(tmp_path) == 1
    assert "checkpoint=/c/20\n--out\nruns/20\n" in (tmp_path / "words").read_text()
    [mark] = (tmp_path / "record").iterdir()
    assert json.loads(mark.read_text())["job"] == "77"
    assert (
        submit_evaluation(
            WORDS, checkpoint="/c/30", step=30, record=tmp_path / "record", python=python
        )
        == "77"
    )
    assert calls(tmp_path) == 2


def test_a_failure_is_logged_training_goes_on_and_a_later_call_tries_again(
    tmp_path: Path, python: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "broken").touch()
    with caplog.at_level(logging.ERROR):
        assert (
            submit_evaluation(
                WORDS, checkpoint="/c", step=5, record=tmp_path / "record", python=python
            )
            is None
        )
    assert "no partition" in caplog.text
    with pytest.raises(HookFailed, match=r"step 5.*no partition"):
        submit_evaluation(
            WORDS,
            checkpoint="/c",
            step=5,
            record=tmp_path / "record",
            python=python,
            raise_errors=True,
        )
    (tmp_path / "broken").unlink()
    assert (
        submit_evaluation(WORDS, checkpoint="/c", step=5, record=tmp_path / "record", python=python)
        == "77"
    )


def call_for(folder: Path, step: int = 20) -> str | None:
    return submit_evaluation(
        WORDS,
        checkpoint=f"/c/{step}",
        step=step,
        record=folder / "record",
        python=folder / "python",
        raise_errors=True,
    )


@pytest.fixture
def claimed(tmp_path: Path, python: Path) -> Path:
    """Return the claim of a training that was killed before its submission was answered."""
    assert call_for(tmp_path) == "77"
    [mark] = (tmp_path / "record").iterdir()
    claim = json.loads(mark.read_text())
    del claim["job"]
    mark.write_text(json.dumps(claim))
    return mark


@pytest.mark.parametrize("empty", [False, True])
@pytest.mark.parametrize(("age_s", "jobs"), [(60.0, []), (361.0, ["77"])])
def test_a_claim_without_a_job_holds_for_as_long_as_a_submission_may_take(
    claimed: Path, empty: bool, age_s: float, jobs: list[str]
) -> None:
    if empty:  # the process was killed before it wrote the claim
        claimed.write_text("")
    then = time.time() - age_s
    os.utime(claimed, (then, then))
    folder = claimed.parents[1]
    with ThreadPoolExecutor(8) as ranks:
        results = list(ranks.map(lambda _rank: call_for(folder), range(8)))
    assert [job for job in results if job is not None] == jobs
    assert calls(folder) == 1 + len(jobs)


def test_the_call_for_a_later_checkpoint_makes_up_for_an_earlier_one(claimed: Path) -> None:
    then = time.time() - 361.0
    os.utime(claimed, (then, then))
    assert call_for(claimed.parents[1], step=30) == "77"
    claims = [json.loads(path.read_text()) for path in sorted(claimed.parent.glob("*.json"))]
    assert [(claim["step"], claim["job"], claim["words"][-1]) for claim in claims] == [
        (20, "77", "runs/20"),
        (30, "77", "runs/30"),
    ]


def test_a_python_that_is_not_there_does_not_stop_training(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    assert (
        submit_evaluation(WORDS, checkpoint="/c", step=5, record=tmp_path / "record", python=gone)
        is None
    )


def test_the_hook_needs_the_light_install_only() -> None:
    heavy = {"ray", "torch", "pydantic", "typer", "yaml"}
    code = f"import sys, vlagents_ray_cluster.slurm; print({heavy} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "set()"
