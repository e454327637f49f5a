"""Processes of a benchmark that answer lines of text, and end with this process."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any, cast

from typing_extensions import Self

from vlagents_ray.errors import VLAgentsError

_END_S = 10.0  # time for a process to end, s
_LOOK_S = 0.5  # interval between checks of a server for whose clients this process waits, s
_SHOWN_CHARACTERS = 2000  # number of characters of a failed process's standard error in a message


class ProcessFailed(VLAgentsError):
    """A process of a benchmark ended or did not answer; the message has its last errors."""


class LineProcess:
    """A process that answers each line with a line of JSON. If it fails, its errors are shown."""

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str | None] | None = None,
        *,
        end_s: float = _END_S,
    ) -> None:
        """Start the process.

        Args:
            name: A name for errors.
            command: The program and its arguments.
            environment: Changes to the environment variables of this process; None removes one.
            end_s: Time for the process to end after its input is closed, s.
        """
        variables = {**os.environ, **(environment or {})}
        child_environment = {}
        for variable, value in variables.items():
            if value is not None:
                child_environment[variable] = value

        self.name = name
        self._end_s = end_s
        self._received = b""  # the bytes after the last complete line of the output
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._process = subprocess.Popen(
            list(command),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env=child_environment,
            # Ctrl-C reaches only this process, which ends its children in order.
            start_new_session=True,
        )
        self._input = cast(IO[bytes], self._process.stdin)
        self._output = cast(IO[bytes], self._process.stdout)
        self.pid = self._process.pid

    def read(self, timeout_s: float, server: LineProcess | None = None) -> Any:
        """Return the next line that the process writes, decoded from JSON.

        Args:
            timeout_s: Time limit for the answer, s.
            server: The process for which this process waits; if the server has ended, no answer is
                expected.

        Raises:
            ProcessFailed: The process or its server ended, or the process did not answer in time,
                or wrote something else.
        """
        deadline = time.monotonic() + timeout_s
        while b"\n" not in self._received:
            remaining_s = max(0.0, deadline - time.monotonic())
            wait_s = remaining_s if server is None else min(remaining_s, _LOOK_S)
            ready, _, _ = select.select([self._output], [], [], wait_s)
            if not ready:
                if server is not None:
                    server.require_running()
                if time.monotonic() < deadline:
                    continue
                raise self._failure(f"no answer within {timeout_s:g} s")
            data = os.read(self._output.fileno(), 2**16)
            if not data:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(_END_S)
                raise self._failure(f"ended with exit status {self._process.returncode}")
            self._received += data

        line, _, self._received = self._received.partition(b"\n")
        try:
            return json.loads(line)
        except ValueError as error:
            raise ProcessFailed(
                f"{self.name}: expected a line of JSON, got {line[:80]!r}"
            ) from error

    def require_running(self) -> None:
        """Raise `ProcessFailed`, with the last errors of the process, if it has ended."""
        status = self._process.poll()
        if status is not None:
            raise self._failure(f"ended with exit status {status}")

    def send(self, line: str) -> None:
        """Send a line, without waiting for the answer."""
        with contextlib.suppress(BrokenPipeError):  # the next `read` raises an error
            self._input.write(line.encode() + b"\n")
            self._input.flush()

    def request(self, line: str, timeout_s: float) -> Any:
        """Send a line, and return the answer; raises the errors of `read`."""
        self.send(line)
        return self.read(timeout_s)

    def close(self) -> None:
        """Close the standard input of the process, which ends it, and kill it if it continues."""
        with contextlib.suppress(OSError):
            self._input.close()
        try:
            self._process.wait(self._end_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._output.close()
        self._errors.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def _failure(self, what: str) -> ProcessFailed:
        """Return an error that describes what happened to the process, with its last errors."""
        return ProcessFailed(f"{self.name}: {what}\n{self._last_errors()}".rstrip())

    def _last_errors(self) -> str:
        """Return the end of the process's standard error."""
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, size - _SHOWN_CHARACTERS))
        return self._errors.read().decode(errors="replace").strip()


def our_environment() -> dict[str, str]:
    """Return the environment variables with which a child process can import the packages of this
    checkout, even if they are not installed.
    """
    checkout = str(Path(__file__).parents[1])
    inherited = [folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder]
    return {"PYTHONPATH": os.pathsep.join(dict.fromkeys([checkout, *inherited]))}
