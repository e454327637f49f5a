"""The lock on a folder of results, which one evaluation at a time holds while it writes there."""

from __future__ import annotations

import errno
import fcntl
import os
import time
from pathlib import Path

from vlagents_ray.errors import ConfigError

FILE = "results.lock"
_NO_LOCKS = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK)
_READER_S = 1.0  # more than `is_held` of another process holds the lock
_AGAIN_S = 0.01


def acquire(out: Path) -> int:
    """Lock the folder `out`.

    Returns:
        A descriptor: whoever closes it releases the lock, as does the system when this process ends.

    Raises:
        ConfigError: Another evaluation holds the lock, or the file system knows no locks.
    """
    file = os.open(out / FILE, os.O_RDWR | os.O_CREAT, 0o644)
    give_up = time.monotonic() + _READER_S
    while True:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            if time.monotonic() < give_up:
                time.sleep(_AGAIN_S)
                continue
            os.close(file)
            raise ConfigError(
                f"{out}: another evaluation is writing there; wait for it, or choose another folder"
            ) from error
        except OSError as error:
            os.close(file)
            if error.errno not in _NO_LOCKS:
                raise
            raise ConfigError(
                f"{out}: its file system knows no locks ({error.strerror}), so that two evaluations could write to one "
                f"folder; choose another one with --out (Lustre: have it mounted with `-o flock`)"
            ) from error
        return file


def is_held(out: Path) -> bool:
    """Whether an evaluation holds the lock of the folder `out`; it is taken to, where that cannot be known."""
    try:
        file = os.open(out / FILE, os.O_RDONLY)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False
