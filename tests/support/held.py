"""What this process holds: to see that a test leaves nothing, whatever of earlier tests ends meanwhile."""

from __future__ import annotations

import contextlib
import os
import threading


def descriptors() -> set[str]:
    """Open files and sockets, each told from any other that has its number later."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # the one that lists them, and what ends meanwhile
            found.add(f"{number}: {os.readlink(f'/proc/self/fd/{number}')}")
    return found


def running_threads() -> set[threading.Thread]:
    """Those that run."""
    return set(threading.enumerate())
