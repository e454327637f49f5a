"""CPU time and context switches of other processes, from Linux's clocks and /proc."""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

# Ray's processes that do nothing for an act: `program` of each, some before they have set their
# title.
DAEMONS = frozenset(
    {"gcs_server", "raylet", "ServeController", "DashboardAgent", "RuntimeEnvAgent", "IDLE"}
    | {"default_worker.py", "dashboard.py", "agent.py", "main.py", "monitor.py", "log_monitor.py"}
)
_IDLE_S = 3.0
# Cores that an idle process uses if it polls; one that waits for events or a timer uses less
# than 0.02.
_POLLING_CORES = 0.25
_SWITCHES = re.compile(r"ctxt_switches:\t(\d+)")  # voluntary ones, then involuntary ones


def cpu_seconds(pid: int) -> float:
    """Return the user and system CPU time of a process so far, all its threads, s.

    Raises:
        ProcessLookupError: It has ended.
    """
    try:
        # Its CPU clock (clock_getcpuclockid(3)) counts ns; /proc/PID/stat counts ticks of 10 ms,
        # which is 100 acts.
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
    """Return the processes that `pid` and its descendants have started, and that still run."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # it has ended
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
    """Return the processes of a server that `root` has started: all that may work for an act.

    Args:
        root: The process that started the server.
        others: Further processes that `root` has started; neither these nor their descendants
            belong to the server.
    """
    strangers = {*others}.union(*(descendants(one) for one in others))
    return [pid for pid in sorted(descendants(root) - strangers) if program(pid) not in DAEMONS]


class UsageMeter:
    """Adds up the CPU time and the context switches of processes in spans of time, beyond their
    use while idle.
    """

    def __init__(self, pids: Sequence[int]) -> None:
        self._pids = pids
        self._programs = [program(pid) for pid in pids]
        self._seconds = 0.0  # length of all spans
        self._used = np.zeros((len(pids), 3))  # CPU s, voluntary and involuntary context switches
        self._idle = np.zeros((len(pids), 3))  # the same for each second

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
        """Take what was counted so far as the use while idle; returns its CPU s in a second.

        What a process that polls uses is all counted: polling takes a core that no act beside it
        could have.
        """
        idle = self._used / self._seconds
        self._seconds, self._used = 0.0, np.zeros_like(self._used)
        self._idle = np.where(idle[:, :1] > _POLLING_CORES, 0, idle)
        return float(idle[:, 0].sum())

    def per_act(self, acts: int) -> dict[str, Any]:
        """Return the use for each of `acts` acts as JSON values, and its CPU time by program,
        ms.
        """
        each = (self._used - self._seconds * self._idle) / acts * (1e3, 1, 1)
        programs = dict.fromkeys(self._programs, 0.0)
        for name, cpu_ms in zip(self._programs, each[:, 0], strict=True):
            programs[name] += float(cpu_ms)
        cpu_ms, voluntary, involuntary = map(float, each.sum(axis=0))
        return {
            "cpu_ms": cpu_ms,
            "voluntary_switches": voluntary,  # a thread waited
            "involuntary_switches": involuntary,  # the machine had other work
            "programs": programs,
        }


def count_idle(meters: Sequence[UsageMeter]) -> list[float]:
    """Count for 3 s while all processes are idle, as their use while idle; returns the CPU s a
    second of each meter.
    """
    with contextlib.ExitStack() as stack:
        for meter in meters:
            stack.enter_context(meter.counting())
        time.sleep(_IDLE_S)
    return [meter.mark_idle() for meter in meters]


def _counters(pid: int) -> tuple[float, dict[str, tuple[int, ...]]] | None:
    """Return CPU s, and the voluntary and involuntary context switches of each thread; None if
    it has ended.
    """
    switches: dict[str, tuple[int, ...]] = {}
    try:
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError):  # it has ended
                switches[thread.name] = tuple(
                    map(int, _SWITCHES.findall((thread / "status").read_text()))
                )
        return cpu_seconds(pid), switches
    except OSError:
        return None
