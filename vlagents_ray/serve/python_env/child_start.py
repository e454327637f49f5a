"""The first steps of a child process that answers its parent in lines. This module needs only the
standard library: the scripts of other policy servers (`benchmarks/peers`) load this file with a
Python without vlagents_ray.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from typing import TextIO

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Make the kernel kill this process when its parent ends for any reason. Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def own_stdout() -> TextIO:
    """Reserve the standard output for the answers, and return it; all other output goes to
    standard error.
    """
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return out
