"""What the README shows works: every Python and shell block in it is run, or says why not."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from readme_blocks import DOCUMENTED_HOST, ENV, PYTHON, ROOT, SHELL, Block, blocks, check_commands, run

README = ROOT / "README.md"
START_S, STOP_S = 180, 60


@contextlib.contextmanager
def serving(policy: str, log: Path) -> Iterator[str]:
    """`vlagents-ray serve POLICY` on a free port; yields "host:port" once it is healthy."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        host = f"127.0.0.1:{free.getsockname()[1]}"
    command = ["vlagents-ray", "serve", policy, "--port", host.rpartition(":")[2]]
    with log.open("w") as output:
        server = subprocess.Popen(
            [shutil.which(command[0], path=ENV["PATH"]) or command[0], *command[1:]],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=ENV,
        )
    try:
        deadline = time.monotonic() + START_S
        while not healthy(host):
            assert server.poll() is None, f"{shlex.join(command)} ended:\n{log.read_text()}"
            assert time.monotonic() < deadline, f"{shlex.join(command)} is not healthy:\n{log.read_text()}"
            time.sleep(0.2)
        yield host
    finally:
        server.send_signal(signal.SIGINT)
        try:
            server.wait(STOP_S)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()
            raise


def healthy(host: str) -> bool:
    try:
        with urllib.request.urlopen(f"http://{host}/healthz", timeout=5) as answer:
            return answer.status == 200
    except (urllib.error.URLError, OSError):
        return False


@pytest.fixture(scope="module")
def host_of(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[str | None], str]]:
    """A policy's "host:port"; its server is started when first asked for. One runs at a time."""
    with contextlib.ExitStack() as running:
        current: dict[str, str] = {}

        def host(policy: str | None) -> str:
            if policy is None:
                return DOCUMENTED_HOST
            if policy not in current:
                running.close()
                current.clear()
                log = tmp_path_factory.mktemp("serve") / "log"
                current[policy] = running.enter_context(serving(policy, log))
            return current[policy]

        yield host


def readme_blocks() -> list[Block]:
    return blocks(README.read_text()) if README.exists() else []


def test_the_readme_has_python_and_shell_blocks() -> None:
    languages = {block.language for block in readme_blocks()}
    assert languages & PYTHON
    assert languages & SHELL


@pytest.mark.parametrize(
    "block",
    [pytest.param(b, id=str(b), marks=[] if b.not_run else [pytest.mark.slow]) for b in readme_blocks()],
)
def test_a_readme_block_works(block: Block, host_of: Callable[[str | None], str], tmp_path: Path) -> None:
    if block.not_run is None:
        run(block, tmp_path, host_of(block.server))
    elif block.language in PYTHON:
        compile(block.source, README.name, "exec")
    else:
        check_commands(block)
