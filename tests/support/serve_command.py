"""`vlagents-ray serve` as users run it, in a process of its own."""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

from readme_blocks import ENV

from vlagents_ray.serve.ports import free_port

START_S, STOP_S = 180, 180


def free_address() -> str:
    """A "host:port" on which nobody listens."""
    return f"127.0.0.1:{free_port()}"


@contextlib.contextmanager
def serving(
    policy: str, log: Path, address: str | None = None, *options: str, cwd: Path | None = None
) -> Iterator[str]:
    """A server for the length of the context, on a free port unless one is given; yields "host:port" once healthy.

    With a `cwd` it is as a reader types it there: what tests add to PYTHONPATH is not in it.
    """
    address = address or free_address()
    command = ["vlagents-ray", "serve", policy, "--port", address.rpartition(":")[2], *options]
    with log.open("w") as output:
        server = subprocess.Popen(
            [shutil.which(command[0], path=ENV["PATH"]) or command[0], *command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=cwd,
            # As tests have set it meanwhile.
            env=ENV if cwd is not None else ENV | {"PYTHONPATH": os.environ.get("PYTHONPATH", "")},
        )
    try:
        deadline = time.monotonic() + START_S
        while not healthy(address):
            assert server.poll() is None, f"{shlex.join(command)} ended:\n{log.read_text()}"
            assert time.monotonic() < deadline, f"{shlex.join(command)} is not healthy:\n{log.read_text()}"
            time.sleep(0.2)
        yield address
    finally:
        server.terminate()  # as Ctrl-C, which what a shell runs in the background never hears
        try:
            server.wait(STOP_S)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
            raise


def healthy(address: str) -> bool:
    """Does it answer, with its policy loaded?"""
    try:
        with urllib.request.urlopen(f"http://{address}/healthz", timeout=5) as answer:
            return answer.status == 200
    except (urllib.error.URLError, OSError):
        return False
