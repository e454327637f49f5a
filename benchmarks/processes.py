"""Measures CPU time and context switches of other processes, with Linux's clocks and /proc."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

# Values of `program` for Ray's processes that do nothing for a call, some before they have set
# their title.
DAEMONS = frozenset(
    {"gcs_server", "raylet", "ServeController", "DashboardAgent", "RuntimeEnvAgent", "IDLE"}
    | {"default_worker.py", "dashboard.py", "agent.py", "main.py", "monitor.py", "log_monitor.py"}
)
_IDLE_S = 3.0
# Minimum number of cores that an idle process uses if it polls; a process that waits for events or
# a timer uses less than 0.02.
_POLLING_CORES = 0.25
_SWITCHES = re.compile(r"ctxt_switches:\t(\d+)")  # voluntary switches, then involuntary switches


def cpu_seconds(pid: int) -> float:
    """Return the user and system CPU time that all threads of a process have used so far, s.

    Raises:
        ProcessLookupError: The process has ended.
    """
    try:
        # The process's CPU clock (clock_getcpuclockid(3)) counts ns; /proc/PID/stat counts ticks of
        # 10 ms, which is as long as 100 calls.
        return time.clock_gettime((~pid << 3) | 2)
    except OSError as error:
        raise ProcessLookupError(f"/proc/{pid}: there is no such process") from error


def program(pid: int) -> str:
    """Return the name of a process: Ray's title for it, a script, or a program; empty if it has
    ended.
    """
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return ""
    if title := re.match(r"ray::(\w+)", words[0]):
        return title[1]
    return Path(next((word for word in words if word.endswith(".py")), words[0])).name


def descendants(pid: int) -> set[int]:
    """Return the running processes that `pid` and its descendants have started."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # the process has ended
            children.setdefault(int(stat.read_text().rpartition(")")[2].split()[1]), []).append(
                int(stat.parent.name)
            )
    found: set[int] = set()
    waiting = [pid]
    while waiting:
        found.update(more := children.get(waiting.pop(), []))
        waiting += more
    return found


def server_processes(root: int, others: Collection[int] = ()) -> list[int]:
    """Return the processes of a server that `root` has started: all processes that may work for a
    call.

    Args:
        root: The process that started the server.
        others: Further processes that `root` has started; neither these nor their descendants
            belong to the server.
    """
    strangers = {*others}.union(*(descendants(one) for one in others))
    return [pid for pid in sorted(descendants(root) - strangers) if program(pid) not in DAEMONS]


class UsageMeter:
    """Adds up the CPU time and the context switches of processes in spans of time, in excess of
    their idle use.
    """

    def __init__(self, pids: Sequence[int]) -> None:
        self._pids = pids
        self._programs = [program(pid) for pid in pids]
        self._seconds = 0.0  # total length of all spans, s
        self._used = np.zeros((len(pids), 3))  # CPU s, voluntary and involuntary context switches
        self._idle = np.zeros((len(pids), 3))  # idle use per second, in the same units

    @contextlib.contextmanager
    def counting(self) -> Iterator[None]:
        """Count within the context. A process that ends within it is not counted."""
        begun, before = time.monotonic(), [_counters(pid) for pid in self._pids]
        yield
        for row, pid, earlier in zip(self._used, self._pids, before, strict=True):
            if earlier is not None and (now := _counters(pid)) is not None:
                row[0] += now[0] - earlier[0]
                for thread, switches in now[1].items():
                    row[1:] += np.subtract(switches, earlier[1].get(thread, (0, 0)))
        self._seconds += time.monotonic() - begun

    def mark_idle(self) -> float:
        """Use the counts so far as the idle use, and return its CPU seconds per second.

        The use of a polling process counts completely, as no other call could use the core on which
        it polls.
        """
        idle = self._used / self._seconds
        self._seconds, self._used = 0.0, np.zeros_like(self._used)
        self._idle = np.where(idle[:, :1] > _POLLING_CORES, 0, idle)
        return float(idle[:, 0].sum())

    def per_act(self, acts: int) -> dict[str, Any]:
        """Return the use per call as JSON values, given the number of calls `acts`, and the CPU
        time by program, ms.
        """
        each = (self._used - self._seconds * self._idle) / acts * (1e3, 1, 1)
        programs = dict.fromkeys(self._programs, 0.0)
        for name, cpu_ms in zip(self._programs, each[:, 0], strict=True):
            programs[name] += float(cpu_ms)
        cpu_ms, voluntary, involuntary = map(float, each.sum(axis=0))
        return {
            "cpu_ms": cpu_ms,
            "voluntary_switches": voluntary,  # a thread has waited
            "involuntary_switches": involuntary,  # the machine had other work
            "programs": programs,
        }


def count_idle(meters: Sequence[UsageMeter]) -> list[float]:
    """Count for 3 s while all processes are idle, and use the counts as the idle use; return the
    CPU seconds per second of each meter.
    """
    with contextlib.ExitStack() as stack:
        for meter in meters:
            stack.enter_context(meter.counting())
        time.sleep(_IDLE_S)
    return [meter.mark_idle() for meter in meters]


def _counters(pid: int) -> tuple[float, dict[str, tuple[int, ...]]] | None:
    """Return CPU s, and the voluntary and involuntary context switches of each thread; None if the
    process has ended.
    """
    switches: dict[str, tuple[int, ...]] = {}
    try:
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):  # the process has ended
                switches[thread.name] = tuple(
                    map(int, _SWITCHES.findall((thread / "status").read_text()))
                )
        return cpu_seconds(pid), switches
    except OSError:
        return None
