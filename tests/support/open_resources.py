"""The open files and threads of this process.

Policies that tests serve import this module in each replica, so it does not import pytest.
"""

from __future__ import annotations

import contextlib
import os
import re
import threading


def descriptors() -> set[str]:
    """Return open files and sockets. A reused descriptor number counts as a different
    descriptor.
    """
    files = set()
    for number in os.listdir("/proc/self/fd"):
        # The descriptor of this listing and recently closed ones no longer exist.
        with contextlib.suppress(FileNotFoundError):
            files.add(f"{number}: {os.readlink(f'/proc/self/fd/{number}')}")
    return files


def running_threads() -> set[threading.Thread]:
    """Return the running threads."""
    return set(threading.enumerate())


def unpooled_threads() -> list[str]:
    """Return the names of threads outside of executors, since the pools of executors grow up to a
    size.
    """
    return [thread.name for thread in threading.enumerate() if not re.search(r"_\d+$", thread.name)]
