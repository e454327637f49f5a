"""Evaluations and servers as Slurm jobs, and the hook for training scripts.

The hook, `submit_evaluation`, needs only the light install.
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
# The age at which a claim without a job counts as abandoned by a killed process, s.
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

    A checkpoint is submitted once, by the first process that calls this function, even after a
    restart of the training. If a call fails, a later call tries again. If the training is killed
    during a call, the first call after 6 minutes, for any checkpoint, also submits the interrupted
    checkpoint.

    Args:
        words: The arguments of `vlagents-ray slurm eval`, in which `{checkpoint}` and `{step}` are
            replaced.
        checkpoint: The checkpoint.
        step: The training step of the checkpoint.
        record: A folder in which each submission writes a file.
        python: An interpreter with `vlagents-ray[serve]`, if the training's interpreter only has
            the light install.
        raise_errors: Whether to raise an error instead of logging it.

    Returns:
        The number of the job; None if the checkpoint was submitted before, or if an error was
        logged.

    Raises:
        HookFailed: The evaluation could not be submitted, and `raise_errors` is set.
    """
    try:
        checkpoint, python, words = os.fspath(checkpoint), os.fspath(python), list(words)
        identity = json.dumps([os.path.abspath(checkpoint), step, words])
        digest = hashlib.sha256(identity.encode()).hexdigest()[:16]
        folder = Path(record)
        folder.mkdir(parents=True, exist_ok=True)
        mark = folder / f"step-{step}-{digest}.json"
        _submit_abandoned(folder, mark, python)

        filled_words = []
        for word in words:
            filled = word.replace("{checkpoint}", checkpoint).replace("{step}", str(step))
            filled_words.append(filled)
        claim = {"step": step, "checkpoint": checkpoint, "words": filled_words}
        return _submit(mark, claim, python)
    except Exception as error:
        if raise_errors:
            raise HookFailed(f"step {step}: {error}") from error
        log.exception("the evaluation of step %d was not submitted; training continues", step)
        return None


def _submit_abandoned(folder: Path, current: Path, python: str) -> None:
    """Submit checkpoints whose claiming processes were killed, since they may not be submitted by a
    later call.

    Args:
        folder: The folder of the marks.
        current: The mark of the checkpoint that this call submits, which is skipped.
        python: The interpreter.
    """
    for mark in sorted(folder.glob("step-*.json")):
        claim = _read(mark)
        if mark == current or "words" not in claim or _abandoned_since(mark) is None:
            continue
        try:
            job = _submit(mark, claim, python)
        except Exception:
            log.exception(
                "the evaluation of step %s was not submitted; training continues", claim["step"]
            )
        else:
            if job is not None:
                log.info(
                    "step %s: submitted as job %s, in place of a training that was killed",
                    claim["step"],
                    job,
                )


def _take_claim(mark: Path, claim: dict[str, Any]) -> bool:
    """Claim a checkpoint for this process, and return whether that succeeded.

    The first process to claim a checkpoint submits it. If that process was killed, another process
    takes over its claim.
    """
    try:
        mark.open("x").close()
    except FileExistsError:
        since = _abandoned_since(mark)
        if since is None:
            return False
        try:
            # Several processes may find this claim abandoned. The process that creates this file
            # takes it over.
            mark.with_suffix(f".{since}").open("x").close()
        except FileExistsError:
            return False
    _replace(mark, claim)
    return True


def _abandoned_since(mark: Path) -> int | None:
    """Return the time of a claim whose process was killed, ns since 1970.

    Returns:
        The time; None if the checkpoint was submitted, or if its process may still submit it.
    """
    try:
        since = mark.stat().st_mtime_ns
    except FileNotFoundError:
        return None
    is_recent = time.time() - since / 1e9 < _ABANDONED_S
    return None if is_recent or "job" in _read(mark) else since


def _submit(mark: Path, claim: dict[str, Any], python: str) -> str | None:
    """Claim a checkpoint and submit it.

    A failure releases the claim.

    Args:
        mark: The file of the claim.
        claim: The content of the file: step, checkpoint and arguments.
        python: The interpreter.

    Returns:
        The number of the job; None if another process submits the checkpoint.

    Raises:
        HookFailed: The submission failed.
    """
    if not _take_claim(mark, claim):
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


def _replace(mark: Path, claim: dict[str, Any]) -> None:
    """Write the file of a claim atomically."""
    unfinished = mark.with_suffix(f".{uuid.uuid4().hex}.part")
    unfinished.write_text(json.dumps(claim, indent=2) + "\n")
    os.replace(unfinished, mark)


def _read(mark: Path) -> dict[str, Any]:
    """Return a claim; empty if its process was killed before it wrote the claim."""
    try:
        claim = json.loads(mark.read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return claim if isinstance(claim, dict) else {}
