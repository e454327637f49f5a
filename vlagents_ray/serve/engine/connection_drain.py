"""The connections that a replica asks to reconnect; see `vlagents_ray.serve.scaling.rebalancer`."""

from __future__ import annotations

import time


class DrainList:
    """The connections that shall move to another replica; the next reply of each asks for that once. Thread-safe."""

    def __init__(self) -> None:
        self._marked: set[str] = set()
        self._asked: dict[str, float] = {}

    def mark(self, connections: set[str]) -> None:
        """Replace the set of connections asked to reconnect."""
        self._marked = connections

    def ask(self, connection: str) -> bool:
        """Return whether the current reply asks the connection to reconnect; if so, record that it was asked."""
        if not self._marked or connection not in self._marked:
            return False
        self._marked.discard(connection)
        self._asked[connection] = time.monotonic()
        return True

    def asked_within(self, seconds: float) -> set[str]:
        """Return the connections that were asked to reconnect within the last `seconds`."""
        since = time.monotonic() - seconds
        return {connection for connection, when in list(self._asked.items()) if when >= since}

    def forget_older(self, seconds: float) -> None:
        """Forget the connections that were asked to reconnect more than `seconds` ago."""
        lately = self.asked_within(seconds)
        for connection in list(self._asked.keys() - lately):
            self._asked.pop(connection, None)
