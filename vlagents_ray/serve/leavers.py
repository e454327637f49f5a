"""Which connections of a replica shall go to another one; see `vlagents_ray.serve.balance`."""

from __future__ import annotations

import time


class Leavers:
    """The connections that shall go to another replica; each is told once, with its next reply. Thread-safe."""

    def __init__(self) -> None:
        self._marked: set[str] = set()
        self._told: dict[str, float] = {}

    def mark(self, connections: set[str]) -> None:
        """These, and no others any more."""
        self._marked = connections

    def tell(self, connection: str) -> bool:
        """Shall the reply under way say so?"""
        if not self._marked or connection not in self._marked:
            return False
        self._marked.discard(connection)
        self._told[connection] = time.monotonic()
        return True

    def told_within(self, seconds: float) -> set[str]:
        """The connections that were told lately."""
        since = time.monotonic() - seconds
        return {connection for connection, when in list(self._told.items()) if when >= since}

    def forget_older(self, seconds: float) -> None:
        """Whoever was told before."""
        lately = self.told_within(seconds)
        for connection in list(self._told.keys() - lately):
            self._told.pop(connection, None)
