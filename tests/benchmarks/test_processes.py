"""CPU time, context switches and names of processes, and the processes that belong to a server."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from types import SimpleNamespace

import pytest
from eval_fakes import wait_for

from benchmarks import processes
from benchmarks.processes import UsageMeter, descendants, program, server_processes

# A process that starts a child process for each of its arguments, with this name, and ends when its
# input ends.
PARENT = """
import subprocess, sys
children = [
    subprocess.Popen([name, "-c", "input()"], executable=sys.executable, stdin=subprocess.PIPE) for name in sys.argv[1:]
]
print(*(child.pid for child in children), flush=True)
sys.stdin.read()
for child in children:
    child.communicate(b"end\\n")
"""


@pytest.fixture(name="family")
def running_family() -> Iterator[tuple[int, list[int]]]:
    """Yield a process and its children: a replica, Ray's idle worker, and another program."""
    names = ["ray::ServeReplica:noop:policy.act", "ray::IDLE", "openpi_peer.py"]
    with ExitStack() as stack:
        parent = stack.enter_context(
            subprocess.Popen(
                [sys.executable, "-c", PARENT, *names],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        assert parent.stdin is not None
        assert parent.stdout is not None
        stack.callback(parent.stdin.close)
        children = [int(pid) for pid in parent.stdout.readline().split()]
        wait_for(
            lambda: [program(pid) for pid in children] == ["ServeReplica", "IDLE", "openpi_peer.py"]
        )
        yield parent.pid, children


def test_a_server_is_all_that_its_process_has_started_but_rays_daemons_and_other_servers(
    family: tuple[int, list[int]],
) -> None:
    parent, [replica, idle, peer] = family
    assert descendants(parent) == {replica, idle, peer}
    assert server_processes(parent) == sorted([replica, peer])
    assert server_processes(parent, [peer]) == [replica]
    assert not {parent, replica, idle, peer} & set(server_processes(os.getpid(), [parent]))


SLEEP = (
    "import sys, time\nfor line in sys.stdin:\n  for _ in range(200): time.sleep(0.001)\n  "
    "print(flush=True)"
)


def test_a_thread_waits_once_each_time_that_it_sleeps() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SLEEP], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as sleeping:
        assert sleeping.stdin is not None
        assert sleeping.stdout is not None
        # The first meter includes the process's start.
        for meter in (UsageMeter([sleeping.pid]), UsageMeter([sleeping.pid])):
            with meter.counting():
                sleeping.stdin.write(b"\n")
                sleeping.stdin.flush()
                sleeping.stdout.readline()
        sleeping.stdin.close()
    found = meter.per_act(200)
    assert found["voluntary_switches"] == pytest.approx(1, abs=0.1)
    assert 0 < found["cpu_ms"] < 1  # without the time that it slept


def test_the_use_while_idle_is_not_that_of_an_act(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two processes are read before and after each interval. The first uses 0.1 CPU s and waits 10
    times per second while it is idle.
    """
    moments = iter([0.0, 2.0, 5.0, 6.0])
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: next(moments)))
    monkeypatch.setattr(processes, "program", {1: "replica", 2: "haproxy"}.__getitem__)
    counters = iter(
        [
            (1.0, {"7": (100, 5)}), (8.0, {"8": (3, 3)}),  # the idle interval of 2 s
            (1.2, {"7": (120, 5)}), (8.0, {"8": (3, 3)}),
            (2.0, {"7": (200, 5)}), (8.0, {"8": (3, 3)}),  # an interval of 1 s with ten acts
            # A thread has begun, and the other process has ended.
            (2.3, {"7": (230, 6), "9": (10, 0)}), None,
        ]
    )  # fmt: skip
    monkeypatch.setattr(processes, "_counters", lambda _: next(counters))
    meter = UsageMeter([1, 2])
    with meter.counting():
        pass
    assert meter.mark_idle() == pytest.approx(0.1)
    with meter.counting():
        pass
    found = meter.per_act(10)
    assert found.pop("programs") == pytest.approx({"replica": 20, "haproxy": 0})
    assert found == pytest.approx(
        {"cpu_ms": 20, "voluntary_switches": 3, "involuntary_switches": 0.1}
    )


def test_all_is_counted_of_a_process_that_polls(monkeypatch: pytest.MonkeyPatch) -> None:
    moments = iter([0.0, 1.0, 1.0, 2.0])
    monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: next(moments)))
    # The client occupies half of its core during the measurement.
    counters = iter([(0.0, {}), (1.0, {}), (1.0, {}), (1.5, {})])
    monkeypatch.setattr(processes, "_counters", lambda _: next(counters))
    meter = UsageMeter([1])
    with meter.counting():
        pass
    assert meter.mark_idle() == pytest.approx(1.0)
    with meter.counting():
        pass
    assert meter.per_act(10)["cpu_ms"] == pytest.approx(50)
