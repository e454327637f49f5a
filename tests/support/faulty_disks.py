"""Full or read-only disks for one command, mounted in a namespace that is invisible to other
processes.
"""

from __future__ import annotations

import itertools
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from vlagents_ray.errors import StorageFailed

FULL = "mount -t tmpfs -o size={size} tmpfs '{folder}'"  # a size that soon fills up
READ_ONLY = "mount --bind '{folder}' '{folder}' && mount -o remount,ro,bind '{folder}'"
_HERE = Path(__file__).parent


def python_on(
    mount: str, folder: Path, code: str, *words: str, **options: str
) -> subprocess.CompletedProcess[str]:
    """Run Python `code` after `mount` was applied to `folder`. `sys.argv[1]` is the folder,
    followed by `words`. Root privileges are required.
    """
    mounted = mount.format(folder=folder, **options)
    command = [
        "unshare",
        "--mount",
        "sh",
        "-c",
        f'{mounted} && exec "$@"',
        "sh",
        sys.executable,
        "-c",
        code,
    ]
    path = os.pathsep.join((str(_HERE), str(_HERE.parents[1])))
    return subprocess.run(
        [*command, str(folder), *words],
        capture_output=True, text=True, check=False, env=os.environ | {"PYTHONPATH": path},
    )  # fmt: skip


@contextmanager
def filled(
    disk: Path, *, free_bytes: int | None = None, free_files: int | None = None
) -> Iterator[None]:
    """Fill a small disk until it has this much free space, or this number of free files, and empty
    it at the end.
    """
    ballast = disk / "ballast"
    ballast.mkdir()
    try:
        if free_bytes is not None:
            space = os.statvfs(disk)
            (ballast / "bytes").write_bytes(bytes(space.f_bavail * space.f_frsize - free_bytes))
        if free_files is not None:
            for number in range(os.statvfs(disk).f_favail - free_files):
                (ballast / str(number)).touch()
        yield
    finally:
        shutil.rmtree(ballast)


def at_each_write(disk: Path, write: Callable[[Path], None], check: Callable[[Path], None]) -> int:
    """Write on a disk that fills at each write in turn, and then again in the same folder, on the
    disk with room.

    Args:
        disk: The folder where the disk is mounted.
        write: Writes into a folder; it must raise `StorageFailed` if the disk is full.
        check: Fails if the files in the folder, after writing with room, are not as they should be.

    Returns:
        The number of failed writes.
    """
    failed = 0
    page = os.statvfs(disk).f_frsize
    for kind, size in (("free_bytes", page), ("free_files", 1)):
        for number in itertools.count():
            root = disk / f"{kind}-{number}"
            try:
                with filled(disk, **{kind: number * size}):
                    write(root)
            except StorageFailed as error:
                failed += 1
                require_one_sentence(str(error))
                write(root)
            else:
                check(root)
                break
            check(root)
            shutil.rmtree(root)
    return failed


def require_one_sentence(message: str) -> None:
    """Fail unless the message of a full disk is one line with the cause and the cure."""
    assert "the disk is full" in message, message
    assert "make room; " in message, message
    assert "\n" not in message, message
