"""Hands scripts to sbatch."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.slurm.script import Script

RECORD = "job.json"
_KEPT = {"SLURM_CONF", "SLURM_CLUSTERS"}  # where Slurm is; the others are of the job that this process is in
_SBATCH_S = 120.0


class SubmissionFailed(VLAgentsError):
    """sbatch took the job not; the message has its words."""


def submit(script: Script) -> str:
    """Write the script, have it queued, and return the job's number; all of that stands in `job.json` beside it.

    `ConfigError` where there is no Slurm, `SubmissionFailed` if sbatch says no.
    """
    file = write(script)
    try:
        done = subprocess.run(  # noqa: S603 - the user's own words
            ["sbatch", "--parsable", str(file)],  # noqa: S607 - where the user has it
            capture_output=True, text=True, check=False, timeout=_SBATCH_S, env=outside_of_jobs(os.environ),
        )  # fmt: skip
    except FileNotFoundError as error:
        raise ConfigError(
            f"no sbatch here: run this where jobs are submitted, or take {file} (--print shows it) there"
        ) from error
    except subprocess.TimeoutExpired as error:
        raise SubmissionFailed(f"sbatch {file}: no answer in {_SBATCH_S:g} s; look with `squeue --me`") from error
    if done.returncode:
        raise SubmissionFailed(f"sbatch {file}: {done.stderr.strip() or done.stdout.strip()}")
    job = done.stdout.strip().partition(";")[0]
    log = script.log.replace("%j", job)
    record = {"job": job, "script": str(file), "log": log, "logs": str(file.parent / job)}
    (file.parent / RECORD).write_text(json.dumps(record, indent=2) + "\n")
    return job


def write(script: Script) -> Path:
    """Write the script to its place; returns that."""
    file = script.file.absolute()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(script.text())
    file.chmod(0o700)
    return file


def outside_of_jobs(environ: Mapping[str, str]) -> dict[str, str]:
    """The environment without what Slurm has set for a job that this process is part of, such as a training.

    sbatch hands its environment on, and steps of the new job would take those for their own options.
    """
    return {name: value for name, value in environ.items() if not name.startswith("SLURM_") or name in _KEPT}
