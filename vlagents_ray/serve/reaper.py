"""Cleans up after a driver that was killed: `python -m vlagents_ray.serve.reaper FOLDER`, its standard input a pipe.

A local cluster normally goes down with its driver. After `kill -9` some of it can stay: an HAProxy whose
manager was killed first, agents that take a minute to notice, the folder. This process hears of the
driver's death by the end of the pipe; a driver that ends in order says so first. Then only an HAProxy can
be left, one that was to stop once its last connection has ended.
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

MARK = "VLAGENTS_RAY_CLUSTER"  # in the environment of every process of the cluster
_GRACE_S = 3.0  # for Ray to end by itself
_ORDERLY = b"."
_SWEEPS = 20


@contextmanager
def reaped(folder: Path) -> Iterator[None]:
    """While this lasts, the death of this process takes the processes marked with `folder` along."""
    command = [sys.executable, "-m", "vlagents_ray.serve.reaper", str(folder)]
    reaper = subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)  # noqa: S603 - our own module
    if reaper.stdin is None:
        raise OSError("the reaper has no standard input")
    try:
        yield
    finally:
        with suppress(OSError):
            reaper.stdin.write(_ORDERLY)
        with suppress(OSError):
            reaper.stdin.close()
        reaper.wait()


def marked(folder: str) -> list[int]:
    """The processes of this user that were started for the cluster of `folder`."""
    mark = f"{MARK}={folder}".encode()
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if mark in (process / "environ").read_bytes().split(b"\0") and int(process.name) != os.getpid():
                found.append(int(process.name))
        except OSError:  # it has ended, or is another user's
            continue
    return found


def about(folder: str) -> list[int]:
    """Those of them whose command line names a file of the folder: an HAProxy, and none that a user started."""
    found = []
    for pid in marked(folder):
        with suppress(OSError):
            if f"{folder}/".encode() in Path(f"/proc/{pid}/cmdline").read_bytes():
                found.append(pid)
    return found


def main() -> None:
    """Wait for the end of the driver, and kill what outlives it."""
    folder = sys.argv[1]
    orderly = os.read(0, 1) == _ORDERLY
    if not orderly:
        time.sleep(_GRACE_S)
    for _ in range(_SWEEPS):  # what is killed may have been about to start another
        left = about(folder) if orderly else marked(folder)
        if not left:
            break
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(0.05)
    if not orderly:  # else the driver removes it
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
