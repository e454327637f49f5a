"""The processor core that a thread runs on, and how to get off one."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Callable


def _getcpu() -> Callable[[], int]:
    """The C library's `sched_getcpu`; -1 where there is none."""
    if not hasattr(os, "sched_setaffinity"):
        return lambda: -1
    found: Callable[[], int] = getattr(ctypes.CDLL(None), "sched_getcpu", lambda: -1)
    return found


here: Callable[[], int] = _getcpu()
"""The core that the calling thread runs on; -1 if that is not known."""


def allowed() -> int:
    """How many cores this thread may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def leave(core: int) -> None:
    """Move the calling thread off `core`, if it runs there and may run elsewhere; it may come back.

    Two threads that wake each other are put on one core by a kernel that takes the others for asleep, as in
    virtual machines, and stay there for as long as they are quick.
    """
    if core < 0 or here() != core:
        return
    may = os.sched_getaffinity(0)
    if elsewhere := may - {core}:
        with contextlib.suppress(OSError):  # forbidden here
            os.sched_setaffinity(0, elsewhere)
            os.sched_setaffinity(0, may)
