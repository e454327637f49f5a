"""A script that cleans up after a killed driver: `python reaper.py FOLDER`, with a pipe as its
standard input.

A local cluster normally ends with its driver. After `kill -9`, parts of the cluster can remain: an
HAProxy whose manager was killed first, agents that take a minute to exit, and the folder. The end
of the pipe signals that the driver has ended. A driver that exits in an orderly way, while its Ray
runs, first writes a byte to the pipe. In that case, only processes that use files of the folder can
remain: an HAProxy that waits for its last connection to close, and Ray's agents, which take a
moment to exit.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

MARK = "VLAGENTS_RAY_CLUSTER"  # environment variable of every process of the cluster
_GRACE_S = 3.0  # time that Ray has to end by itself
_ORDERLY = b"."
_SWEEPS = 200  # at least 10 s, since a killed process may end slowly on a busy machine
# The number of consecutive sweeps that must find nothing. More than one is needed, since a process
# has no environment during exec.
_QUIET_SWEEPS = 3


@contextmanager
def reaped(folder: Path, lost: type[Exception]) -> Iterator[None]:
    """End the processes marked with `folder` if this process dies within the context.

    An exception of the type `lost` within the context has the same effect, since a lost cluster
    does not end its remaining processes.
    """
    # The reaper runs as a script that must start quickly. This module therefore imports no other
    # module of the package.
    command = [sys.executable, "-I", __file__, str(folder)]
    reaper = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)  # noqa: S603 - our own module
    if reaper.stdin is None:
        raise OSError("the reaper has no standard input")
    message = _ORDERLY
    try:
        yield
    except lost:
        message = b""
        raise
    finally:
        with suppress(OSError):
            reaper.stdin.write(message)
        with suppress(OSError):
            reaper.stdin.close()
        reaper.wait()


def marked(folder: str) -> list[int]:
    """List this user's processes that were started for the cluster of `folder`.

    Ray may overwrite the mark in the environment of its processes with their titles. Those
    processes have their log files in the folder open, as do drivers that joined the cluster and
    continue.
    """
    mark = f"{MARK}={folder}".encode()
    pids = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            is_marked = mark in (process / "environ").read_bytes().split(b"\0")
            if not is_marked and is_titled(process):
                is_marked = has_open_files(process, folder)
        except OSError:  # the process has ended, or belongs to another user
            continue
        if is_marked and int(process.name) != os.getpid():
            pids.append(int(process.name))
    return pids


def is_titled(process: Path) -> bool:
    """Return whether Ray has set the title of a process.

    The process is specified as a folder of /proc.
    """
    return (process / "cmdline").read_bytes().startswith(b"ray::")


def has_open_files(process: Path, folder: str) -> bool:
    """Return whether a process has a file of `folder` open.

    The process is specified as a folder of /proc.

    Raises:
        OSError: The process has ended, or belongs to another user.
    """
    for descriptor in (process / "fd").iterdir():
        with suppress(OSError):  # the file was closed in the meantime
            if os.readlink(descriptor).startswith(f"{folder}/"):
                return True
    return False


def about(folder: str) -> list[int]:
    """List the marked processes that were not started by a user.

    Their command line contains the folder, or is a title set by Ray.
    """
    pids = []
    for pid in marked(folder):
        with suppress(OSError):
            process = Path(f"/proc/{pid}")
            if is_titled(process) or f"{folder}/".encode() in (process / "cmdline").read_bytes():
                pids.append(pid)
    return pids


def main() -> None:
    """Wait for the end of the driver, and kill the remaining processes."""
    # Systemd and Slurm signal every process of a service.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)

    folder = sys.argv[1]
    is_orderly = os.read(0, 1) == _ORDERLY
    if not is_orderly:
        time.sleep(_GRACE_S)

    quiet_sweeps = 0
    for _ in range(_SWEEPS):  # a process may have started another process before it was killed
        pids = about(folder) if is_orderly else marked(folder)
        quiet_sweeps = 0 if pids else quiet_sweeps + 1
        if quiet_sweeps == _QUIET_SWEEPS:
            break
        for pid in pids:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)

    if not is_orderly:  # otherwise the driver removes the folder
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
