"""A clock that tests set."""

from __future__ import annotations


class Clock:
    """Shows what it is set to."""

    now = 0.0

    def __call__(self) -> float:
        return self.now
