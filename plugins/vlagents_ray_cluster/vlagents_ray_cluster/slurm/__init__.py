"""Evaluations and servers as Slurm jobs, and the hook for training scripts, which only needs the
light install.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import subprocess
import sys
import time
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.errors import VLAgentsError

__all__ = ["submit_evaluation"]

log = logging.getLogger(__name__)

_SUBMISSION_S = 300.0
# Age at which a claim without a job counts as abandoned by a killed process.
_ABANDONED_S = _SUBMISSION_S + 60.0


class HookFailed(VLAgentsError):
    """The evaluation could not be submitted; the message quotes the command's output."""


def submit_evaluation(
    words: Sequence[str],
    *,
    checkpoint: str | os.PathLike[str],
    step: int,
    record: str | os.PathLike[str],
    python: str | os.PathLike[str] = sys.executable,
    raise_errors: bool = False,
) -> str | None:
    """Submit a job that evaluates a newly written checkpoint, while the training continues.

    A checkpoint is submitted once, by the first process that calls this, even after a restart of
    the training. If a call fails, a later one tries again. If the training is killed during a call,
    the first call after 6 minutes, for any checkpoint, also submits the interrupted one.

    Args:
        words: The arguments of `vlagents-ray slurm eval`, in which `{checkpoint}` and `{step}` are
            replaced.
        checkpoint: The checkpoint.
        step: Its training step.
        record: A folder in which each submission writes a file.
        python: An interpreter with `vlagents-ray[serve]`, if the training's only has the light
            install.
        raise_errors: Raise an error instead of logging it.

    Returns:
        The number of the job; None if the checkpoint was submitted before, or if an error was
        logged.

    Raises:
        HookFailed: The evaluation could not be submitted, and `raise_errors` is set.
    """
    try:
        checkpoint, folder, words, python = (
            os.fspath(checkpoint),
            Path(record),
            list(words),
            os.fspath(python),
        )
        name = hashlib.sha256(
            json.dumps([os.path.abspath(checkpoint), step, words]).encode()
        ).hexdigest()[:16]
        folder.mkdir(parents=True, exist_ok=True)
        mark = folder / f"step-{step}-{name}.json"
        # Submit other checkpoints whose claiming processes were killed, since no other call may
        # follow for them.
        for other in sorted(folder.glob("step-*.json")):
            abandoned = _read(other)
            if other == mark or "words" not in abandoned or _abandoned_since(other) is None:
                continue
            try:
                if (job := _submit(other, abandoned, python)) is not None:
                    of = abandoned["step"]
                    log.info(
                        "step %s: submitted as job %s, in place of a training that was killed",
                        of,
                        job,
                    )
            except Exception:
                log.exception(
                    "the evaluation of step %s was not submitted; training continues",
                    abandoned["step"],
                )
        filled = [
            word.replace("{checkpoint}", checkpoint).replace("{step}", str(step)) for word in words
        ]
        return _submit(mark, {"step": step, "checkpoint": checkpoint, "words": filled}, python)
    except Exception as error:
        if raise_errors:
            raise HookFailed(f"step {step}: {error}") from error
        log.exception("the evaluation of step %d was not submitted; training continues", step)
        return None


def _is_claimed(mark: Path, claim: dict[str, Any]) -> bool:
    """Return whether this process submits the checkpoint: the first to claim it, or another if
    the first was killed.
    """
    try:
        mark.open("x").close()
    except FileExistsError:
        if (since := _abandoned_since(mark)) is None:
            return False
        try:
            # By one of the processes that find this claim abandoned.
            mark.with_suffix(f".{since}").open("x").close()
        except FileExistsError:
            return False
    _replace(mark, claim)
    return True


def _abandoned_since(mark: Path) -> int | None:
    """Return the time of a claim whose process was killed, ns since 1970; None if it was or may
    still be submitted.
    """
    try:
        since = mark.stat().st_mtime_ns
    except FileNotFoundError:
        return None
    return None if "job" in _read(mark) or time.time() - since / 1e9 < _ABANDONED_S else since


def _submit(mark: Path, claim: dict[str, Any], python: str) -> str | None:
    """Claim a checkpoint and submit it, unless another process does; a failure releases the
    claim.
    """
    if not _is_claimed(mark, claim):
        return None
    command = [
        python,
        "-c",
        "from vlagents_ray.cli import main; main()",
        "slurm",
        "eval",
        "--parsable",
    ]
    try:
        done = subprocess.run(  # noqa: S603 - the caller's arguments
            [*command, *claim["words"]],
            capture_output=True,
            text=True,
            timeout=_SUBMISSION_S,
            check=False,
        )
        if done.returncode:
            raise HookFailed(
                f"`vlagents-ray slurm eval` ended with {done.returncode}: {done.stderr.strip()}"
            )
    except BaseException:
        mark.unlink(missing_ok=True)
        raise
    job = done.stdout.strip()
    _replace(mark, claim | {"job": job})
    return job


def _replace(mark: Path, content: dict[str, Any]) -> None:
    part = mark.with_suffix(f".{uuid.uuid4().hex}.part")
    part.write_text(json.dumps(content, indent=2) + "\n")
    os.replace(part, mark)


def _read(mark: Path) -> dict[str, Any]:
    try:
        found = json.loads(mark.read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}
