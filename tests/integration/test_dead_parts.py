"""Processes that die next to a server or an evaluation: HAProxy is restarted, and without Ray the
command ends with all its processes.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import pytest
from eval_fakes import wait_for
from ray_processes import free_address, healthy

from vlagents_ray import ConfigError
from vlagents_ray.evaluate import Results

# A variable in the environment of all processes that the command starts.
MINE = "VLAGENTS_RAY_TEST_COMMAND"


@contextmanager
def running(log: Path, *words: str) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of this package, and kill its remaining processes at the end."""
    with log.open("w") as output:
        command = subprocess.Popen(
            [sys.executable, "-c", "from vlagents_ray.cli import main; main()", *words],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=os.environ | {MINE: str(log), "PYTHONUNBUFFERED": "1"},
        )
    try:
        yield command
    finally:
        for pid in processes(log):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        command.wait()


def processes(log: Path, program: str = "") -> list[int]:
    """Return the processes of the command, or only those that run `program`."""
    found = []
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            words = (process / "cmdline").read_bytes().split(b"\0")
            mine = f"{MINE}={log}".encode() in (process / "environ").read_bytes().split(b"\0")
            if (
                mine
                and int(process.name) != os.getpid()
                and Path(os.fsdecode(words[0])).name.endswith(program)
            ):
                found.append(int(process.name))
    return found


def gone(log: Path, started: list[psutil.Process]) -> None:
    """Fail unless all processes that the command started end soon. A process title may hide the
    environment of a process.
    """
    _, left = psutil.wait_procs(started, 30)
    if left or processes(log):
        pytest.fail(f"still running: {left or processes(log)}\n{log.read_text()[-4000:]}")


def kill(log: Path, program: str) -> list[int]:
    """Kill the processes that run `program`, and return them."""
    victims = processes(log, program)
    assert victims, f"no {program} runs"
    for pid in victims:
        os.kill(pid, signal.SIGKILL)
    return victims


@pytest.mark.slow
def test_a_server_gets_haproxy_back_and_ends_without_ray_leaving_nothing(tmp_path: Path) -> None:
    log, address = tmp_path / "serve.log", free_address()
    with running(log, "serve", "noop", "--port", address.rpartition(":")[2]) as server:
        wait_for(
            lambda: (
                (healthy(address) and "serving" in log.read_text()) or server.poll() is not None
            ),
            180,
        )
        assert server.poll() is None, log.read_text()
        ended = kill(log, "haproxy")  # HAProxy accepts the clients' connections
        killed = time.monotonic()
        wait_for(lambda: set(processes(log, "haproxy")) - set(ended) and healthy(address))
        print(f"HAProxy: killed, and restarted after {time.monotonic() - killed:.1f} s")
        started = psutil.Process(server.pid).children(recursive=True)
        kill(log, "raylet")
        killed = time.monotonic()
        assert server.wait(180) == 1
        print(f"raylet: killed, and the server ended after {time.monotonic() - killed:.1f} s")
        gone(log, started)
        said = log.read_text()
        cause = "Ray's daemon on this machine, the raylet, has ended; start it again"
        # Ray's own threads may log after this line.
        assert any(line.endswith(cause) for line in said.splitlines()), said


@pytest.mark.slow
def test_an_evaluation_whose_head_dies_ends_and_can_be_resumed(tmp_path: Path) -> None:
    log, out = tmp_path / "eval.log", tmp_path / "run"
    episodes = ["--episodes", "2000", "--workers", "1", "--video", "none", "--out", str(out)]
    with running(log, "eval", "tabletop", "--policy", "scripted", *episodes) as evaluation:
        wait_for(lambda: played(out) > 0 or evaluation.poll() is not None, 180)
        assert evaluation.poll() is None, log.read_text()
        started = psutil.Process(evaluation.pid).children(recursive=True)
        kill(log, "gcs_server")
        killed = time.monotonic()
        assert evaluation.wait(180) == 1
        print(f"GCS: killed, and the evaluation ended after {time.monotonic() - killed:.1f} s")
        gone(log, started)
        assert "continue with --resume" in log.read_text()
    assert played(out)


def played(out: Path) -> int:
    """Return the number of episodes with a result."""
    with suppress(ConfigError):  # no results have been written yet
        return sum(len(case.episodes) for case in Results.load(out).cases)
    return 0
