"""Clients that make calls when it is their turn: `Driver`, and one in a process that obeys the line protocol."""

from __future__ import annotations

from typing import Any, Protocol

from vlagents_ray.bench.line_process import LineProcess

START_S = 90.0
CALL_S = 30.0


class Driver(Protocol):
    """A client that is connected and makes calls when it is its turn."""

    def ready(self) -> dict[str, Any]:
        """Wait until it is connected and warm; returns what it says of itself."""

    def measure(self, calls: int) -> list[float]:
        """Make calls; returns the milliseconds of each."""


class ClientProcess(LineProcess):
    """A client in a process, which runs `vlagents_ray.bench.line_client.obey`."""

    def ready(self) -> dict[str, Any]:
        """Read the first line of a client, which is connected and warm then: what it says of itself."""
        said: dict[str, Any] = self.read(START_S)
        return said

    def measure(self, calls: int) -> list[float]:
        """Let a client make calls; returns the milliseconds of each."""
        taken: list[float] = self.request(str(calls), CALL_S + calls)
        return taken
