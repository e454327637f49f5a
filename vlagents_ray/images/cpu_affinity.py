"""The CPU core on which a thread runs, and its affinity."""

from __future__ import annotations

import contextlib
import ctypes
import os
from collections.abc import Callable


def _getcpu() -> Callable[[], int]:
    """Return the C library's `sched_getcpu`, or a function that returns -1 where there is none."""
    if not hasattr(os, "sched_setaffinity"):
        return lambda: -1
    found: Callable[[], int] = getattr(ctypes.CDLL(None), "sched_getcpu", lambda: -1)
    return found


here: Callable[[], int] = _getcpu()
"""Return the core on which the calling thread runs; -1 if it is not known."""


def allowed() -> int:
    """Return the number of cores that this thread may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def leave(core: int) -> None:
    """Move the calling thread off `core` if it runs there and may run elsewhere; it may return later.

    Wake-affine scheduling, especially in virtual machines, can put two threads that wake each other on one core, and
    keeps them there as long as both run briefly.
    """
    if core < 0 or here() != core:
        return
    affinity = os.sched_getaffinity(0)
    if others := affinity - {core}:
        with contextlib.suppress(OSError):  # not permitted
            os.sched_setaffinity(0, others)
            os.sched_setaffinity(0, affinity)
