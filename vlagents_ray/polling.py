"""Polling for a message that is expected within microseconds, in place of a sleep."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

# A yield takes a microsecond if no other program waits for the core. Otherwise, it lasts for the
# time slice of the other program, which is 3 ms or more on Linux.
_LONG_YIELD_S = 500e-6
# In this time, a program that computes gets the core for hundreds of time slices, and one long
# yield costs less than a hundredth.
_PAUSE_S = 1.0


class Polling:
    """Polls for the next message of a connection without sleeping, while the core is free.

    A thread that sleeps needs tens of microseconds to wake up, about as long as a local request. A
    thread that polls receives the message at once, and yields the core to other programs between
    two looks. But a program that computes then keeps the core for a whole time slice, and a message
    does not end it, as the thread that polls is not asleep. So after a long yield, the thread does
    not poll for a second.
    """

    def __init__(self, limit_s: float) -> None:
        """Poll for at most `limit_s` seconds at a time."""
        self._limit_s = limit_s
        self._resume_at = 0.0  # time of the end of the pause, s of `perf_counter`

    def receives(self, poll: Callable[[int], object]) -> bool:
        """Return whether there is a message now, or within the limit.

        Args:
            poll: Called with 0; returns a true value if there is a message.
        """
        if poll(0):
            return True
        now = time.perf_counter()
        if now < self._resume_at:
            return False

        until = now + self._limit_s
        while now < until:
            os.sched_yield()
            before, now = now, time.perf_counter()
            if now - before > _LONG_YIELD_S:
                self._resume_at = now + _PAUSE_S
                return bool(poll(0))
            if poll(0):
                return True
        return False
