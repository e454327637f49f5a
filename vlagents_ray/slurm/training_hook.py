"""Evaluation during training: one call for each checkpoint, with the light install and sbatch."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from vlagents_ray.errors import VLAgentsError

log = logging.getLogger(__name__)

_SUBMISSION_S = 300.0
_ABANDONED_S = _SUBMISSION_S + 60.0  # age at which a claim without a job is abandoned, on any machine


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
    """Submit a job that evaluates a checkpoint which has just been written, while the training continues.

    A checkpoint is submitted once, by the first process that calls this, also after a restart of the training. If a
    call fails, a later one tries again. If the training is killed during a call, the next call, for any checkpoint,
    submits the interrupted one as well: at once on the same machine, after 6 minutes on another one.

    Args:
        words: The arguments of `vlagents-ray slurm eval`, in which `{checkpoint}` and `{step}` are replaced.
        checkpoint: The checkpoint.
        step: Its training step.
        record: A folder in which each submission writes a file.
        python: An interpreter with `vlagents-ray[serve]`, if the training's has the light install only.
        raise_errors: Raise an error instead of logging it.

    Returns:
        The number of the job; None if the checkpoint was submitted before, or if an error was logged.

    Raises:
        HookFailed: The evaluation could not be submitted, and `raise_errors` is set.
    """
    try:
        return _submit_once(list(words), os.fspath(checkpoint), step, Path(record), os.fspath(python))
    except Exception as error:
        if raise_errors:
            raise HookFailed(f"step {step}: {error}") from error
        log.exception("the evaluation of step %d was not submitted; training continues", step)
        return None


def _submit_once(words: list[str], checkpoint: str, step: int, record: Path, python: str) -> str | None:
    filled = [word.replace("{checkpoint}", checkpoint).replace("{step}", str(step)) for word in words]
    name = hashlib.sha256(json.dumps([os.path.abspath(checkpoint), step, words]).encode()).hexdigest()[:16]
    record.mkdir(parents=True, exist_ok=True)
    mark = record / f"step-{step}-{name}.json"
    what = {"step": step, "checkpoint": checkpoint, "words": filled}
    _resume_others(record, mark, python)
    return _submit(mark, what, python) if _claimed(mark, what) else None


def _submit(mark: Path, what: dict[str, Any], python: str) -> str:
    """Submit a checkpoint that this process has claimed; a failure releases the claim."""
    output = mark.with_suffix(".said")  # the command's output in a file, as the command may outlive this process
    try:
        job = output.read_text().strip() if output.exists() else ""
        job = job or _submitted(what["words"], python, mark, what, output)
        _replace(mark, what | {"job": job})
    except BaseException:
        mark.unlink(missing_ok=True)
        raise
    finally:
        output.unlink(missing_ok=True)
    return job


def _resume_others(record: Path, mark: Path, python: str) -> None:
    """Submit the checkpoints claimed by processes that have ended, as no other call may come for them."""
    for other in sorted(record.glob("step-*.json")):
        what = _read(other)
        if other == mark or not _is_abandoned(other, what) or "words" not in what:
            continue
        what = {name: what[name] for name in ("step", "checkpoint", "words")}
        try:
            if _claimed(other, what):
                job = _submit(other, what, python)
                log.info("step %s: submitted as job %s, in place of a training that was killed", what["step"], job)
        except Exception:
            log.exception("the evaluation of step %s was not submitted; training continues", what["step"])


def _claimed(mark: Path, what: dict[str, Any]) -> bool:
    """Whether this process submits the checkpoint: the first one to claim it, or another one if that was killed."""
    claim = json.dumps(what | _claim(), indent=2)
    try:
        with mark.open("x") as file:
            file.write(claim)
    except FileExistsError:
        pass
    else:
        return True
    if not _is_abandoned(mark, _read(mark)):
        return False
    try:
        with (mark.parent / ".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not _is_abandoned(mark, _read(mark)):  # another process has claimed it
                return False
            _replace(mark, what | _claim())
            return True
    except OSError as error:
        log.warning("%s: its process has ended, and the file system has no locks to claim it again (%s)", mark, error)
        return False


def _claim(child: int | None = None) -> dict[str, Any]:
    return {"host": _host(), "pid": os.getpid(), "child": child, "at": time.time()}


def _is_abandoned(mark: Path, what: dict[str, Any]) -> bool:
    """Whether the checkpoint was claimed by a process that has ended, and not submitted."""
    if what.get("job"):
        return False
    try:
        since = what.get("at") or mark.stat().st_mtime  # the file of a process that was killed has no time
    except FileNotFoundError:
        return False
    if time.time() - since > _ABANDONED_S:
        return True
    here = what.get("host") == _host()
    return here and not any(_is_alive(what[name]) for name in ("pid", "child") if what.get(name))


def _host() -> str:
    """Identify the machine and the namespace in which process numbers are valid."""
    try:
        return f"{socket.gethostname()} {os.readlink('/proc/self/ns/pid')}"
    except OSError:
        return socket.gethostname()


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"  # a zombie
    except OSError:
        return False


def _read(mark: Path) -> dict[str, Any]:
    try:
        found = json.loads(mark.read_text())
    except (FileNotFoundError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def _replace(mark: Path, what: dict[str, Any]) -> None:
    part = mark.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(what, indent=2) + "\n")
    os.replace(part, mark)


def _submitted(words: list[str], python: str, mark: Path, what: dict[str, Any], output: Path) -> str:
    """Run the command, and return the number of the job, which is also in the file `output` for later calls."""
    command = [python, "-c", "from vlagents_ray.cli import main; main()", "slurm", "eval", "--parsable", *words]
    with output.open("w") as out, tempfile.TemporaryFile("w+") as errors:  # no pipes: it may outlive this process
        with subprocess.Popen(command, stdout=out, stderr=errors, text=True) as running:  # noqa: S603 - the caller's arguments
            _replace(mark, what | _claim(running.pid))
            try:
                running.wait(_SUBMISSION_S)
            except BaseException:
                running.kill()
                raise
        if running.returncode:
            errors.seek(0)
            raise HookFailed(f"`vlagents-ray slurm eval` ended with {running.returncode}: {errors.read().strip()}")
    return output.read_text().strip()
