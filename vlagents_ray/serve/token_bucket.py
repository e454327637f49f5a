"""A token bucket, which limits a rate and allows bursts."""

from __future__ import annotations


class TokenBucket:
    """Tokens that are refilled at a rate. Not thread-safe."""

    def __init__(self, rate: float, now: float, capacity: float | None = None) -> None:
        """Create a full bucket.

        Args:
            rate: Tokens that are added each second.
            now: The current time, s.
            capacity: Maximum number of tokens; by default the tokens of one second, at least one.
        """
        self.rate = rate
        self._tokens = self._capacity = max(1.0, rate) if capacity is None else capacity
        self._refilled = now

    def take(self, now: float, number: int = 1) -> float:
        """Take `number` tokens and return 0 if there are enough; otherwise return the time until
        there are enough, s.

        The number must not exceed the capacity.
        """
        self._refill(now)
        if self._tokens < number:
            return (number - self._tokens) / self.rate
        self._tokens -= number
        return 0.0

    def owe(self, now: float, number: float) -> None:
        """Take `number` tokens even if there are fewer; `take` then waits for the difference."""
        self._refill(now)
        self._tokens -= number

    def give_back(self, number: int = 1) -> None:
        """Return tokens that were taken but not needed."""
        self._tokens += number

    def _refill(self, now: float) -> None:
        self._tokens = min(self._capacity, self._tokens + (now - self._refilled) * self.rate)
        self._refilled = now
