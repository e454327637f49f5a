"""The client's side of a benchmark's line protocol, for processes that
`benchmarks.line_process` starts.

A client writes one line of JSON when it is connected and warm. Then each line of its input is a
number of calls to make, which it answers with a JSON list of the calls' durations, ms. It ends when
its standard input or its parent ends. This file needs only the standard library, as the scripts of
other policy servers (`benchmarks/peers`) load it with a Python without vlagents_ray.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from typing import Any, TextIO

WARM_UP = 20  # number of calls before measuring


def timed(prepare: Callable[[], Any], call: Callable[[Any], object], calls: int) -> list[float]:
    """Make `calls` calls; return the duration of each, ms, without `prepare`, which makes the
    observation.
    """
    taken = []
    for _ in range(calls):
        obs = prepare()
        begun = time.perf_counter()
        call(obs)
        taken.append((time.perf_counter() - begun) * 1e3)
    return taken


def obey(
    lines: Iterable[str], out: TextIO, measure: Callable[[int], list[float]], said: dict[str, Any]
) -> None:
    """Warm up, write `said` to report that the client is ready, and answer each line until the
    input ends.
    """
    measure(WARM_UP)
    print(json.dumps(said), file=out, flush=True)
    for line in lines:
        print(json.dumps(measure(int(line))), file=out, flush=True)
