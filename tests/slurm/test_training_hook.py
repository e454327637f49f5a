"""The call of a training script."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from eval_fakes import wait_for

from vlagents_ray.slurm import submit_evaluation, training_hook
from vlagents_ray.slurm.training_hook import HookFailed

WORDS = ["env/*", "--policy", "p", "--set", "checkpoint={checkpoint}", "--out", "runs/{step}"]
PYTHON = """#!/bin/bash
printf '%s\\n' "${{@:3}}" >>"{folder}/words"
while [ -e "{folder}/slow" ]; do sleep 0.05; done
[ -e "{folder}/broken" ] && {{ echo 'no partition' >&2; exit 2; }}
echo 77
"""


@pytest.fixture
def python(tmp_path: Path) -> Path:
    """In place of the one that has the command; notes what it was called with."""
    file = tmp_path / "python"
    file.write_text(PYTHON.format(folder=tmp_path))
    file.chmod(0o755)
    return file


def calls(folder: Path) -> int:
    return (folder / "words").read_text().split().count("--parsable")


def test_a_checkpoint_is_submitted_once_with_its_path_and_step(tmp_path: Path, python: Path) -> None:
    def call(_number: int) -> str | None:
        return submit_evaluation(WORDS, checkpoint="/c/20", step=20, record=tmp_path / "record", python=python)

    with ThreadPoolExecutor(8) as ranks:
        found = list(ranks.map(call, range(8)))
    assert sorted(found, key=str) == ["77", *[None] * 7]
    assert calls(tmp_path) == 1
    assert "checkpoint=/c/20\n--out\nruns/20\n" in (tmp_path / "words").read_text()
    [mark] = (tmp_path / "record").iterdir()
    assert json.loads(mark.read_text())["job"] == "77"
    assert submit_evaluation(WORDS, checkpoint="/c/30", step=30, record=tmp_path / "record", python=python) == "77"
    assert calls(tmp_path) == 2


def test_a_failure_is_logged_training_goes_on_and_a_later_call_tries_again(
    tmp_path: Path, python: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "broken").touch()
    with caplog.at_level(logging.ERROR):
        assert submit_evaluation(WORDS, checkpoint="/c", step=5, record=tmp_path / "record", python=python) is None
    assert "no partition" in caplog.text
    with pytest.raises(HookFailed, match=r"step 5.*no partition"):
        submit_evaluation(WORDS, checkpoint="/c", step=5, record=tmp_path / "record", python=python, raise_errors=True)
    (tmp_path / "broken").unlink()
    assert submit_evaluation(WORDS, checkpoint="/c", step=5, record=tmp_path / "record", python=python) == "77"


TRAINING = """
import sys
from vlagents_ray.slurm import submit_evaluation
folder = sys.argv[1]
submit_evaluation({words}, checkpoint="/c/20", step=20, record=folder + "/record", python=folder + "/python")
"""


@pytest.fixture
def killed(tmp_path: Path, python: Path) -> Iterator[Path]:
    """The record of a training that was killed while its submission was under way; that lives as long as `slow` is."""
    (tmp_path / "slow").touch()
    training = subprocess.Popen([sys.executable, "-c", TRAINING.format(words=WORDS), str(tmp_path)])
    wait_for(
        lambda: [*tmp_path.glob("record/*.json")] and "child" in mark_of(tmp_path) and (tmp_path / "words").exists()
    )
    wait_for(lambda: mark_of(tmp_path)["child"])
    training.kill()
    training.wait()
    yield tmp_path
    (tmp_path / "slow").unlink(missing_ok=True)


def mark_of(folder: Path) -> dict[str, Any]:
    [mark] = (folder / "record").glob("*.json")
    found: dict[str, Any] = json.loads(mark.read_text() or "{}")
    return found


def call_for(folder: Path, step: int = 20) -> str | None:
    return submit_evaluation(
        WORDS, checkpoint=f"/c/{step}", step=step, record=folder / "record", python=folder / "python", raise_errors=True
    )


def end_submission(folder: Path) -> None:
    child = mark_of(folder)["child"]
    os.kill(child, signal.SIGKILL)
    wait_for(lambda: not training_hook._is_alive(child))


def test_a_training_that_is_killed_with_its_submission_is_made_up_for_by_the_next_call(killed: Path) -> None:
    end_submission(killed)
    (killed / "slow").unlink()
    with ThreadPoolExecutor(8) as ranks:
        found = list(ranks.map(lambda _rank: call_for(killed), range(8)))
    assert sorted(found, key=str) == ["77", *[None] * 7]
    assert calls(killed) == 2  # that of the killed one, which reached nobody, and this
    assert mark_of(killed)["job"] == "77"


def test_a_submission_that_outlives_its_training_is_not_made_twice(killed: Path) -> None:
    assert call_for(killed) is None  # it is under way
    child = mark_of(killed)["child"]
    (killed / "slow").unlink()
    wait_for(lambda: not training_hook._is_alive(child))
    assert call_for(killed) == "77"
    assert call_for(killed) is None
    assert calls(killed) == 1


def test_the_call_for_a_later_checkpoint_makes_up_for_an_earlier_one(killed: Path) -> None:
    end_submission(killed)
    (killed / "slow").unlink()
    assert call_for(killed, step=30) == "77"
    said = [json.loads(path.read_text()) for path in sorted((killed / "record").glob("*.json"))]
    assert [(one["step"], one["job"], one["words"][-1]) for one in said] == [
        (20, "77", "runs/20"),
        (30, "77", "runs/30"),
    ]


@pytest.mark.parametrize(("age_s", "job"), [(60.0, None), (361.0, "77")])
@pytest.mark.parametrize("claim", ["elsewhere", "empty"])
def test_a_claim_of_another_machine_holds_for_as_long_as_a_submission_may_take(
    claim: str, age_s: float, job: str | None, tmp_path: Path, python: Path
) -> None:
    assert call_for(tmp_path) == "77"
    [mark] = (tmp_path / "record").iterdir()
    then = time.time() - age_s
    mark.write_text(json.dumps({"host": "elsewhere", "pid": 1, "at": then}) if claim == "elsewhere" else "")
    os.utime(mark, (then, then))
    assert call_for(tmp_path) == job


def test_a_python_that_is_not_there_does_not_stop_training(tmp_path: Path) -> None:
    gone = tmp_path / "gone"
    assert submit_evaluation(WORDS, checkpoint="/c", step=5, record=tmp_path / "record", python=gone) is None


def test_the_hook_needs_the_light_install_only() -> None:
    code = "import sys, vlagents_ray.slurm; print({'ray', 'torch', 'pydantic', 'typer', 'yaml'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "set()"
