"""Makes load with clients that send their next request at each answer; each client has a thread.

It needs only the standard library: the scripts of other policy servers (`benchmarks/peers`) load
this file with a Python without vlagents_ray.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

Act = Callable[[], tuple[float, float, int]]  # round trip, ms; inference, ms; size of the batch
# End, s of `time.monotonic`, followed by the values of `Act`.
Call = tuple[float, float, float, int]
# Maximum pause of a robot after an answer, so that its requests meet batches at any stage, s.
_THINK_S = 0.05


class ClosedLoop:
    """The clients of one process: first `robots` robots, then simulations."""

    def __init__(self, acts: Sequence[Act], robots: int) -> None:
        self._robots, self._simulations = acts[:robots], acts[robots:]
        self._pool = ThreadPoolExecutor(len(acts))

    def run(self, robots: int, simulations: int, begin: float, end: float) -> list[list[Call]]:
        """Run some of the clients until `end`, s of `time.monotonic`; all processes begin at the
        same moment.

        Returns:
            For each client, robots first, the calls that ended after `begin`.
        """
        chosen = [(act, _THINK_S) for act in self._robots[:robots]]
        chosen += [(act, 0.0) for act in self._simulations[:simulations]]
        return [
            one.result()
            for one in [self._pool.submit(self._repeat, *each, begin, end) for each in chosen]
        ]

    def close(self) -> None:
        self._pool.shutdown()

    @staticmethod
    def _repeat(act: Act, think_s: float, begin: float, end: float) -> list[Call]:
        calls = []
        think = random.Random(0)
        while time.monotonic() < end:
            if think_s:
                time.sleep(think.uniform(0, think_s))
            try:
                call = act()
            except TimeoutError:  # the server's batch waits for clients that have ended
                if time.monotonic() < end:
                    raise
                break
            ended = time.monotonic()
            if begin <= ended < end:
                calls.append((ended, *call))
        return calls
