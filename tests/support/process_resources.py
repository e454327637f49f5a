"""The open files and running threads of this process, to check that a test leaves none of its own behind."""

from __future__ import annotations

import contextlib
import os
import threading


def descriptors() -> set[str]:
    """Open files and sockets; a descriptor whose number is used again counts as another one."""
    found = set()
    for number in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):  # the descriptor of this listing, and those closed meanwhile
            found.add(f"{number}: {os.readlink(f'/proc/self/fd/{number}')}")
    return found


def running_threads() -> set[threading.Thread]:
    """The threads that run now."""
    return set(threading.enumerate())
