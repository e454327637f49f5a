"""The child process of a replica, from its start to its end. It runs the program `child_main`."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from vlagents_ray.contract import Contract
from vlagents_ray.errors import ConfigError, PolicyFailed, PolicyUnavailable
from vlagents_ray.policies.base.program import Program
from vlagents_ray.policies.loading import (
    report_device,
    report_progress,
    report_uncompiled,
    report_variation,
)
from vlagents_ray.protocol.messages import LocalAddress
from vlagents_ray.serve.python_env import child_main
from vlagents_ray.serve.python_env.child_main import Settings

_CLOSE_S = 10.0
_EXIT_S = 2.0
_LAST_LINES = 20  # number of lines at the end of the child's error output that an error quotes


@dataclass(frozen=True, slots=True)
class ChildProgram:
    """The program of a child process: an interpreter and a policy."""

    python: str  # path of the interpreter
    settings: Settings
    env_vars: Mapping[str, str]  # further environment variables


@dataclass(frozen=True, slots=True)
class LoadedPolicy:
    """The policy that a child process has loaded."""

    address: LocalAddress  # address of the child's server, which receives the requests
    contract: Contract | None
    weights: dict[str, Any]  # see `ServedModel.weights`
    trained: dict[str, Any]  # the values that a learner trains, see `child_main`
    software: Program  # the software of the process

    @classmethod
    def from_json(cls, document: dict[str, Any]) -> LoadedPolicy:
        """Read the document with which a child process reports its policy."""
        contract = document["contract"]
        return cls(
            address=LocalAddress(**document["local"]),
            contract=None if contract is None else Contract.from_json(contract),
            weights=document["weights"],
            trained=document["trained"],
            software=document["software"],
        )


class ChildProcess:
    """A child process with a policy, which ends when this process ends for any reason."""

    def __init__(self, program: ChildProgram) -> None:
        """Start the process, which begins to load the policy.

        Raises:
            ConfigError: The interpreter cannot be started.
        """
        self._python = program.python
        # Last lines of the child's error output.
        self._last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self._closed = False

        # The kernel kills the child when the thread that started it ends; this thread ends after
        # the child.
        started: queue.SimpleQueue[subprocess.Popen[bytes] | OSError] = queue.SimpleQueue()
        self._runner = threading.Thread(
            target=self._run, args=[program, started], name="policy-process", daemon=True
        )
        self._runner.start()
        process = started.get()
        if isinstance(process, OSError):
            raise ConfigError(
                f"environment.python: {program.python!r} cannot be started here ({process})"
            ) from process
        self._process = process
        self._write(json.dumps(asdict(program.settings)).encode() + b"\n")

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    def wait_until_loaded(self) -> LoadedPolicy:
        """Report the steps of the load, and return the policy when it is loaded.

        Raises:
            PolicyFailed: The policy did not load.
        """
        while True:
            line = b"" if self._process.stdout is None else self._process.stdout.readline()
            if not line:
                self._runner.join(_EXIT_S)
                output = "".join(self._last_lines).strip()
                raise PolicyFailed(f"{self.describe_end()}; last output:\n{output}")
            document: dict[str, Any] = json.loads(line)
            if "step" not in document:
                break
            report_progress(document["step"])

        if "error" in document:
            raise PolicyFailed(f"in {self._python}: {document['error']}")
        for module in document["uncompiled"]:
            report_uncompiled(module)
        for device in document["devices"]:
            report_device(device)
        report_variation(document["variation"])
        return LoadedPolicy.from_json(document)

    def require_alive(self) -> None:
        """Raise `PolicyUnavailable` if the process has ended."""
        if self._process.poll() is not None:
            raise PolicyUnavailable(self.describe_end())

    def describe_end(self) -> str:
        """Return a sentence about the end of the process; its exit status is known shortly after
        its sockets close.
        """
        try:
            return f"the policy's process ended with exit status {self._process.wait(_EXIT_S)}"
        except subprocess.TimeoutExpired:
            return "the policy's process closed the connection"

    def close(self) -> None:
        """Close the policy, and end the process."""
        if self._closed:
            return
        self._closed = True
        self._write(b"\n")
        try:
            self._process.wait(_CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()

    def _run(
        self,
        program: ChildProgram,
        started: queue.SimpleQueue[subprocess.Popen[bytes] | OSError],
    ) -> None:
        """Start the process, copy its error output to the error output of this process, and wait
        until it ends.
        """
        try:
            process = subprocess.Popen(  # noqa: S603 - the deployment's own interpreter
                [program.python, "-m", child_main.__name__],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env={**os.environ, **program.env_vars},
            )
        except OSError as error:
            started.put(error)
            return
        started.put(process)
        if process.stderr is not None:
            with process.stderr as stream:
                for line in stream:
                    text = line.decode(errors="replace")
                    self._last_lines.append(text)
                    sys.stderr.write(text)
        process.wait()

    def _write(self, data: bytes) -> None:
        """Write to the standard input of the process; the end of the process is
        detected elsewhere.
        """
        stream = self._process.stdin
        if stream is not None:
            with contextlib.suppress(BrokenPipeError):
                stream.write(data)
                stream.flush()
