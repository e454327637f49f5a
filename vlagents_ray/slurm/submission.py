"""The submission of scripts by sbatch."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path

from vlagents_ray.errors import ConfigError, VLAgentsError
from vlagents_ray.slurm.script import Script

RECORD = "job.json"
_KEPT = {
    "SLURM_CONF",
    "SLURM_CLUSTERS",
}  # the location of Slurm; the others belong to this process's own job
_SBATCH_S = 120.0


class SubmissionFailed(VLAgentsError):
    """sbatch rejected the job; the message quotes it."""


def submit(script: Script) -> str:
    """Write a script, submit it, and record the job in `job.json` beside the script.

    Args:
        script: The script.

    Returns:
        The job's number.

    Raises:
        ConfigError: sbatch is not installed.
        SubmissionFailed: sbatch rejected the job, or did not answer.
    """
    file = write(script)
    try:
        done = subprocess.run(  # noqa: S603 - the user's own arguments
            ["sbatch", "--parsable", str(file)],  # noqa: S607 - found by PATH
            capture_output=True, text=True, check=False, timeout=_SBATCH_S, env=outside_of_jobs(os.environ),
        )  # fmt: skip
    except FileNotFoundError as error:
        raise ConfigError(
            f"sbatch is not installed here: run this where jobs are submitted, or copy {file} there (--print shows it)"
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
    """Write a script to its file, and return the file."""
    file = script.file.absolute()
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(script.text())
    file.chmod(0o700)
    return file


def outside_of_jobs(environ: Mapping[str, str]) -> dict[str, str]:
    """Return the environment without the variables of the job to which this process belongs, such as a training.

    sbatch passes its environment on, and steps of the new job would read these variables as their options.
    """
    return {name: value for name, value in environ.items() if not name.startswith("SLURM_") or name in _KEPT}
