"""The CPU cores on which a thread runs, and may run."""

from __future__ import annotations

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
