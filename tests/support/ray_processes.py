"""Ray's processes: those of one that has a folder of its own (RAY_TMPDIR, --temp-dir) are known by it."""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
from eval_fakes import wait_for

from vlagents_ray.ray_tools.reaper import has_open_files, is_titled


def words(process: psutil.Process) -> list[str]:
    """Its command line; empty if it has ended or is about to."""
    try:
        return process.cmdline()
    except psutil.Error:
        return []


@contextmanager
def ray_folder() -> Iterator[Path]:
    """A folder for a Ray of one's own, which is ended with it; short, because the names of sockets are limited."""
    folder = Path(tempfile.mkdtemp(prefix="r"))
    try:
        yield folder
    finally:
        end(folder)
        shutil.rmtree(folder, ignore_errors=True)


def processes(folder: Path, named: str = "") -> list[int]:
    """The processes of the Ray whose files are in `folder`, or those of them that are `named` so."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            command = (process / "cmdline").read_bytes()
            ours = str(folder).encode() in command + (process / "environ").read_bytes()
            ours = ours or (is_titled(process) and has_open_files(process, str(folder)))
        except OSError:  # it has ended, or is not ours
            continue
        program = command.partition(b"\0")[0]  # what follows may be what setproctitle left of the environment
        if ours and named.encode() in program:
            found.append(int(process.name))
    return found


def wait_for_end(folder: Path, *named: str) -> None:
    """Until no process of that Ray that is `named` so is left; says which are if they do not end."""
    try:
        wait_for(lambda: not any(processes(folder, name) for name in named))
    except TimeoutError as error:
        left = {pid: _said(pid) for name in named for pid in processes(folder, name)}
        raise AssertionError(f"still running: {left}") from error


def _said(pid: int) -> str:
    try:
        command = (Path("/proc") / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ")
        state = (Path("/proc") / str(pid) / "status").read_text().partition("State:")[2].split("\n")[0]
    except OSError:
        return "just ended"
    return f"{command[:200].decode(errors='replace')} ({state.strip()})"


def end(folder: Path) -> None:
    """Kill what is left of that Ray: two agents of a killed one take a minute to notice."""
    for pid in processes(folder):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    wait_for(lambda: not processes(folder))
