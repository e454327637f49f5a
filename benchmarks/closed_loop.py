"""Load by clients that act again at each answer, a thread for each.

It needs only the standard library: the scripts of other policy servers (`benchmarks/peers`) load
this file with a Python without vlagents_ray.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

Act = Callable[[], tuple[float, float, int]]  # round trip, ms; inference, ms; size of the batch
Call = tuple[float, float, float, int]  # end, s of time.monotonic; then as `Act`
_THINK_S = 0.05  # longest pause of a robot after an answer, so that it meets batches at any stage


class ClosedLoop:
    """Clients of one process: `robots` robots, and after them simulations."""

    def __init__(self, acts: Sequence[Act], robots: int) -> None:
        self._robots, self._simulations = acts[:robots], acts[robots:]
        self._pool = ThreadPoolExecutor(len(acts))

    def run(self, robots: int, simulations: int, begin: float, end: float) -> list[list[Call]]:
        """Run some of the clients until `end`, s of `time.monotonic`; all processes begin at the
        same moment.

        Returns:
            For each client, robots first, its calls that ended after `begin`.
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
            except TimeoutError:  # of a server whose batch waits for clients that have ended
                if time.monotonic() < end:
                    raise
                break
            ended = time.monotonic()
            if begin <= ended < end:
                calls.append((ended, *call))
        return calls
