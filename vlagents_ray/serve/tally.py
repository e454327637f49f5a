"""How long requests have waited for the policy, and how long its thread had nothing to do: the measured load."""

from __future__ import annotations

import time


class Tally:
    """Begins with a thread that sleeps. `count` and `waited_s` under one lock; `slept_s` on any thread."""

    def __init__(self) -> None:
        now = time.perf_counter()
        self._waited = 0.0  # s, of all requests together
        self._counted = now  # until when they are in `_waited`
        self._sleep: tuple[float, float | None] = (0.0, now)  # s slept, and since when it sleeps now

    def count(self, waiting: int, now: float) -> None:
        """So many have waited until now; their number is about to change."""
        self._waited += waiting * (now - self._counted)
        self._counted = now

    def waited_s(self, waiting: int) -> float:
        """Of all requests together, those that wait now included."""
        return self._waited + waiting * max(0.0, time.perf_counter() - self._counted)

    def sleeps(self) -> None:
        """From now on the thread has nothing to do."""
        self._sleep = (self._sleep[0], time.perf_counter())

    def wakes(self) -> None:
        """It has."""
        self._sleep = (self.slept_s(), None)

    def slept_s(self) -> float:
        """In all, the sleep that it is in included."""
        slept, since = self._sleep
        return slept if since is None else slept + max(0.0, time.perf_counter() - since)
