"""Evaluation during training: one call for each checkpoint. The light install, and sbatch where the training runs."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from vlagents_ray.errors import VLAgentsError

log = logging.getLogger(__name__)

_SUBMISSION_S = 300.0


class HookFailed(VLAgentsError):
    """The evaluation could not be submitted; the message has the command's own words."""


def submit_evaluation(
    words: Sequence[str],
    *,
    checkpoint: str | os.PathLike[str],
    step: int,
    record: str | os.PathLike[str],
    python: str | os.PathLike[str] = sys.executable,
    raise_errors: bool = False,
) -> str | None:
    """Have a job evaluate a checkpoint that has just been written, and go on training; returns the job's number.

    `words` are those of `vlagents-ray slurm eval`, in which `{checkpoint}` and `{step}` are replaced. `record` is a
    folder in which each submission leaves a file: a checkpoint is submitted once, by whichever process calls first,
    also after a restart of the training; a further call returns None. `python` is one with `vlagents-ray[serve]`,
    should the training's have the light install only.

    Whatever goes wrong is logged, and None is returned; with `raise_errors` it is raised as `HookFailed`. A later call
    tries again.
    """
    try:
        return _submit_once(list(words), os.fspath(checkpoint), step, Path(record), os.fspath(python))
    except Exception as error:
        if raise_errors:
            raise HookFailed(f"step {step}: {error}") from error
        log.exception("the evaluation of step %d was not submitted; training goes on", step)
        return None


def _submit_once(words: list[str], checkpoint: str, step: int, record: Path, python: str) -> str | None:
    filled = [word.replace("{checkpoint}", checkpoint).replace("{step}", str(step)) for word in words]
    name = hashlib.sha256(json.dumps([os.path.abspath(checkpoint), step, words]).encode()).hexdigest()[:16]
    record.mkdir(parents=True, exist_ok=True)
    mark = record / f"step-{step}-{name}.json"
    try:
        mark.touch(exist_ok=False)  # one process of many comes first
    except FileExistsError:
        return None
    try:
        job = _submitted(filled, python)
    except BaseException:
        mark.unlink()
        raise
    mark.write_text(json.dumps({"step": step, "checkpoint": checkpoint, "job": job, "words": filled}, indent=2) + "\n")
    return job


def _submitted(words: list[str], python: str) -> str:
    command = [python, "-c", "from vlagents_ray.cli import main; main()", "slurm", "eval", "--parsable", *words]
    done = subprocess.run(  # noqa: S603 - the caller's own words
        command, capture_output=True, text=True, check=False, timeout=_SUBMISSION_S
    )
    if done.returncode:
        raise HookFailed(f"`vlagents-ray slurm eval` ended with {done.returncode}: {done.stderr.strip()}")
    return done.stdout.strip()
