"""The client's side of a benchmark's line protocol, for processes that `line_process` starts.

A client writes one line of JSON when it is connected and warm. Then each line of its input is a number of calls to
make, which it answers with a JSON list of their milliseconds. It ends with its standard input or with its parent. It
needs only the standard library: the scripts of other policy servers (`benchmarks/peers`) load this file with a Python
without vlagents_ray.
"""

from __future__ import annotations

import ctypes
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable
from typing import Any, TextIO

WARM_UP = 20  # calls
_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """Make the kernel kill this process when its parent ends, however that happens. Linux only."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def own_stdout() -> TextIO:
    """Reserve the standard output for the protocol, and return it; all other output goes to standard error."""
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    return out


def timed(prepare: Callable[[], Any], call: Callable[[Any], object], calls: int) -> list[float]:
    """Make `calls` calls; return the milliseconds of each, excluding `prepare`, which makes the observation."""
    taken = []
    for _ in range(calls):
        obs = prepare()
        begun = time.perf_counter()
        call(obs)
        taken.append((time.perf_counter() - begun) * 1e3)
    return taken


def obey(lines: Iterable[str], out: TextIO, measure: Callable[[int], list[float]], said: dict[str, Any]) -> None:
    """Warm up, write `said` to report that the client is ready, and answer each line until the input ends."""
    measure(WARM_UP)
    print(json.dumps(said), file=out, flush=True)
    for line in lines:
        print(json.dumps(measure(int(line))), file=out, flush=True)
