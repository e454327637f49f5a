"""Clients that are measured in turns: `Driver`, and a client in a process with the line
protocol.
"""

from __future__ import annotations

from typing import Any, Protocol

from benchmarks.line_process import LineProcess

START_S = 90.0
CALL_S = 30.0


class Driver(Protocol):
    """A connected client, which makes calls in its turn."""

    def ready(self) -> dict[str, Any]:
        """Wait until the client is connected and warm, and return its description."""

    def measure(self, calls: int) -> list[float]:
        """Make calls, and return their durations, ms."""


class ProcessDriver(Driver, Protocol):
    """A driver whose client is another process."""

    pid: int  # process id of the client, once the client is ready
    # Id of the process that has started the client's server; None for this process.
    server_pid: int | None


class ClientProcess(LineProcess):
    """A client in a process, which runs `benchmarks.line_client.obey`."""

    server_pid: int | None = None

    def ready(self) -> dict[str, Any]:
        """Read the first line of a client: the description that the client writes when it is
        connected and warm.
        """
        said: dict[str, Any] = self.read(START_S)
        return said

    def measure(self, calls: int) -> list[float]:
        """Make calls in the client's process, and return their durations, ms."""
        taken: list[float] = self.request(str(calls), CALL_S + calls)
        return taken
