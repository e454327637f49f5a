"""The measured load: how long requests have waited for the policy, and how long its thread was idle."""

from __future__ import annotations

import time


class LoadTimer:
    """Adds up the waiting time of requests and the idle time of the policy's thread, which is idle at first.

    Callers of `count` and `waited_s` must hold one lock; `idle_time_s` may be called on any thread.
    """

    def __init__(self) -> None:
        now = time.perf_counter()
        self._waited = 0.0  # total waiting time of all requests, s
        self._counted = now  # time up to which `_waited` is complete
        self._idle: tuple[float, float | None] = (0.0, now)  # total idle time, s, and start of the current idle period

    def count(self, waiting: int, now: float) -> None:
        """Add the time that `waiting` requests have waited until `now`, s, before their number changes."""
        self._waited += waiting * (now - self._counted)
        self._counted = now

    def waited_s(self, waiting: int) -> float:
        """Return the total waiting time of all requests, s, including the `waiting` ones that wait now."""
        return self._waited + waiting * max(0.0, time.perf_counter() - self._counted)

    def mark_idle(self) -> float:
        """Mark the policy's thread idle, and return the current time, s."""
        now = time.perf_counter()
        self._idle = (self._idle[0], now)
        return now

    def mark_busy(self) -> float:
        """Mark the policy's thread busy, and return the current time, s."""
        now = time.perf_counter()
        idle, since = self._idle
        self._idle = (idle if since is None else idle + now - since, None)
        return now

    def idle_time_s(self) -> float:
        """Return the total idle time of the policy's thread, s, including the current idle period."""
        idle, since = self._idle
        return idle if since is None else idle + max(0.0, time.perf_counter() - since)
