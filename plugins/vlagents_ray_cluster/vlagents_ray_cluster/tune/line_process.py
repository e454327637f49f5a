"""Processes of a benchmark: each implements a line protocol, and never outlives this process."""

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

import vlagents_ray
from vlagents_ray.errors import VLAgentsError

_END_S = 10.0
_KEPT = 2000  # characters of a failed process's standard error that are shown


class ProcessFailed(VLAgentsError):
    """A process of a benchmark, ours or a peer's, ended or did not answer; the message has the
    end of its errors.
    """


class LineProcess:
    """A process that answers lines with lines of JSON. Its standard error is shown if it fails.

    It has the environment variables of this process, changed by `environment`; None removes one.
    """

    def __init__(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str | None] | None = None,
        *,
        end_s: float = _END_S,
    ) -> None:
        self.name = name
        self._end_s = end_s  # time for the process to end after its input
        self._received = b""  # the bytes after the last complete line
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._process = subprocess.Popen(  # noqa: S603 - the bench's own scripts
            list(command),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            env={
                name: value
                for name, value in {**os.environ, **(environment or {})}.items()
                if value is not None
            },
            start_new_session=True,  # Ctrl-C goes to the bench, which ends its children in order
        )
        self._input, self._output = (
            cast(IO[bytes], self._process.stdin),
            cast(IO[bytes], self._process.stdout),
        )
        self.pid = self._process.pid

    def read(self, timeout_s: float) -> Any:
        """Read the next line that the process writes, decoded; raises `ProcessFailed` on its end
        or a time-out.
        """
        deadline = time.monotonic() + timeout_s
        while b"\n" not in self._received:
            ready, _, _ = select.select(
                [self._output], [], [], max(0.0, deadline - time.monotonic())
            )
            if not ready:
                raise ProcessFailed(
                    f"{self.name}: no answer within {timeout_s:g} s\n{self._last_errors()}".rstrip()
                )
            if not (more := os.read(self._output.fileno(), 2**16)):
                with contextlib.suppress(subprocess.TimeoutExpired):
                    self._process.wait(_END_S)
                status = self._process.returncode
                raise ProcessFailed(
                    f"{self.name}: ended with exit status {status}\n{self._last_errors()}".rstrip()
                )
            self._received += more
        line, _, self._received = self._received.partition(b"\n")
        try:
            return json.loads(line)
        except ValueError as error:
            raise ProcessFailed(f"{self.name}: wrote {line[:80]!r}, want a line of JSON") from error

    def send(self, line: str) -> None:
        """Send a line, without waiting for the answer."""
        with contextlib.suppress(BrokenPipeError):  # `read` raises the reason
            self._input.write(line.encode() + b"\n")
            self._input.flush()

    def request(self, line: str, timeout_s: float) -> Any:
        self.send(line)
        return self.read(timeout_s)

    def close(self) -> None:
        """Close the standard input of the process, which ends it; kill it if it continues."""
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

    def _last_errors(self) -> str:
        self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, self._errors.tell() - _KEPT))
        return self._errors.read().decode(errors="replace").strip()


def our_environment() -> dict[str, str]:
    """Return the environment variables with which a child process finds this package and the
    core, installed or not.
    """
    core = str(Path(vlagents_ray.__file__).parents[1])
    plugin = str(Path(__file__).parents[2])
    inherited = [folder for folder in os.environ.get("PYTHONPATH", "").split(os.pathsep) if folder]
    return {"PYTHONPATH": os.pathsep.join(dict.fromkeys([core, plugin, *inherited]))}
