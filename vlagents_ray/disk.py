"""Errors of the disk as `StorageFailed`, whose message contains the cause and the cure."""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from vlagents_ray.errors import StorageFailed


class _DiskError(NamedTuple):
    """An error of the disk in words."""

    cause: str
    cure: str
    may_continue: bool = True  # whether the same folder can be used again after the cure


_NOT_WRITABLE = "make it writable, or choose another folder"
_ERRORS = {
    errno.ENOSPC: _DiskError("the disk is full", "make room"),
    errno.EDQUOT: _DiskError("your quota on this disk is used up", "make room"),
    errno.EFBIG: _DiskError(
        "a file would be larger than is allowed here (ulimit -f)", "allow more"
    ),
    errno.EIO: _DiskError(
        "the disk reports an error", "see the system's log (dmesg), and repair the disk"
    ),
    errno.ESTALE: _DiskError("the file server has lost the folder", "mount it again"),
    errno.EROFS: _DiskError("is on a read-only file system", _NOT_WRITABLE, False),
    errno.EACCES: _DiskError("you may not write there", _NOT_WRITABLE, False),
    errno.EPERM: _DiskError("you may not write there", _NOT_WRITABLE, False),
    errno.ENOTDIR: _DiskError("a part of the path is not a folder", "choose another folder", False),
    errno.EEXIST: _DiskError("exists and is not a folder", "choose another folder", False),
}
# SQLite reports these texts instead of the system's errno.
_SQLITE = {
    "database or disk is full": errno.ENOSPC,
    "attempt to write a readonly database": errno.EROFS,
    "unable to open database file": errno.EACCES,
    "disk I/O error": errno.EIO,
}


@contextmanager
def storing(folder: Path, kept: str) -> Iterator[None]:
    """Return a context manager that replaces disk errors in `folder` with `StorageFailed`, whose
    message contains the cause and the cure. Other errors are unchanged.

    Use the context only around code in which every `OSError` is a disk error.

    Args:
        folder: The folder for the message.
        kept: The data that are kept, and how to continue after the cure, for the message.
    """
    try:
        yield
    except (OSError, sqlite3.OperationalError) as error:
        number = error.errno if isinstance(error, OSError) else _SQLITE.get(str(error))
        if isinstance(error, sqlite3.OperationalError) and number == errno.EACCES:
            disk = os.statvfs(_existing(folder))
            if disk.f_flag & os.ST_RDONLY:
                number = errno.EROFS

        if number not in _ERRORS:
            raise
        cause, cure, may_continue = _ERRORS[number]
        advice = f"{cure}; {kept}" if may_continue else cure
        raise StorageFailed(f"{folder}: {cause} ({error}); {advice}") from error


def require_free(folder: Path, least_bytes: float) -> int:
    """Return the free space of a folder's disk, bytes; the folder need not exist.

    Raises:
        StorageFailed: There are fewer than `least_bytes`.
    """
    free_bytes = shutil.disk_usage(_existing(folder)).free
    if free_bytes < least_bytes:
        raise StorageFailed(
            f"{folder}: expected at least {least_bytes / 1e6:g} MB of free disk space, got "
            f"{free_bytes / 1e6:.1f} MB; make room, or choose another folder"
        )
    return free_bytes


def _existing(folder: Path) -> Path:
    """Return the folder, or the nearest folder above it that exists."""
    folders = (folder, *folder.absolute().parents)
    return next(path for path in folders if path.exists())
